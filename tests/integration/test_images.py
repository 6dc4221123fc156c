"""The container images: no larger than their limits, and with all that their programs call."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
import time
import tomllib
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path

import pytest
from fractus_cluster.commands import run
from fractus_cluster.images.bill import image_bill
from fractus_cluster.images.build import SIZE_LIMITS_MB, TARGETS, build_images, image_name

pytestmark = [pytest.mark.slow, pytest.mark.root, pytest.mark.timeout(1800), pytest.mark.xdist_group("cluster")]

ROOT = Path(__file__).parents[2]
PROGRAM = (Path(__file__).parent / "image_program.py").read_text()

# Packages of commands and extras that are not for the image: tracing, `fractus` commands that read a cluster, Fractus elsewhere.
_COMPONENT = {"cryptography", "fractus_core", "fractus_runtime.kubernetes", "fractus_mavlink", "fractus_services"}
_SERVICE = {"opentelemetry", "fractus_runtime.kubernetes"}
LACKING = {
    "operator": {"fractus", "fractus_mavlink", "fractus_services", "fractus_runtime", "opentelemetry"},
    "agent": {"opentelemetry", "numpy", "shapely"},
    "mobility": _SERVICE,
    "camera": _SERVICE,
    "sim": _SERVICE | {"pyproj", "scipy", "tifffile"},
    "view": {"cryptography", "fractus", "fractus_mavlink", "fractus_services", "opentelemetry"},
}


# What the Dockerfile writes itself.
WRITTEN = {"etc/passwd", "etc/group", "etc/nsswitch.conf"}
# Modules of which Debian has links, which have no checksum.
LINKED = ("sitecustomize", "_sysconfigdata__linux_")


@pytest.fixture(scope="module")
def image(request: pytest.FixtureRequest) -> Iterator[tuple[str, str]]:
    """A target, and a container of its image."""
    target: str = request.param
    build_images(ROOT, targets=[target], report=print)
    container = run(["buildah", "from", "--pull-never", image_name(target)]).stdout.strip()
    yield target, container
    run(["buildah", "rm", container])


@pytest.mark.parametrize("image", SIZE_LIMITS_MB, indirect=True)
def test_is_no_larger_than_its_limit(image: tuple[str, str]) -> None:
    target, container = image
    root = run(["buildah", "mount", container]).stdout.strip()
    size_mb = int(run(["du", "-sx", "--block-size=1", root]).stdout.split()[0]) / 1e6
    assert size_mb <= SIZE_LIMITS_MB[target]


@pytest.mark.parametrize("image", TARGETS, indirect=True)
def test_has_what_its_programs_call(image: tuple[str, str]) -> None:
    target, container = image
    words = ["buildah", "run", "--isolation", "chroot", container, "--", "python3", "-c", PROGRAM]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    assert set(json.loads(done.stdout.splitlines()[-1])) == LACKING.get(target, _COMPONENT)


@pytest.mark.parametrize("image", TARGETS, indirect=True)
def test_tells_the_package_of_each_file_of_debian(image: tuple[str, str]) -> None:
    root = Path(run(["buildah", "mount", image[1]]).stdout.strip())
    records = root / "var" / "lib" / "dpkg" / "status.d"
    packages = {path.name for path in records.iterdir() if path.suffix != ".md5sums"}
    known, checksums = set(), set()
    for name in packages:
        stanza = (records / name).read_text()
        assert re.search(rf"^Package: {re.escape(name)}$", stanza, re.MULTILINE)
        assert re.search(r"^Version: \d\S+$", stanza, re.MULTILINE)
        lines = (records / f"{name}.md5sums").read_text().splitlines()
        known |= {line.split(maxsplit=1)[1] for line in lines}
        checksums |= {line.split()[0] for line in lines} | set(re.findall(r"\b[0-9a-f]{32}\b", stanza))
        assert (root / "usr" / "share" / "doc" / name / "copyright").is_file()

    def told(path: Path) -> bool:
        if path.suffix == ".pyc":
            return f"{path.relative_to(root).with_suffix('.py')}" in known or path.name.startswith(LINKED)
        return hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest() in checksums

    ours = {root / "app", root / "usr" / "local", records}
    files = [
        path for path in root.rglob("*") if path.is_file() and not path.is_symlink() and ours.isdisjoint(path.parents)
    ]
    assert len(files) > 600
    assert {f"{path.relative_to(root)}" for path in files if not told(path)} == WRITTEN


@pytest.mark.parametrize("image", TARGETS, indirect=True)
def test_tells_the_distribution_of_each_python_package(image: tuple[str, str]) -> None:
    root = Path(run(["buildah", "mount", image[1]]).stdout.strip())
    here = root / "usr" / "local" / "lib" / "python3.11" / "dist-packages"
    found = list(distributions(path=[str(here)]))
    locked = {(each["name"], each["version"]) for each in tomllib.loads((ROOT / "uv.lock").read_text())["package"]}
    named = {(re.sub(r"[-_.]+", "-", each.metadata["Name"]).lower(), each.version) for each in found}
    assert named <= locked
    told = {file.parts[0] for each in found for file in each.files or ()}
    strangers = {
        f"{path.name.removesuffix('c')}" if path.suffix == ".pyc" else path.name for path in here.iterdir()
    } - told
    assert {name for name in strangers if not name.startswith("fractus")} == set()


def test_the_same_code_gives_the_same_layers(tmp_path: Path) -> None:
    checkout = tmp_path / "elsewhere"
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        here, there = ROOT / line.removeprefix("!"), checkout / line.removeprefix("!")
        if line.startswith("!") and here.is_dir():
            shutil.copytree(here, there, ignore=shutil.ignore_patterns("node_modules"))
        elif line.startswith("!"):
            there.parent.mkdir(exist_ok=True)
            shutil.copy2(here, there)
    for name in ("Dockerfile", ".dockerignore"):
        shutil.copy(ROOT / name, checkout)
    # In no image: without it, the steps of the first build would be taken for those of the second.
    (checkout / "examples" / "another.txt").write_text(f"{time.time_ns()}\n")
    [one] = build_images(ROOT, targets=["component"], report=print)
    try:
        [other] = build_images(checkout, targets=["component"], tag="elsewhere", report=print)
        assert layers(other) == layers(one)
    finally:
        run(["buildah", "rmi", image_name("component", "elsewhere")], check=False)


def layers(image: str) -> list[str]:
    """The digests of an image's layers."""
    described = json.loads(run(["buildah", "inspect", "--type", "image", image]).stdout)
    found: list[str] = described["OCIv1"]["rootfs"]["diff_ids"]
    assert len(found) > 2
    return found


def test_has_a_bill_of_materials() -> None:
    [name] = build_images(ROOT, targets=["agent"], report=print)
    bill = json.loads(image_bill(name))
    versions = {each["name"]: each["version"] for each in bill["components"]}
    assert versions.keys() >= {"libc6", "nftables", "libnftables1", "grpcio", "fractus-drones"}
    assert versions["fractus-drones"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
