"""The container images: no larger than their limits, and with all that their programs call."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_cluster.commands import run
from fractus_cluster.images.build import SIZE_LIMITS_MB, TARGETS, build_images, image_name

pytestmark = [pytest.mark.root, pytest.mark.timeout(1800), pytest.mark.xdist_group("cluster")]

ROOT = Path(__file__).parents[2]
PROGRAM = (Path(__file__).parent / "image_program.py").read_text()

# Packages of commands and extras that are not for the image: tracing, `fractus` commands that read a cluster, Fractus elsewhere.
_COMPONENT = {"cryptography", "fractus_core", "fractus_kube", "fractus_mavlink", "fractus_services"}
_SERVICE = {"opentelemetry", "fractus_kube"}
LACKING = {
    "operator": {"opentelemetry"},
    "agent": {"opentelemetry", "numpy", "shapely"},
    "mobility": _SERVICE,
    "camera": _SERVICE,
    "sim": _SERVICE | {"pyproj", "scipy", "tifffile"},
    "view": {"cryptography", "fractus", "fractus_mavlink", "fractus_services"},
}


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
