"""The example of a heuristic of a user's own: its tests pass, and agents find it once it is installed."""

from __future__ import annotations

import importlib
import tomllib
from pathlib import Path

import pytest
import yaml
from fractus_core.api.components import Heuristic
from fractus_core.linking import UnknownHeuristic, heuristic

EXAMPLE = Path(__file__).parents[2] / "examples" / "heuristic-plugin"
PROJECT = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The package as an installer leaves it; the name of its heuristic."""
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


def test_its_tests_pass(installed: str) -> None:
    tests = vars(importlib.import_module("test_acme_heuristics"))
    found = [test for name, test in tests.items() if name.startswith("test_")]
    assert found
    for test in found:
        test()


def test_it_is_found_by_the_name_that_the_manifest_gives(installed: str) -> None:
    manifest = (EXAMPLE / "README.md").read_text()
    (line,) = [line for line in manifest.splitlines() if "heuristic:" in line]
    named = Heuristic.model_validate(yaml.safe_load(line.strip())["heuristic"])
    assert named.kind == installed
    assert heuristic(named.kind, named.metric).__name__ == "least_cost"


def test_without_the_package_it_is_unknown() -> None:
    with pytest.raises(UnknownHeuristic, match="acme-least-cost"):
        heuristic("acme-least-cost")
