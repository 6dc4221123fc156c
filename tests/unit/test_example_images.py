"""Dockerfiles of the examples: like those of `fractus init`, and equal to the targets of the checkout's Dockerfile."""

from __future__ import annotations

import importlib.resources
import re
from pathlib import Path

import pytest
import yaml
from fractus_cluster.images.build import PREFIX, TARGETS

ROOT = Path(__file__).parents[2]
APPLICATIONS = sorted(path.parent for path in (ROOT / "examples").glob("*/application.yaml"))
PLUGINS = sorted(path.parent for path in (ROOT / "examples").glob("*/pyproject.toml"))


def instructions(text: str) -> list[str]:
    return [line for line in text.splitlines() if line and not line.startswith("#")]


@pytest.mark.parametrize("folder", [*APPLICATIONS, *PLUGINS], ids=lambda folder: folder.name)
def test_example_has_dockerfile_on_an_image_of_fractus(folder: Path) -> None:
    bases = re.findall(rf"^FROM {PREFIX}/([\w-]+):dev$", (folder / "Dockerfile").read_text(), re.MULTILINE)
    assert len(bases) == 1
    assert set(bases) <= set(TARGETS)


@pytest.mark.parametrize("folder", APPLICATIONS, ids=lambda folder: folder.name)
def test_dockerfile_of_example_builds_the_same_image_as_the_checkout(folder: Path) -> None:
    base, *steps = instructions((folder / "Dockerfile").read_text())
    _, _, target = (ROOT / "Dockerfile").read_text().partition(f"FROM component AS example-{folder.name}\n")
    expected = target.partition("FROM ")[0].replace(f"COPY examples/{folder.name}/", "COPY ")
    assert steps == instructions(expected)
    template = importlib.resources.files("fractus_cli").joinpath("new_application", "Dockerfile.template").read_text()
    assert base == instructions(template)[0]


@pytest.mark.parametrize("folder", APPLICATIONS, ids=lambda folder: folder.name)
def test_image_of_example_contains_the_programs_of_its_manifest(folder: Path) -> None:
    for application in yaml.safe_load_all((folder / "application.yaml").read_text()):
        for component in application["spec"]["components"]:
            assert component["container"]["image"] == f"{PREFIX}/example-{folder.name}:dev"
            (program,) = (part for part in component["container"]["command"] if part.endswith(".py"))
            assert (folder / Path(program).name).exists()
