"""Bill of materials of an image: Debian packages and Python distributions, in CycloneDX."""

from __future__ import annotations

import email
import json
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fractus_cluster.commands import run

_PACKAGES = Path("var/lib/dpkg/status")
_DISTRIBUTIONS = Path("opt/fractus/lib/python3.13/site-packages")


def image_bill(image: str) -> str:
    """Return the bill of materials of an image in buildah's storage, as CycloneDX in JSON.

    Raises:
        ClusterError: buildah has no image of that name.
    """
    container = run(["buildah", "from", "--pull-never", image]).stdout.strip()
    try:
        return bill_of_materials(image, Path(run(["buildah", "mount", container]).stdout.strip()))
    finally:
        run(["buildah", "rm", container])


def bill_of_materials(image: str, root: Path) -> str:
    """Return the components of an image's root file system as CycloneDX in JSON. The text depends only on the content.

    Args:
        image: Name of the image.
        root: Its root file system.
    """
    components = dict(sorted([*_packages(root), *_distributions(root)]))
    document = {
        "$schema": "http://cyclonedx.org/schema/bom-1.5.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": {"type": "container", "bom-ref": image, "name": image}},
        "components": list(components.values()),
    }
    return json.dumps(document, indent=2) + "\n"


def _packages(root: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    release = dict(
        line.replace('"', "").split("=", 1) for line in (root / "usr/lib/os-release").read_text().splitlines()
    )
    for paragraph in (root / _PACKAGES).read_text().split("\n\n"):
        if not paragraph.strip():
            continue
        package = email.message_from_string(paragraph.lstrip("\n"))
        # Security advisories refer to source packages. Debian omits the field if both names are equal.
        source = package.get("Source", "").split(" ")[0]
        qualifiers = {
            "arch": package["Architecture"],
            "distro": f"{release['ID']}-{release['VERSION_ID']}",
            "upstream": source,
        }
        yield _component("deb/debian", package["Package"], package["Version"], qualifiers)


def _distributions(root: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    for distribution in distributions(path=[str(root / _DISTRIBUTIONS)]):
        name = distribution.metadata["Name"].lower().replace("_", "-")
        yield _component("pypi", name, distribution.version, {})


def _component(type_: str, name: str, version: str, qualifiers: dict[str, str]) -> tuple[str, dict[str, Any]]:
    """Return the package URL of a component, and its CycloneDX entry."""
    query = "&".join(f"{key}={quote(value, safe='')}" for key, value in qualifiers.items() if value)
    url = f"pkg:{type_}/{quote(name, safe='')}@{quote(version, safe='')}" + (f"?{query}" if query else "")
    return url, {"type": "library", "bom-ref": url, "name": name, "version": version, "purl": url}
