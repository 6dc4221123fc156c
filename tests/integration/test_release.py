"""Consistency of a release: its charts name the images that its workflow pushes."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest
import yaml
from chart import CHARTS, Body, helm, render
from control_plane import ControlPlane
from fractus_cluster.commands import run
from fractus_cluster.images.build import image_name
from operator_world import SYSTEM

pytestmark = pytest.mark.slow

ROOT = CHARTS.parent
WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yaml").read_text())
VERSION = yaml.safe_load((CHARTS / "fractus" / "Chart.yaml").read_text())["version"]
EVERYTHING = ("--set=view.enabled=true", "--set=management.enabled=true", "--set=uninstall.wipeNodes=true")
PARTS = ("operator", "agent", "mobility", "camera", "view", "management")
BUILT_ON = "component"
"""Base image for components of users. No chart uses it."""


def script(beginning: str) -> str:
    """Return the script of the workflow step whose script begins with this text."""
    steps = [step for job in WORKFLOW["jobs"].values() for step in job["steps"]]
    (text,) = [step["run"] for step in steps if step.get("run", "").startswith(beginning)]
    return str(text)


STUBS = {
    "make": f'shift; exec {shutil.which("make")} -C {ROOT} charts archives DIST="$PWD/dist" "$@"',
    # The stub writes only the name of the image to the archive.
    "docker": """
while [ $# -gt 0 ]; do
  case $1 in --tag) name=$2 ;; --output) archive=${2##*dest=} ;; esac
  shift
done
echo "$name" > "$archive"
""",
    "skopeo": """
while [ $# -gt 2 ]; do
  [ "$1" != --digestfile ] || echo sha256:0 > "$2"
  shift
done
echo "$(cat "${1#oci-archive:}") ${2#docker://}" >> saved-and-pushed
""",
    "cosign": 'echo "$3" >> signed',
}
"""Stubs for programs that would build images for half an hour, or that need a registry."""


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the workflow for a tag, with stubs as programs. Return the directory with `dist` and the lists of images."""
    folder = tmp_path_factory.mktemp("release")
    (folder / "programs").mkdir()
    for name, text in STUBS.items():
        (folder / "programs" / name).write_text(f"#!/bin/sh\n{text}\n")
        (folder / "programs" / name).chmod(0o755)
    variables = {"GITHUB_REPOSITORY_OWNER": "Some-One", "GITHUB_REF_NAME": f"v{VERSION}"}
    variables["PATH"] = f"{folder / 'programs'}:{os.environ['PATH']}"
    for step in ("make dist", "for archive"):
        argv = ["bash", "-euo", "pipefail", "-c", script(step)]
        subprocess.run(argv, env={**os.environ, **variables}, cwd=folder, timeout=60, check=True)
    return folder


def rendered(folder: Path, chart: str, *values: str) -> list[Body]:
    return render(*values, chart=folder / "dist" / f"{chart}-{VERSION}.tgz")


def images_of(bodies: list[Body]) -> set[str]:
    """Return the images that objects name, or that manifests inside ConfigMaps name."""
    stored_manifests = [text for body in bodies if body["kind"] == "ConfigMap" for text in body["data"].values()]
    texts = [yaml.safe_dump(bodies), *stored_manifests]
    return {name for text in texts for name in re.findall(r"^ *(?:- )?image: (\S+)$", text, re.MULTILINE)}


def test_charts_of_a_release_name_its_pushed_images(published: Path) -> None:
    pairs = [line.split() for line in (published / "saved-and-pushed").read_text().splitlines()]
    assert all(saved == pushed for saved, pushed in pairs), (
        "an image in an archive and the image that is pushed from it have different names"
    )
    pushed = {name for _, name in pairs}
    assert f"ghcr.io/some-one/fractus/operator:{VERSION}" in pushed
    bodies = [*rendered(published, "fractus", *EVERYTHING), *rendered(published, "fractus-demo", "--set=drone=d")]
    assert images_of(bodies) | {f"ghcr.io/some-one/fractus/{BUILT_ON}:{VERSION}"} == pushed
    assert set((published / "signed").read_text().split()) == {f"{name.rpartition(':')[0]}@sha256:0" for name in pushed}


def test_charts_of_a_checkout_name_its_built_images() -> None:
    bodies = [*render(*EVERYTHING), *render("--set=drone=d", chart=CHARTS / "fractus-demo")]
    assert images_of(bodies) == {image_name(target) for target in (*PARTS, "sim", "example-traffic-monitoring")}


def test_image_tag_of_the_values_is_used() -> None:
    tag = "--set=image.tag=1.2.3"
    bodies = [*render(*EVERYTHING, tag), *render("--set=drone=d", tag, chart=CHARTS / "fractus-demo")]
    assert {name.rpartition(":")[2] for name in images_of(bodies)} == {"1.2.3"}


def test_dist_refuses_a_tag_of_another_version() -> None:
    result = subprocess.run(
        ["make", "dist", "TAG=v9.9.9", "PLATFORMS=none"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 2
    assert (
        f"the tag v9.9.9 does not match version {VERSION} in pyproject.toml; run make release VERSION=9.9.9"
        in result.stderr
    )


def test_audit_fails_if_advisories_are_unreachable() -> None:
    nowhere = {"HTTPS_PROXY": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    result = subprocess.run(
        ["make", "--silent", "audit"], cwd=ROOT, env={**os.environ, **nowhere}, capture_output=True, text=True, timeout=120, check=False
    )  # fmt: skip
    assert result.returncode == 2
    assert result.stderr.startswith("audit not possible: cannot reach the advisories of PyPI (https://pypi.org/")


@pytest.mark.root
@pytest.mark.timeout(900)
@pytest.mark.xdist_group("cluster")
def test_release_archive_has_the_image_name_of_the_charts(tmp_path: Path) -> None:
    run(
        ["make", "archives", "RELEASED=component", "REGISTRY=registry.example/f", f"DIST={tmp_path}"],
        cwd=ROOT,
        timeout_s=600,
    )
    with tarfile.open(tmp_path / f"component-{VERSION}.image.tar") as archive:
        manifest = json.loads((archive.extractfile("manifest.json") or pytest.fail("no manifest")).read())
    (image,) = manifest
    assert f"registry.example/f/component:{VERSION}" in image["RepoTags"]


@pytest.mark.parametrize(("tag", "warned"), [("0.0.1", True), (VERSION, False), ("", False)])
def test_notes_warn_about_another_image_tag(
    control_plane: ControlPlane, published: Path, tag: str, *, warned: bool
) -> None:
    argv = [helm(), "install", "fractus", str(published / "dist" / f"fractus-{VERSION}.tgz"), f"--set=image.tag={tag}"]
    # Let helm adopt objects of the chart that other tests created without helm.
    argv += [
        "--namespace",
        SYSTEM,
        "--dry-run=server",
        "--take-ownership",
        "--kubeconfig",
        str(control_plane.kubeconfig),
    ]
    result = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    notes = result.stdout.partition("NOTES:")[2]
    assert f"from the images ghcr.io/some-one/fractus/NAME:{tag or VERSION}." in notes
    assert (f"images with the tag {VERSION}. Select them with --set image.tag=" in notes) is warned
