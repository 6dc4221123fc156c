"""Flights of a scenario: the vehicle, its services and the programs of an Application, until the drone has landed."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fractus_runtime.audit_chain import entries
from fractus_vehicle.estimator import FULL_START_S
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.errors import ExperimentError
from fractus_sim.scenarios.scenario_evidence import Evidence, read_evidence
from fractus_sim.scenarios.scenario_site import ScenarioSite
from fractus_sim.testbeds.borrowed_autopilot import BorrowedAutopilot
from fractus_sim.testbeds.standalone_drones import CameraSetup, DroneSetup, RunningDrone, Standalone
from fractus_sim.testbeds.vehicle_settings import AutopilotConnection

DRONE = "drone-1"
PARAMETERS: Mapping[str, float] = {"WPNAV_SPEED": 500.0}
"""Autopilot parameters. The speed (cm/s) equals the maximum in the drone's description, so no policy corrects it."""

WIND = "2,240,0.5"
"""Speed (m/s), direction (degrees) and turbulence of the wind."""

FLIGHT_TIMEOUT_S = 600.0
READY_TIMEOUT_S = 180.0
POLL_S = 0.25
POSITION_TIMEOUT_S = 120.0


@dataclass(frozen=True, slots=True)
class Autopilot:
    """The vehicle of a run.

    Attributes:
        borrowed: A running autopilot. None: start a simulated one for each run.
        speedup: Factor of real time.
    """

    borrowed: BorrowedAutopilot | None
    speedup: float


@dataclass(frozen=True, slots=True)
class ScenarioRun:
    """One flight of a scenario.

    Attributes:
        policies: True if policies apply.
        violates: True if the program makes requests that policies forbid.
    """

    name: str
    title: str
    violates: bool
    policies: bool


@dataclass(frozen=True, slots=True)
class ScenarioProgram:
    """Program of a component. It runs as a process with the environment of a pod."""

    component: str
    path: Path
    environment: Mapping[str, str]


def fly_programs(
    run: ScenarioRun,
    site: ScenarioSite,
    programs: Sequence[ScenarioProgram],
    autopilot: Autopilot,
    *,
    folder: Path,
    report: Callable[[str], None],
    gateway: bool = False,
) -> Evidence:
    """Fly one run and read its evidence.

    Args:
        run: Run to fly.
        site: Manifests of the scenario.
        programs: Programs of the components. The first one is the driver.
        autopilot: Vehicle to fly.
        folder: Folder of the run. Earlier contents are removed.
        report: Called with each line about the progress.
        gateway: Start the gateway for programs that speak MAVLink.

    Raises:
        ExperimentError: A process did not start, or the drone did not land before the timeout.
    """
    shutil.rmtree(folder, ignore_errors=True)
    grants = site.grants(site.write(folder), policies=run.policies)
    with Standalone(folder) as drones:
        drone = drones.add_drone(drone_setup(site, autopilot, gateway=gateway))
        identities = {grant["spec"]["component"]: drones.grant(grant) for grant in grants}
        for program in programs:
            command = [sys.executable, str(program.path.absolute())]
            identity = identities[program.component]
            drones.run(program.path.stem, command, identity, environment=program.environment)
        _wait_landed(drones, drone, programs[0].path.stem, autopilot, report)
        if autopilot.borrowed is not None:
            report("waiting until the service has restored the fence and the parameters of the owner")
            autopilot.borrowed.wait_restored()
        drones.stop_services()
    audits = (drone.audit, drone.audit.with_name("camera.jsonl"))
    return read_evidence(run.name, run.title, policies=run.policies, tlog=drone.tlog, audits=audits)


def drone_setup(site: ScenarioSite, autopilot: Autopilot, *, gateway: bool = False) -> DroneSetup:
    """Return the configuration of the drone.

    Args:
        site: Manifests of the scenario.
        autopilot: Vehicle to fly.
        gateway: Start the gateway for programs that speak MAVLink.
    """
    borrowed = autopilot.borrowed
    return DroneSetup(
        DRONE,
        site.home,
        speedup=autopilot.speedup,
        ready_after_s=FULL_START_S,
        parameters=PARAMETERS,
        description=site.drone.spec.to_dict(),
        # The camera world needs a second link to the vehicle. A running autopilot may offer only one.
        camera=CameraSetup(("--seed", "3")) if borrowed is None else CameraSetup(None),
        vehicle_arguments=("--wind", WIND),
        autopilot=borrowed.link if borrowed is not None else None,
        state=borrowed.service_state if borrowed is not None else None,
        gateway=gateway,
    )


def _wait_landed(
    drones: Standalone, drone: RunningDrone, program: str, autopilot: Autopilot, report: Callable[[str], None]
) -> None:
    """Wait until the mobility service reports the landing.

    Raises:
        ExperimentError: The drone did not take off or land before the timeout, or a process ended.
    """
    began_s = time.monotonic()
    reported = 0
    flown = False
    while True:
        log = list(entries(drone.audit.read_bytes().splitlines() if drone.audit.exists() else ()))
        control = [e for e in log if e.get("kind") in ("control", "takeover")]
        for entry in control[reported:]:
            reason = f": {entry['reason']}" if entry.get("reason") else ""
            report(f"{entry.get('action')}{reason}")
        reported = len(control)
        flown = flown or any(e.get("in_air") for e in log if e.get("kind") == "state")
        if flown and any(e.get("action") in {"landed", "stopped"} for e in control):
            return
        waited_s = time.monotonic() - began_s
        if not flown and waited_s > READY_TIMEOUT_S:
            raise ExperimentError(
                f"the drone did not take off within {READY_TIMEOUT_S:.0f} s: {drones.processes.log_tail(program)}"
            )
        if waited_s > READY_TIMEOUT_S + FLIGHT_TIMEOUT_S / autopilot.speedup:
            raise ExperimentError(f"the drone was not home within {waited_s:.0f} s; last control entry: {control[-1:]}")
        drones.check()
        time.sleep(POLL_S)


@dataclass(frozen=True, slots=True)
class ParkedVehicle:
    """Position of an autopilot: latitude, longitude, altitude above mean sea level."""

    system_id: int
    home: tuple[float, float, float]


def find_parked_vehicle(link: str, report: Callable[[str], None]) -> ParkedVehicle:
    """Wait until an ArduPilot vehicle on the ground has a position, then close the link.

    Raises:
        ExperimentError: The autopilot does not respond, is not ArduPilot, is flying, or has no position before the
            timeout.
    """
    with AutopilotConnection.open(link) as connection:
        report(f"vehicle {connection.system_id} at {link}; waiting for its position")
        connection.wait(
            lambda m: m.name == "GPS_RAW_INT" and m.integer("fix_type") >= mavlink.GPS_FIX_TYPE_3D_FIX,
            POSITION_TIMEOUT_S,
            "no GPS fix",
            "GPS_RAW_INT",
        )
        home = connection.wait(
            lambda m: m.name == "HOME_POSITION", POSITION_TIMEOUT_S, "no home position", "HOME_POSITION"
        )
        place = (home.integer("latitude") / 1e7, home.integer("longitude") / 1e7, home.integer("altitude") / 1000.0)
        return ParkedVehicle(connection.system_id, place)
