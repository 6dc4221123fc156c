"""Probe of a running autopilot: identity, position, and readiness to fly."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from fractus_radio.follower import parse_address
from fractus_runtime.mavlink_codec import Endpoint, Message, Value, message_id
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_sim.experiment.errors import ExperimentError
from fractus_sim.experiment.station import OBSERVER_ID, STATION_COMPONENT, TcpLink

CONNECT_S = 5.0
HEARTBEAT_S = 15.0
READY_S = 120.0
ASK_S = 1.0
POLL_S = 0.05


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
            READY_S,
            "no GPS fix",
            "GPS_RAW_INT",
        )
        home = visitor.wait(lambda m: m.name == "HOME_POSITION", READY_S, "no home position", "HOME_POSITION")
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
            time.sleep(POLL_S)
        raise ExperimentError(f"{missing} from the autopilot within {timeout_s:.0f} s")

    def close(self) -> None:
        """Close the link."""
        self._link.close()
