"""What the charts make, by their defaults and with everything switched on, against golden files; FRACTUS_GOLDEN=write renews them."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import CHARTS, EVERYTHING, helm, render, values_of

GOLDEN = Path(__file__).parents[1] / "golden" / "charts"
CASES = {
    "fractus": ("fractus",),
    "fractus-everything": ("fractus", f"--values={EVERYTHING['fractus']}", "--is-upgrade"),
    "fractus-demo": ("fractus-demo", "--set=drone=drone-1"),
    "fractus-demo-everything": ("fractus-demo", f"--values={EVERYTHING['fractus-demo']}"),
}


def made(chart: str, *arguments: str) -> str:
    """The objects of a chart in one order, whatever its version is: a release changes no golden file."""
    bodies = render(*arguments, chart=chart)
    bodies.sort(key=lambda body: (body["kind"], body["metadata"].get("namespace", ""), body["metadata"]["name"]))
    version = yaml.safe_load((CHARTS / chart / "Chart.yaml").read_text())["version"]
    return yaml.safe_dump_all(bodies, width=120).replace(f"-{version}", "-VERSION").replace(f":{version}", ":VERSION")


@pytest.mark.parametrize("case", CASES)
def test_charts_make_what_the_golden_files_say(case: str) -> None:
    path, text = GOLDEN / f"{case}.yaml", made(*CASES[case])
    if os.environ.get("FRACTUS_GOLDEN") == "write":
        path.write_text(text)
    assert text == path.read_text()


def test_every_golden_file_has_its_case() -> None:
    assert {path.stem for path in GOLDEN.glob("*.yaml")} == set(CASES)


@pytest.mark.parametrize("chart", EVERYTHING)
def test_everything_is_switched_on_and_set(chart: str) -> None:
    said = yaml.safe_load(EVERYTHING[chart].read_text())

    def given(name: str) -> Any:
        found = said
        for part in name.split("."):
            found = (found or {}).get(part)
        return found

    for name, value in values_of(chart):
        if value is False or value in ("", [], {}):
            assert given(name), f"{EVERYTHING[chart]}: {name}"


def test_the_kinds_are_the_generated_ones_and_kept() -> None:
    """The golden files of fractus-crds are crds/*.yaml."""
    for keep, kept in ((True, {"helm.sh/resource-policy": "keep"}), (False, {})):
        bodies = {
            body["metadata"]["name"]: body for body in render(f"--set=keep={str(keep).lower()}", chart="fractus-crds")
        }
        for path in (CHARTS.parent / "crds").glob("*.yaml"):
            body = yaml.safe_load(path.read_text())
            if kept:
                body["metadata"]["annotations"] = body["metadata"].get("annotations", {}) | kept
            assert bodies.pop(body["metadata"]["name"]) == body
        assert bodies == {}


@pytest.mark.parametrize("chart", ["fractus", "fractus-crds", "fractus-demo"])
def test_helm_shows_what_can_be_set(chart: str) -> None:
    argv = [helm(), "show", "readme", str(CHARTS / chart)]
    shown = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=True).stdout
    assert "| Value | Default | Meaning |" in shown
    assert shown.strip() == (CHARTS / chart / "README.md").read_text().strip()
