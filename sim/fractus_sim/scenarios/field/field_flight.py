"""Execution of one run: vehicle, services and both example programs as processes, until the drone has landed."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus_radio.follower import parse_address
from fractus_runtime.audit_chain import entries
from fractus_runtime.mavlink_codec import Endpoint, Message, Value, message_id
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
    Field,
    as_text,
)
from fractus_sim.testbeds.ground_station import OBSERVER_ID, STATION_COMPONENT, TcpLink
from fractus_sim.testbeds.standalone_drones import CameraSetup, DroneSetup, RunningDrone, Standalone

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


CONNECT_S = 5.0
HEARTBEAT_S = 15.0
POSITION_TIMEOUT_S = 120.0
ASK_S = 1.0
LINK_POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class ParkedVehicle:
    """Position of an autopilot: latitude, longitude, altitude above mean sea level."""

    system_id: int
    home: tuple[float, float, float]


def parse_link(text: str) -> tuple[str, int]:
    """Parse `tcp:HOST:PORT`.

    Raises:
        ExperimentError: The text has a different format.
    """
    try:
        return parse_address(text)
    except ValueError:
        raise ExperimentError(f"autopilot {text!r}: expected tcp:HOST:PORT") from None


def look(link: str, tell: Callable[[str], None]) -> ParkedVehicle:
    """Wait until an ArduPilot vehicle on the ground has a position, then close the link.

    Raises:
        ExperimentError: The autopilot does not respond, is not ArduPilot, is flying, or has no position before the
            timeout.
    """
    host, port = parse_link(link)
    visitor = _Visitor(TcpLink.connect(host, port, CONNECT_S))
    try:
        heartbeat = visitor.wait(
            lambda m: m.name == "HEARTBEAT" and m.compid == mavlink.MAV_COMP_ID_AUTOPILOT1, HEARTBEAT_S, "no heartbeat"
        )
        if heartbeat.integer("autopilot") != mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
            raise ExperimentError(f"the autopilot at {link} is no ArduPilot")
        if heartbeat.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
            raise ExperimentError(f"the vehicle at {link} is armed; land and disarm it first")
        visitor.system_id = heartbeat.sysid
        tell(f"vehicle {heartbeat.sysid} at {link}; waiting for its position")
        visitor.ask("GPS_RAW_INT")
        visitor.wait(
            lambda m: m.name == "GPS_RAW_INT" and m.integer("fix_type") >= mavlink.GPS_FIX_TYPE_3D_FIX,
            POSITION_TIMEOUT_S,
            "no GPS fix",
            "GPS_RAW_INT",
        )
        home = visitor.wait(
            lambda m: m.name == "HOME_POSITION", POSITION_TIMEOUT_S, "no home position", "HOME_POSITION"
        )
    finally:
        visitor.close()
    place = (home.integer("latitude") / 1e7, home.integer("longitude") / 1e7, home.integer("altitude") / 1000.0)
    return ParkedVehicle(heartbeat.sysid, place)


class _Visitor:
    """A short exchange over one link."""

    def __init__(self, link: TcpLink) -> None:
        self.system_id = 0
        self._link = link
        self._endpoint = Endpoint(OBSERVER_ID, STATION_COMPONENT)

    def ask(self, name: str) -> None:
        """Request one message of a type."""
        values: dict[str, Value] = {"command": int(mavlink.MAV_CMD_REQUEST_MESSAGE), "param1": float(message_id(name))}
        values |= {"target_system": self.system_id, "target_component": 1}
        self._link.send(self._endpoint.encode("COMMAND_LONG", values))

    def wait(self, wanted: Callable[[Message], bool], timeout_s: float, missing: str, asking: str = "") -> Message:
        """Return the first matching message. `asking` repeats the request every second.

        Raises:
            ExperimentError: No message matched before the timeout.
        """
        deadline = time.monotonic() + timeout_s
        next_ask = time.monotonic()
        while time.monotonic() < deadline:
            if asking and time.monotonic() >= next_ask:
                next_ask += ASK_S
                self.ask(asking)
            for message in self._endpoint.decode(self._link.receive()):
                if wanted(message):
                    return message
            time.sleep(LINK_POLL_S)
        raise ExperimentError(f"{missing} from the autopilot within {timeout_s:.0f} s")

    def close(self) -> None:
        """Close the link."""
        self._link.close()
