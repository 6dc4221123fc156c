"""The bill of materials of an image: the Debian packages and Python distributions that its root file system tells of."""

from __future__ import annotations

import email
import json
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fractus_cluster.commands import run

_PACKAGES = Path("var/lib/dpkg/status.d")
_DISTRIBUTIONS = Path("usr/local/lib/python3.11/dist-packages")


def image_bill(image: str) -> str:
    """Return the bill of materials of an image in buildah's storage, as CycloneDX in JSON.

    Raises:
        ClusterError: There is no such image.
    """
    container = run(["buildah", "from", "--pull-never", image]).stdout.strip()
    try:
        return bill_of_materials(image, Path(run(["buildah", "mount", container]).stdout.strip()))
    finally:
        run(["buildah", "rm", container])


def bill_of_materials(image: str, root: Path) -> str:
    """Return what the root file system of an image consists of, as CycloneDX in JSON: the same for the same content."""
    found = dict(sorted([*_packages(root), *_distributions(root)]))
    document = {
        "$schema": "http://cyclonedx.org/schema/bom-1.5.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": {"type": "container", "bom-ref": image, "name": image}},
        "components": list(found.values()),
    }
    return json.dumps(document, indent=2) + "\n"


def _packages(root: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    release = dict(
        line.replace('"', "").split("=", 1) for line in (root / "usr/lib/os-release").read_text().splitlines()
    )
    for path in (root / _PACKAGES).iterdir():
        if path.suffix != ".md5sums":
            stanza = email.message_from_string(path.read_text())
            # Advisories name the package of the sources, which is in the stanza where its name is another.
            source = stanza.get("Source", "").split(" ")[0]
            qualifiers = {
                "arch": stanza["Architecture"],
                "distro": f"{release['ID']}-{release['VERSION_ID']}",
                "upstream": source,
            }
            yield _component("deb/debian", stanza["Package"], stanza["Version"], qualifiers)


def _distributions(root: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    for each in distributions(path=[str(root / _DISTRIBUTIONS)]):
        yield _component("pypi", each.metadata["Name"].lower().replace("_", "-"), each.version, {})


def _component(kind: str, name: str, version: str, qualifiers: dict[str, str]) -> tuple[str, dict[str, Any]]:
    """Return a component by its package URL."""
    said = "&".join(f"{key}={quote(value, safe='')}" for key, value in qualifiers.items() if value)
    url = f"pkg:{kind}/{quote(name, safe='')}@{quote(version, safe='')}" + (f"?{said}" if said else "")
    return url, {"type": "library", "bom-ref": url, "name": name, "version": version, "purl": url}
