"""Container images: their imports, unmodified packages, reproducible layers, and bill of materials."""

from __future__ import annotations

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
from fractus_cluster.images.build import TARGETS, build_images, image_name

pytestmark = [pytest.mark.slow, pytest.mark.root, pytest.mark.timeout(1800), pytest.mark.xdist_group("cluster")]

ROOT = Path(__file__).parents[2]
PROGRAM = (Path(__file__).parent / "image_program.py").read_text()
SITE_PACKAGES = Path("opt/fractus/lib/python3.13/site-packages")
PACKAGES = {
    "operator": ["fractus_operator"],
    "agent": ["fractus_agent"],
    "mobility": ["fractus_services.mobility"],
    "camera": ["fractus_services"],
    "view": ["fractus_view"],
    "management": ["fractus_management"],
    "sim": ["fractus_vehicle", "fractus_world", "fractus_radio", "fractus_sim", "fractus_cluster"],
}
"""Packages whose modules the image must be able to import, by image. All other images contain a component."""
LACKING = {
    "component": {"cv2", "kubernetes", "fractus_vehicle"},
    "operator": {"cv2", "fractus_vehicle"},
    "agent": {"numpy", "shapely", "cv2", "fractus_vehicle"},
    "management": {"cv2", "fractus_vehicle"},
    "mobility": {"cv2", "kubernetes", "fractus_vehicle"},
    "camera": {"kubernetes", "fractus_vehicle"},
}
"""Libraries that an image must not contain, because only other images need them."""


@pytest.fixture(scope="module")
def image(request: pytest.FixtureRequest) -> Iterator[tuple[str, str]]:
    """Name of a build target, and a container that runs its image."""
    target: str = request.param
    build_images(ROOT, targets=[target], report=print)
    container = run(["buildah", "from", "--pull-never", image_name(target)]).stdout.strip()
    yield target, container
    run(["buildah", "rm", container])


@pytest.mark.parametrize("image", TARGETS, indirect=True)
def test_image_imports_all_modules_of_its_program(image: tuple[str, str]) -> None:
    target, container = image
    packages = PACKAGES.get(target, ["fractus"])
    words = ["buildah", "run", "--isolation", "chroot", container, "--", "python3", "-", *packages]
    result = subprocess.run(words, input=PROGRAM, capture_output=True, text=True, timeout=300, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("image", TARGETS, indirect=True)
def test_image_has_only_locked_distributions(image: tuple[str, str]) -> None:
    target, container = image
    root = Path(run(["buildah", "mount", container]).stdout.strip())
    installed = list(distributions(path=[str(root / SITE_PACKAGES)]))
    locked = {(each["name"], each["version"]) for each in tomllib.loads((ROOT / "uv.lock").read_text())["package"]}
    named = {(re.sub(r"[-_.]+", "-", each.metadata["Name"]).lower(), each.version) for each in installed}
    assert named <= locked
    lacking = LACKING.get(target, set())
    assert not [name for name in lacking if (root / SITE_PACKAGES / name).exists()]
    lost = {str(file) for each in installed for file in each.files or () if not Path(file.locate()).exists()}
    assert lost == set()


@pytest.fixture
def other_checkout(tmp_path: Path) -> Iterator[Path]:
    """A copy of the build context. Its image is `component:elsewhere`."""
    checkout = tmp_path / "elsewhere"
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        source = ROOT / line.removeprefix("!")
        target = checkout / line.removeprefix("!")
        if line.startswith("!") and source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("node_modules"))
        elif line.startswith("!"):
            target.parent.mkdir(exist_ok=True)
            shutil.copy2(source, target)
    for name in ("Dockerfile", ".dockerignore"):
        shutil.copy(ROOT / name, checkout)
    yield checkout
    run(["buildah", "rmi", image_name("component", "elsewhere")], check=False)


def test_equal_sources_give_equal_layers(other_checkout: Path) -> None:
    # This file is in no image. It keeps the second build from using the cached steps of the first.
    (other_checkout / "examples" / "another.txt").write_text(f"{time.time_ns()}\n")
    [one] = build_images(ROOT, targets=["component"], report=print)
    [other] = build_images(other_checkout, targets=["component"], tag="elsewhere", report=print)
    assert layers(other) == layers(one)


def test_image_contains_changed_source_of_same_version(other_checkout: Path) -> None:
    marker = f"# {time.time_ns()}"
    with (other_checkout / "sdk" / "fractus" / "channel.py").open("a") as file:
        file.write(f"\n{marker}\n")
    [image] = build_images(other_checkout, targets=["component"], tag="elsewhere", report=print)
    container = run(["buildah", "from", "--pull-never", image]).stdout.strip()
    try:
        code = "import fractus.channel, pathlib; print(pathlib.Path(fractus.channel.__file__).read_text())"
        assert marker in run(["buildah", "run", "--isolation", "chroot", container, "--", "python3", "-c", code]).stdout
    finally:
        run(["buildah", "rm", container])


def layers(image: str) -> list[str]:
    """Return the digests of the layers of an image."""
    described = json.loads(run(["buildah", "inspect", "--type", "image", image]).stdout)
    digests: list[str] = described["OCIv1"]["rootfs"]["diff_ids"]
    assert len(digests) > 2
    return digests


def test_bill_of_materials_names_packages_of_debian_and_python() -> None:
    [name] = build_images(ROOT, targets=["agent"], report=print)
    bill = json.loads(image_bill(name))
    versions = {each["name"]: each["version"] for each in bill["components"]}
    assert versions.keys() >= {"libc6", "nftables", "libnftables1", "grpcio", "fractus-drones"}
    assert versions["fractus-drones"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
