"""Runs of the monitor scenario: the declared course and the deviating course, with and without policies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fractus_sim.scenarios.monitor.monitor_site import (
    COURSE,
    DECLARED,
    DEVIATING,
    DRIVER,
    EXAMPLE,
    PHOTOGRAPHER,
    MonitorSite,
)
from fractus_sim.scenarios.scenario_evidence import Evidence
from fractus_sim.scenarios.scenario_flight import Autopilot, ScenarioProgram, ScenarioRun, fly_programs
from fractus_sim.scenarios.scenario_site import format_position

PICTURE_INTERVAL_S = 4.0
LEG_TIMEOUT_S = 60.0
"""Time in which the drone reaches each position of the course. The program sends a target again after a third of this time."""

RUNS = (
    ScenarioRun("monitored", "deviating, with policies", violates=True, policies=True),
    ScenarioRun("unmonitored", "deviating, without policies", violates=True, policies=False),
    ScenarioRun("declared", "declared course, with policies", violates=False, policies=True),
    ScenarioRun("pictures", "declared course, without policies", violates=False, policies=False),
)


def fly(
    run: ScenarioRun, site: MonitorSite, autopilot: Autopilot, folder: Path, report: Callable[[str], None]
) -> Evidence:
    """Fly one run and read its evidence.

    Raises:
        ExperimentError: A process did not start, or the drone did not land before the timeout.
    """
    names = DEVIATING if run.violates else DECLARED
    course = "; ".join(format_position(site.places[name]) for name in names)
    timeout = f"{LEG_TIMEOUT_S / autopilot.speedup:.1f}"
    interval = f"{PICTURE_INTERVAL_S / autopilot.speedup:.3f}"
    pictures = str(pictures_folder(folder).absolute())
    programs = (
        ScenarioProgram(DRIVER, EXAMPLE / "waypoints.py", {COURSE: course, "LEG_TIMEOUT_S": timeout}),
        ScenarioProgram(PHOTOGRAPHER, EXAMPLE / "photographer.py", {"PERIOD_S": interval, "PICTURES": pictures}),
    )
    return fly_programs(run, site, programs, autopilot, folder=folder, report=report, gateway=True)


def pictures_folder(folder: Path) -> Path:
    """Return the folder in which the Photographer stores its pictures."""
    return folder / "photographer"
