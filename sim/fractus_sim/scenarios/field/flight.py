"""Execution of one run: vehicle, services and both example programs as processes, until the drone has landed."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus_runtime.audit_chain import entries
from fractus_vehicle.estimator import FULL_START_S

from fractus_sim.experiment.errors import ExperimentError
from fractus_sim.experiment.standalone import Standalone
from fractus_sim.experiment.standalone_drone import CameraSetup, DroneSetup, RunningDrone
from fractus_sim.scenarios.field.evidence import Evidence, read_evidence
from fractus_sim.scenarios.field.place import ABOVE_STRIPE, DRONE, EXAMPLE, NAVIGATOR, VIEWER, ZIGZAG, Field, as_text

PERIOD_S = 10.0
STAY_S = 2 * PERIOD_S
FLIGHT_TIMEOUT_S = 600.0
READY_TIMEOUT_S = 180.0
POLL_S = 0.25
# Speed of the simulated vehicle. It equals the maximum speed in the drone's description, so nothing is corrected.
PARAMETERS: Mapping[str, float] = {"WPNAV_SPEED": 500.0}
WIND = "2,240,0.5"


@dataclass(frozen=True, slots=True)
class Run:
    """One of the three flights.

    Attributes:
        violates: True if the program makes requests that policies forbid.
        policies: True if policies apply.
    """

    name: str
    title: str
    violates: bool
    policies: bool


RUNS = (
    Run("normal", "normal", violates=False, policies=True),
    Run("guarded", "violating, with policies", violates=True, policies=True),
    Run("unguarded", "violating, without policies", violates=True, policies=False),
)


@dataclass(frozen=True, slots=True)
class Autopilot:
    """The vehicle of a run.

    Attributes:
        link: Endpoint of a running autopilot, such as `tcp:127.0.0.1:5760`. None: a simulated autopilot per run.
        speedup: Factor of real time.
    """

    link: str | None
    speedup: float


def fly(run: Run, field: Field, autopilot: Autopilot, folder: Path, tell: Callable[[str], None]) -> Evidence:
    """Fly one run and read its evidence.

    Raises:
        ExperimentError: A process did not start, or the drone did not land before the timeout.
    """
    shutil.rmtree(folder, ignore_errors=True)
    manifests = field.write(folder)
    grants = field.grants(manifests, policies=run.policies)
    with Standalone(folder) as ground:
        drone = ground.add_drone(_setup(field, autopilot))
        identities = {grant["spec"]["component"]: ground.grant(grant) for grant in grants}
        extra = _environment(run, field, STAY_S / autopilot.speedup)
        programs = {NAVIGATOR: "navigator", VIEWER: "aerial_viewer"}
        period = {"PERIOD_S": f"{PERIOD_S / autopilot.speedup:.3f}"}
        for component, program in programs.items():
            command = [sys.executable, str(EXAMPLE.absolute() / f"{program}.py")]
            ground.run(program, command, identities[component], environment={**extra, **period})
        _wait_home(ground, drone, autopilot, tell)
        ground.stop_services()
    audits = (drone.audit, drone.audit.with_name("camera.jsonl"))
    return read_evidence(run.name, run.title, policies=run.policies, tlog=drone.tlog, audits=audits)


def _environment(run: Run, field: Field, stay_s: float) -> dict[str, str]:
    """Return the environment of the Navigator: manifest values, hover position above the stripe, and violations."""
    places = field.places
    above = f"6:{as_text(places[ABOVE_STRIPE])},{stay_s:.1f}"
    told = {ZIGZAG: field.environment[ZIGZAG], "DETOURS": above}
    if not run.violates:
        return told
    detours = f"2:{as_text(places['WP-E1'])}; {above}; 7:{as_text(places['WP-E2'])}"
    return {**told, "ALTITUDES": "1:20,3:20,6:4", "DETOURS": detours}


def _setup(field: Field, autopilot: Autopilot) -> DroneSetup:
    simulated = autopilot.link is None
    return DroneSetup(
        DRONE,
        field.home,
        speedup=autopilot.speedup,
        ready_after_s=FULL_START_S,
        parameters=PARAMETERS,
        description=field.drone.spec.to_dict(),
        # The camera world needs a second link to the vehicle, which a running autopilot may not offer.
        camera=CameraSetup(("--seed", "3")) if simulated else CameraSetup(None),
        vehicle_arguments=("--wind", WIND),
        autopilot=autopilot.link,
    )


def _wait_home(ground: Standalone, drone: RunningDrone, autopilot: Autopilot, tell: Callable[[str], None]) -> None:
    """Wait until the mobility service reports the landing.

    Raises:
        ExperimentError: The drone did not take off or land before the timeout, or a process ended.
    """
    began_s = time.monotonic()
    said = 0
    flown = False
    while True:
        log = list(entries(drone.audit.read_bytes().splitlines() if drone.audit.exists() else ()))
        control = [e for e in log if e.get("kind") in ("control", "takeover")]
        for entry in control[said:]:
            tell(f"{entry.get('action')}{': ' + entry['reason'] if entry.get('reason') else ''}")
        said = len(control)
        flown = flown or any(e.get("in_air") for e in log if e.get("kind") == "state")
        if flown and any(e.get("action") == "landed" for e in control):
            return
        waited_s = time.monotonic() - began_s
        if not flown and waited_s > READY_TIMEOUT_S:
            raise ExperimentError(
                f"the drone did not take off within {READY_TIMEOUT_S:.0f} s: {ground.processes.log_tail('navigator')}"
            )
        if waited_s > READY_TIMEOUT_S + FLIGHT_TIMEOUT_S / autopilot.speedup:
            raise ExperimentError(f"the drone was not home within {waited_s:.0f} s; its last word: {control[-1:]}")
        ground.check()
        time.sleep(POLL_S)
