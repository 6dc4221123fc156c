"""The bill of materials of an image, from what its root file system tells."""

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


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The root file system of a small image."""
    packages = tmp_path / "var/lib/dpkg/status.d"
    packages.mkdir(parents=True)
    (packages / "libgcc-s1").write_text(LIBGCC)
    (packages / "libgcc-s1.md5sums").write_text("0123  lib/libgcc_s.so.1\n")
    (packages / "netbase").write_text("Package: netbase\nArchitecture: all\nVersion: 6.4\n")
    (tmp_path / "usr/lib").mkdir(parents=True)
    (tmp_path / "usr/lib/os-release").write_text('PRETTY_NAME="Debian GNU/Linux 12"\nVERSION_ID="12"\nID=debian\n')
    for name, version in (("Typing_Extensions", "4.16.0"), ("grpcio", "1.85.1")):
        folder = tmp_path / f"usr/local/lib/python3.11/dist-packages/{name.lower()}-{version}.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\n\nText.\n")
    return tmp_path


def test_names_what_advisories_are_looked_up_by(root: Path) -> None:
    bill = json.loads(bill_of_materials("localhost/fractus/agent:dev", root))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.5")
    assert bill["metadata"]["component"]["name"] == "localhost/fractus/agent:dev"
    assert {each["purl"] for each in bill["components"]} == {
        "pkg:deb/debian/libgcc-s1@1%3A12.2.0-14%2Bdeb12u1?arch=arm64&distro=debian-12&upstream=gcc-12",
        "pkg:deb/debian/netbase@6.4?arch=all&distro=debian-12",
        "pkg:pypi/typing-extensions@4.16.0",
        "pkg:pypi/grpcio@1.85.1",
    }
    assert {(each["name"], each["version"]) for each in bill["components"]} >= {
        ("libgcc-s1", "1:12.2.0-14+deb12u1"),
        ("typing-extensions", "4.16.0"),
    }


def test_is_the_same_for_the_same_content(root: Path) -> None:
    first = bill_of_materials("image", root)
    again = root / "var/lib/dpkg/status.d/netbase"
    content = again.read_text()
    again.unlink()
    (root / "var/lib/dpkg/status.d/other").write_text(content)
    assert bill_of_materials("image", root) == first
