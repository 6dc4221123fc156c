"""Bill of materials generated from the root file system of an image."""

import json
from pathlib import Path

import pytest
from fractus_cluster.images.bill import bill_of_materials

LIBGCC = """Package: libgcc-s1
Status: install ok installed
Architecture: arm64
Source: gcc-12 (12.2.0-14)
Version: 1:12.2.0-14+deb12u1
Description: GCC support library
 Shared version of the support library.
"""
NETBASE = "Package: netbase\nArchitecture: all\nVersion: 6.4\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Root file system of a small image."""
    (tmp_path / "var/lib/dpkg").mkdir(parents=True)
    (tmp_path / "var/lib/dpkg/status").write_text(f"{LIBGCC}\n{NETBASE}\n")
    (tmp_path / "usr/lib").mkdir(parents=True)
    (tmp_path / "usr/lib/os-release").write_text('PRETTY_NAME="Debian GNU/Linux 12"\nVERSION_ID="12"\nID=debian\n')
    for name, version in (("Typing_Extensions", "4.16.0"), ("grpcio", "1.85.1")):
        folder = tmp_path / f"opt/fractus/lib/python3.13/site-packages/{name.lower()}-{version}.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\n\nText.\n")
    return tmp_path


def test_bill_has_package_urls_in_the_format_of_advisories(root: Path) -> None:
    bill = json.loads(bill_of_materials("localhost/fractus/agent:dev", root))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.5")
    assert bill["metadata"]["component"]["name"] == "localhost/fractus/agent:dev"
    assert {component["purl"] for component in bill["components"]} == {
        "pkg:deb/debian/libgcc-s1@1%3A12.2.0-14%2Bdeb12u1?arch=arm64&distro=debian-12&upstream=gcc-12",
        "pkg:deb/debian/netbase@6.4?arch=all&distro=debian-12",
        "pkg:pypi/typing-extensions@4.16.0",
        "pkg:pypi/grpcio@1.85.1",
    }
    assert {(component["name"], component["version"]) for component in bill["components"]} >= {
        ("libgcc-s1", "1:12.2.0-14+deb12u1"),
        ("typing-extensions", "4.16.0"),
    }


def test_bill_does_not_depend_on_the_order_of_packages(root: Path) -> None:
    first = bill_of_materials("image", root)
    (root / "var/lib/dpkg/status").write_text(f"{NETBASE}\n{LIBGCC}\n")
    assert bill_of_materials("image", root) == first
