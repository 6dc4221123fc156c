"""Flight of one run: vehicle, services and both example programs as processes, until the drone has landed."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus_runtime.audit_chain import entries
from fractus_vehicle.estimator import FULL_START_S
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.errors import ExperimentError
from fractus_sim.scenarios.field.field_evidence import Evidence, read_evidence
from fractus_sim.scenarios.field.field_site import (
    ABOVE_STRIPE,
    DRONE,
    EXAMPLE,
    NAVIGATOR,
    VIEWER,
    ZIGZAG,
    FieldSite,
    format_position,
)
from fractus_sim.testbeds.borrowed_autopilot import BorrowedAutopilot
from fractus_sim.testbeds.standalone_drones import CameraSetup, DroneSetup, RunningDrone, Standalone
from fractus_sim.testbeds.vehicle_settings import AutopilotConnection

PICTURE_INTERVAL_S = 10.0
HOVER_S = 2 * PICTURE_INTERVAL_S
FLIGHT_TIMEOUT_S = 600.0
READY_TIMEOUT_S = 180.0
POLL_S = 0.25
PARAMETERS: Mapping[str, float] = {"WPNAV_SPEED": 500.0}
"""Autopilot parameters. The speed (cm/s) equals the maximum in the drone's description, so no policy corrects it."""

WIND = "2,240,0.5"
"""Speed (m/s), direction (degrees) and turbulence of the wind."""

POSITION_TIMEOUT_S = 120.0


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
        borrowed: A running autopilot. None: start a simulated one for each run.
        speedup: Factor of real time.
    """

    borrowed: BorrowedAutopilot | None
    speedup: float


def fly(run: Run, site: FieldSite, autopilot: Autopilot, folder: Path, report: Callable[[str], None]) -> Evidence:
    """Fly one run and read its evidence.

    Raises:
        ExperimentError: A process did not start, or the drone did not land before the timeout.
    """
    shutil.rmtree(folder, ignore_errors=True)
    manifests = site.write(folder)
    grants = site.grants(manifests, policies=run.policies)
    with Standalone(folder) as drones:
        drone = drones.add_drone(drone_setup(site, autopilot))
        identities = {grant["spec"]["component"]: drones.grant(grant) for grant in grants}
        environment = navigator_environment(run, site, HOVER_S / autopilot.speedup)
        programs = {NAVIGATOR: "navigator", VIEWER: "aerial_viewer"}
        interval = {"PERIOD_S": f"{PICTURE_INTERVAL_S / autopilot.speedup:.3f}"}
        for component, program in programs.items():
            command = [sys.executable, str(EXAMPLE.absolute() / f"{program}.py")]
            drones.run(program, command, identities[component], environment={**environment, **interval})
        _wait_landed(drones, drone, autopilot, report)
        if autopilot.borrowed is not None:
            report("waiting until the service has restored the fence and the parameters of the owner")
            autopilot.borrowed.wait_restored()
        drones.stop_services()
    audits = (drone.audit, drone.audit.with_name("camera.jsonl"))
    return read_evidence(run.name, run.title, policies=run.policies, tlog=drone.tlog, audits=audits)


def navigator_environment(run: Run, site: FieldSite, hover_s: float) -> dict[str, str]:
    """Return the environment of the Navigator: values of the manifest, hover position, and requested violations."""
    places = site.places
    above = f"6:{format_position(places[ABOVE_STRIPE])},{hover_s:.1f}"
    environment = {ZIGZAG: site.environment[ZIGZAG], "DETOURS": above}
    if not run.violates:
        return environment
    detours = f"2:{format_position(places['WP-E1'])}; {above}; 7:{format_position(places['WP-E2'])}"
    return {**environment, "ALTITUDES": "1:20,3:20,6:4", "DETOURS": detours}


def drone_setup(site: FieldSite, autopilot: Autopilot) -> DroneSetup:
    """Return the configuration of the drone."""
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
    )


def _wait_landed(drones: Standalone, drone: RunningDrone, autopilot: Autopilot, report: Callable[[str], None]) -> None:
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
                f"the drone did not take off within {READY_TIMEOUT_S:.0f} s: {drones.processes.log_tail('navigator')}"
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
