"""Runs of the field experiment: programs and the requests that violate policies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fractus_sim.scenarios.field.field_site import ABOVE_STRIPE, EXAMPLE, NAVIGATOR, VIEWER, ZIGZAG, FieldSite
from fractus_sim.scenarios.scenario_evidence import Evidence
from fractus_sim.scenarios.scenario_flight import Autopilot, ScenarioProgram, ScenarioRun, fly_programs
from fractus_sim.scenarios.scenario_site import format_position

PICTURE_INTERVAL_S = 10.0
HOVER_S = 2 * PICTURE_INTERVAL_S

RUNS = (
    ScenarioRun("normal", "normal", violates=False, policies=True),
    ScenarioRun("guarded", "violating, with policies", violates=True, policies=True),
    ScenarioRun("unguarded", "violating, without policies", violates=True, policies=False),
)


def fly(
    run: ScenarioRun, site: FieldSite, autopilot: Autopilot, folder: Path, report: Callable[[str], None]
) -> Evidence:
    """Fly one run and read its evidence.

    Raises:
        ExperimentError: A process did not start, or the drone did not land before the timeout.
    """
    environment = navigator_environment(run, site, HOVER_S / autopilot.speedup)
    programs = (
        ScenarioProgram(NAVIGATOR, EXAMPLE / "navigator.py", environment),
        ScenarioProgram(
            VIEWER, EXAMPLE / "aerial_viewer.py", {"PERIOD_S": f"{PICTURE_INTERVAL_S / autopilot.speedup:.3f}"}
        ),
    )
    return fly_programs(run, site, programs, autopilot, folder=folder, report=report)


def navigator_environment(run: ScenarioRun, site: FieldSite, hover_s: float) -> dict[str, str]:
    """Return the environment of the Navigator: values of the manifest, hover position, and requested violations."""
    places = site.places
    above = f"6:{format_position(places[ABOVE_STRIPE])},{hover_s:.1f}"
    environment = {ZIGZAG: site.environment(NAVIGATOR)[ZIGZAG], "DETOURS": above}
    if not run.violates:
        return environment
    detours = f"2:{format_position(places['WP-E1'])}; {above}; 7:{format_position(places['WP-E2'])}"
    return {**environment, "ALTITUDES": "1:20,3:20,6:4", "DETOURS": detours}
