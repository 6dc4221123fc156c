"""What a release publishes fits together: its charts name the images that its workflow pushes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from chart import CHARTS, Body, helm, render
from control_plane import ControlPlane
from fractus_cluster.images.build import image_name
from operator_world import SYSTEM

ROOT = CHARTS.parent
WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yaml").read_text())
VERSION = yaml.safe_load((CHARTS / "fractus" / "Chart.yaml").read_text())["version"]
EVERYTHING = ("--set=view.enabled=true", "--set=uninstall.wipeNodes=true")
PARTS = ("operator", "agent", "mobility", "camera", "view")
BUILT_ON = "component"
"""The image of a release that no chart names: those of applications are built on it."""


def script(beginning: str) -> str:
    """The script of the workflow's step that starts so."""
    steps = [step for job in WORKFLOW["jobs"].values() for step in job["steps"]]
    (found,) = [step["run"] for step in steps if step.get("run", "").startswith(beginning)]
    return str(found)


def run_step(beginning: str, folder: Path, **stubs: str) -> None:
    """Run a step of the workflow for a tag, with stubs in place of programs that would reach a registry."""
    programs = folder / "programs"
    programs.mkdir(exist_ok=True)
    for name, text in stubs.items():
        (programs / name).write_text(f"#!/bin/sh\n{text}\n")
        (programs / name).chmod(0o755)
    variables = {
        "PATH": f"{programs}:{os.environ['PATH']}", "GITHUB_REPOSITORY_OWNER": "Some-One", "GITHUB_REF_NAME": f"v{VERSION}",
        "FOLDER": str(folder),
    }  # fmt: skip
    subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script(beginning)], env={**os.environ, **variables}, cwd=ROOT, timeout=60, check=True
    )  # fmt: skip


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the charts of a release, and `pushed`, the names of its images, by the workflow's own commands."""
    folder = tmp_path_factory.mktemp("release")
    run_step("make dist", folder, make=f'shift; exec {shutil.which("make")} charts DIST="$FOLDER" "$@"')
    pushes = 'while [ "$1" != --tag ]; do shift; done; echo "$2" >> "$FOLDER/pushed"'
    run_step("registry=", folder, docker=pushes, cosign="true", jq="echo sha256:0")
    return folder


def rendered(folder: Path, chart: str, *values: str) -> list[Body]:
    return render(*values, chart=folder / f"{chart}-{VERSION}.tgz")


def images_of(bodies: list[Body]) -> set[str]:
    """The images that objects name, or manifests that they keep."""
    kept = [text for body in bodies if body["kind"] == "ConfigMap" for text in body["data"].values()]
    texts = [yaml.safe_dump(bodies), *kept]
    return {name for text in texts for name in re.findall(r"^ *(?:- )?image: (\S+)$", text, re.MULTILINE)}


def test_the_charts_of_a_release_run_the_images_that_it_pushes(published: Path) -> None:
    pushed = set((published / "pushed").read_text().split())
    assert f"ghcr.io/some-one/fractus/operator:{VERSION}" in pushed
    bodies = [*rendered(published, "fractus", *EVERYTHING), *rendered(published, "fractus-demo", "--set=drone=d")]
    assert images_of(bodies) | {f"ghcr.io/some-one/fractus/{BUILT_ON}:{VERSION}"} == pushed
    assert len(pushed) == len(images_of(bodies)) + 1


def test_the_charts_of_a_checkout_run_the_images_that_are_built_from_it() -> None:
    bodies = [*render(*EVERYTHING), *render("--set=drone=d", chart=CHARTS / "fractus-demo")]
    assert images_of(bodies) == {image_name(target) for target in (*PARTS, "sim", "example-traffic-monitoring")}


def test_a_tag_that_is_said_is_taken() -> None:
    said = "--set=image.tag=1.2.3"
    bodies = [*render(*EVERYTHING, said), *render("--set=drone=d", said, chart=CHARTS / "fractus-demo")]
    assert {name.rpartition(":")[2] for name in images_of(bodies)} == {"1.2.3"}


@pytest.mark.parametrize(("tag", "said"), [("0.0.1", True), (VERSION, False), ("", False)])
def test_who_keeps_another_tag_is_told(control_plane: ControlPlane, published: Path, tag: str, *, said: bool) -> None:
    argv = [helm(), "install", "fractus", str(published / f"fractus-{VERSION}.tgz"), f"--set=image.tag={tag}"]
    argv += ["--namespace", SYSTEM, "--dry-run=server", "--kubeconfig", str(control_plane.kubeconfig)]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    notes = done.stdout.partition("NOTES:")[2]
    assert f"from the images ghcr.io/some-one/fractus/NAME:{tag or VERSION}." in notes
    assert (f"images with the tag {VERSION}; --set image.tag= takes them" in notes) is said
