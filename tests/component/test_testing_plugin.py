"""pytest plugin: fixture, marker, seeds, artifacts of failed tests, and options."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

pytest_plugins = ["pytester"]

FLIGHT = """
import pytest

@pytest.mark.fractus(seed=3{marker})
def test_hop(fractus):
    drone = fractus.vDrone("vDrone-1")
    drone.set_pos((50.8637, 4.6785, 25.0))
    drone.set_task({{"do": "takeoff", "alt": 3}}, {{"do": "land"}})
    drone.start_app()
    drone.wait_landed(60)
    fractus.results().check("reached", north={north}, east=0)
"""


def flight(*, north: float = 0.0, marker: str = "") -> str:
    return FLIGHT.format(north=north, marker=marker)


def folders(pytester: pytest.Pytester) -> list[Path]:
    out = pytester.path / "out" / "tests"
    return sorted(out.iterdir()) if out.exists() else []


def test_failed_test_shows_its_artifacts_and_keeps_its_folder(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(flight(north=50))
    result = pytester.runpytest_inprocess("--junit-xml=junit.xml")
    result.assert_outcomes(failed=1)
    (folder,) = folders(pytester)
    result.stdout.fnmatch_lines(
        [
            "*AssertionError: vdrone-1: reached: *does not hold*",
            "*- fractus -*",
            f"folder: {folder}",
            f"map: {folder}/map.png",
        ]
    )
    properties = {p.get("name"): p.get("value") for p in ET.parse(pytester.path / "junit.xml").iter("property")}
    assert properties == {"fractus_seed": "3", "fractus_folder": str(folder), "fractus_map": f"{folder}/map.png"}
    assert (folder / "summary.md").exists()


@pytest.mark.parametrize(("load", "shown"), [(64.0, True), (0.5, False)])
def test_failed_test_shows_if_the_computer_is_busy(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, load: float, shown: bool
) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    pytester.makepyfile("def test_nothing(fractus):\n    fractus.vDrone('vDrone-1').start_app()\n")
    text = pytester.runpytest_inprocess().stdout.str()
    assert ("the computer is busy: load 64.0 on 2 processors; try --fractus-speedup 1" in text) is shown


def test_speedup_above_zero_is_required(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("def test_nothing(fractus): pass")
    result = pytester.runpytest_inprocess("--fractus-speedup", "0")
    assert result.ret != 0
    result.stdout.fnmatch_lines(["*--fractus-speedup 0: specify a number above 0*"])


def test_passed_test_leaves_its_folder_only_on_request(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(flight())
    pytester.runpytest_inprocess().assert_outcomes(passed=1)
    assert not folders(pytester)
    pytester.runpytest_inprocess("--fractus-keep", "--fractus-out", "kept").assert_outcomes(passed=1)
    (folder,) = (pytester.path / "kept").iterdir()
    assert (folder / "summary.md").exists()


def test_test_is_repeated_with_each_seed(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(flight(marker=", seeds=2"))
    result = pytester.runpytest_inprocess("-v", "--junit-xml=junit.xml")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*test_hop[[]seed3[]] PASSED*", "*test_hop[[]seed4[]] PASSED*"])
    seeds = [p.get("value") for p in ET.parse(pytester.path / "junit.xml").iter("property")]
    assert seeds == ["3", "4"]


def test_test_runs_as_often_as_the_option_requires(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(flight(marker=", seeds=2"))
    names = ["seed3-run1", "seed4-run1", "seed3-run2", "seed4-run2"]
    result = pytester.runpytest_inprocess("--collect-only", "-q", "--fractus-repeats", "2")
    result.stdout.fnmatch_lines([f"*::test_hop[[]{name}[]]" for name in names])
    pytester.makepyfile("def test_nothing(fractus): pass")
    result = pytester.runpytest_inprocess("--fractus-repeats", "0")
    assert result.ret != 0
    result.stdout.fnmatch_lines(["*--fractus-repeats 0: specify 1 or more*"])


def test_unknown_field_of_the_marker_is_named(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(flight(marker=", speed=2"))
    result = pytester.runpytest_inprocess()
    assert result.ret != 0
    result.stdout.fnmatch_lines(["*marker fractus: unknown field speed; known: seed, seeds, speedup*"])


def test_error_before_the_flight_fails_the_test_with_its_remedy(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("def test_nothing(fractus):\n    fractus.vDrone('vDrone-1').start_app()\n")
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*vDrone-1 has no program; call set_app() or set_task() first", "folder: *"])


@pytest.mark.slow
def test_tests_run_in_parallel_workers(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(test_one=flight(), test_two=flight(), test_three=flight())
    result = pytester.runpytest_subprocess("-n", "2", "-p", "xdist")
    result.assert_outcomes(passed=3)


def test_plugin_imports_no_large_library() -> None:
    """Every run of pytest in an environment with the plugin imports it."""
    program = "import fractus_pytest, sys; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    packages = {module.partition(".")[0] for module in result.stdout.split()}
    assert not packages & {"numpy", "shapely", "pydantic", "grpc", "fractus_core", "fractus_sim", "fractus_testing"}
