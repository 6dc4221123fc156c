"""Rendered charts with default values and with everything enabled, compared with golden files.

Run with FRACTUS_GOLDEN=write to update them.
"""

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
    """Return the objects of a chart as sorted YAML. Replace the version, so that a release changes no golden file."""
    bodies = render(*arguments, chart=chart)
    bodies.sort(key=lambda body: (body["kind"], body["metadata"].get("namespace", ""), body["metadata"]["name"]))
    version = yaml.safe_load((CHARTS / chart / "Chart.yaml").read_text())["version"]
    return yaml.safe_dump_all(bodies, width=120).replace(f"-{version}", "-VERSION").replace(f":{version}", ":VERSION")


@pytest.mark.parametrize("case", CASES)
def test_rendered_chart_matches_golden_file(case: str) -> None:
    path = GOLDEN / f"{case}.yaml"
    text = made(*CASES[case])
    if os.environ.get("FRACTUS_GOLDEN") == "write":
        path.write_text(text)
    assert text == path.read_text()


def test_chart_golden_files_have_cases() -> None:
    assert {path.stem for path in GOLDEN.glob("*.yaml")} == set(CASES)


@pytest.mark.parametrize("chart", EVERYTHING)
def test_chart_golden_case_sets_every_value(chart: str) -> None:
    said = yaml.safe_load(EVERYTHING[chart].read_text())

    def given(name: str) -> Any:
        found = said
        for part in name.split("."):
            found = (found or {}).get(part)
        return found

    for name, value in values_of(chart):
        if value is False or value in ("", [], {}):
            assert given(name), f"{EVERYTHING[chart]}: {name}"


def test_crds_chart_renders_generated_crds_with_keep_policy() -> None:
    """The files crds/*.yaml serve as the golden files of fractus-crds."""
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
def test_helm_show_readme_lists_values(chart: str) -> None:
    argv = [helm(), "show", "readme", str(CHARTS / chart)]
    shown = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=True).stdout
    assert "| Value | Default | Meaning |" in shown
    assert shown.strip() == (CHARTS / chart / "README.md").read_text().strip()
