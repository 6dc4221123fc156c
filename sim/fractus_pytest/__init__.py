"""pytest plugin `fractus`: the fixture `fractus`, which is the scene of one test, and its marker and options.

The plugin is a package of its own, because every run of pytest in its environment imports it, and the import of
`fractus_testing` takes a second.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from fractus_testing import Scene

MARKER = "fractus"
_MARKER_FIELDS = frozenset({"speedup", "seed", "seeds"})
_SCENE = pytest.StashKey["Scene"]()
_FAILED = pytest.StashKey[bool]()
_MAX_NAME = 80

BUSY_LOAD = 1.5
"""Running programs per processor above which services may react too late at a high speedup."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the plugin."""
    group = parser.getgroup("fractus", "tests with virtual drones")
    group.addoption(
        "--fractus-out", type=Path, default=Path("out/tests"), help="Folder of the tests' logs and reports. [out/tests]"
    )
    group.addoption("--fractus-keep", action="store_true", help="Keep the folders of passed tests, with their reports.")
    group.addoption(
        "--fractus-speedup", type=float, metavar="X",
        help="Highest factor of real time of tests with services, whatever their markers contain. Use 1 on a busy computer.",
    )  # fmt: skip
    group.addoption(
        "--fractus-repeats", type=int, default=1, metavar="N",
        help="Run each test with virtual drones N times, to find tests that do not always pass. [1]",
    )  # fmt: skip


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line(
        "markers",
        "fractus(speedup, seed, seeds): factor of real time, seed of wind and noise, number of seeds to repeat the test with",
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Repeat a test with several seeds, and as often as the option requires.

    Raises:
        UsageError: The marker has an unknown field, or the number of repeats is below 1.
    """
    if "fractus_seed" not in metafunc.fixturenames:
        return
    fields = _marker_fields(metafunc.definition)
    repeats = int(metafunc.config.getoption("fractus_repeats"))
    if repeats < 1:
        raise pytest.UsageError(f"--fractus-repeats {repeats}: specify 1 or more")
    if "seeds" not in fields and repeats == 1:
        return
    first = int(fields.get("seed", 1))
    cases = [
        (seed, f"seed{seed}" if repeats == 1 else f"seed{seed}-run{run}")
        for run in range(1, repeats + 1)
        for seed in range(first, first + int(fields.get("seeds", 1)))
    ]
    metafunc.parametrize("fractus_seed", [seed for seed, _ in cases], indirect=True, ids=[name for _, name in cases])


@pytest.fixture
def fractus_seed(request: pytest.FixtureRequest) -> int:
    """Seed of wind and noise of the test."""
    default = _marker_fields(request.node).get("seed", 1)
    return int(getattr(request, "param", default))


@pytest.fixture
def fractus(request: pytest.FixtureRequest, fractus_seed: int, record_property: Any) -> Iterator[Scene]:
    """Scene of the test: virtual drones and controllers. All processes end with the test."""
    from fractus_testing import Scene  # noqa: PLC0415 - the import takes a second

    config = request.config
    fields = _marker_fields(request.node)
    speedup = fields.get("speedup")
    folder = (config.rootpath / config.getoption("fractus_out")) / _folder_name(request.node.nodeid)
    record_property("fractus_seed", fractus_seed)
    highest = config.getoption("fractus_speedup")
    if highest is not None and not highest > 0:
        raise pytest.UsageError(f"--fractus-speedup {highest:g}: specify a number above 0")
    with Scene(
        folder,
        base=request.path.parent,
        speedup=None if speedup is None else float(speedup),
        max_speedup=highest,
        seed=fractus_seed,
    ) as scene:
        request.node.stash[_SCENE] = scene
        yield scene
        keep = bool(config.getoption("fractus_keep"))
        if keep and not request.node.stash.get(_FAILED, False):
            scene.write_report()
            record_property("fractus_folder", str(folder))
    if not keep and not request.node.stash.get(_FAILED, False):
        shutil.rmtree(folder, ignore_errors=True)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add folder, map, last verdicts and logs to the report of a failed test, and the folder to its properties."""
    report = yield
    scene = item.stash.get(_SCENE, None)
    if call.when != "call" or scene is None or not report.failed:
        return report
    item.stash[_FAILED] = True
    item.user_properties.append(("fractus_folder", str(scene.folder)))
    try:
        lines = scene.write_report()
    except Exception as error:
        lines = [f"folder: {scene.folder}", f"the report could not be written: {error}"]
    report.sections.append(("fractus", "\n".join([*lines, *_busy_lines()])))
    if (scene.folder / "map.png").exists():
        item.user_properties.append(("fractus_map", str(scene.folder / "map.png")))
    return report


def _marker_fields(node: pytest.Item | pytest.Function | Any) -> dict[str, Any]:
    """Return the fields of the closest marker.

    Raises:
        UsageError: A field is unknown.
    """
    marker = node.get_closest_marker(MARKER)
    if marker is None:
        return {}
    unknown = sorted(set(marker.kwargs) - _MARKER_FIELDS)
    if unknown or marker.args:
        problem = f"unknown field {unknown[0]}" if unknown else "fields need names"
        message = f"{node.nodeid}: marker fractus: {problem}; known: {', '.join(sorted(_MARKER_FIELDS))}"
        raise pytest.UsageError(message)
    return dict(marker.kwargs)


def _busy_lines() -> list[str]:
    """Return a remark for the report of a failed test if the computer has too many running programs for its processors."""
    load = os.getloadavg()[0]
    processors = os.cpu_count() or 1
    if load <= BUSY_LOAD * processors:
        return []
    return [f"the computer is busy: load {load:.1f} on {processors} processors; try --fractus-speedup 1"]


def _folder_name(nodeid: str) -> str:
    """Return a folder name that is unique for a test."""
    name = re.sub(r"[^A-Za-z0-9]+", "-", nodeid.rpartition("/")[2]).strip("-")
    digest = hashlib.sha256(nodeid.encode()).hexdigest()[:8]
    return f"{name[:_MAX_NAME]}-{digest}"
