"""Example of a user-defined heuristic: its tests pass, and agents find it after installation."""

from __future__ import annotations

import importlib
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from fractus_core.api.components import Heuristic
from fractus_core.linking import UnknownHeuristic, find_heuristic

EXAMPLE = Path(__file__).parents[2] / "examples" / "heuristic-plugin"
PROJECT = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Install the example package, and return the name of its heuristic."""
    (entries,) = PROJECT["entry-points"].items()
    (name,) = entries[1]
    metadata = tmp_path / "acme_heuristics-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {PROJECT['name']}\nVersion: {PROJECT['version']}\n"
    )
    (metadata / "entry_points.txt").write_text(f"[{entries[0]}]\n{name} = {entries[1][name]}\n")
    for module in EXAMPLE.glob("*.py"):
        (tmp_path / module.name).write_bytes(module.read_bytes())
    monkeypatch.syspath_prepend(tmp_path)
    return str(name)


def test_example_tests_of_heuristic_plugin_pass(installed: str) -> None:
    tests = vars(importlib.import_module("test_acme_heuristics"))
    tests_of_example = [test for name, test in tests.items() if name.startswith("test_")]
    assert tests_of_example
    for test in tests_of_example:
        test()


def test_installed_heuristic_is_found_by_the_name_in_the_manifest(installed: str) -> None:
    manifest = (EXAMPLE / "README.md").read_text()
    (line,) = [line for line in manifest.splitlines() if "heuristic:" in line]
    named = Heuristic.model_validate(yaml.safe_load(line.strip())["heuristic"])
    assert named.kind == installed
    heuristic: Any = find_heuristic(named.kind, named.metric)
    assert heuristic.__name__ == "least_cost"


def test_heuristic_of_missing_package_is_unknown() -> None:
    with pytest.raises(UnknownHeuristic, match="acme-least-cost"):
        find_heuristic("acme-least-cost")
