"""Bad applications that speak MAVLink: `python -m fractus_testing.malice.mavlink_programs NAME`.

Their parameters are environment variables. FRACTUS_VEHICLE is the connection to the gateway.
"""

from __future__ import annotations

import json
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, NoReturn

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_testing.malice import BREACH

METRES_PER_DEGREE = 111_320.0
ALTITUDE_M = 10.0
STEP_M = 10.0
LEG_TIMEOUT_S = 15.0
CONTROL_TIMEOUT_S = 60.0
CLIMB_TIMEOUT_S = 20.0
TAKEOFFS = 5
ANSWER_TIMEOUT_S = 30.0
LANDING_TIMEOUT_S = 180.0
HIGHEST_M = 119.0
"""Altitude of the targets that are not bad. It is above most altitude limits, and below the highest permitted altitude of 120 m."""

REACTION_S = 5.0
"""Time in which a drone that obeys a target moves visibly, seconds of the vehicle."""

SETTLE_S = 10.0
STILL_M = 1.0
"""A drone that has not climbed or descended further than `STILL_M` for `SETTLE_S` seconds of the vehicle is at its target."""

MAX_CLIMB_M = 3.0
MAX_MOVE_M = 8.0
"""A drone that moves further within `REACTION_S` has obeyed a position that no drone may fly to."""

FORCE_ARM = 2989.0
FORCE_DISARM = 21196.0
POSITION_ONLY = 0b110111111000
VELOCITY_ONLY = 0b110111000111
log = logging.getLogger("malice")


def breach(text: str) -> NoReturn:
    """End the program, because the platform did not prevent the attack."""
    log.error("breach: %s", text)
    sys.stderr.flush()
    os._exit(BREACH)  # sys.exit would only end the current thread


class Position(NamedTuple):
    """Position in metres north and east of the start, and above home, at a time of the vehicle in seconds."""

    north_m: float
    east_m: float
    up_m: float
    time_s: float


class Vehicle:
    """The connection to the gateway. A thread sends heartbeats."""

    def __init__(self) -> None:
        connect: Any = mavutil.mavlink_connection  # pymavlink has no types
        self.link: Any = connect(os.environ["FRACTUS_VEHICLE"], source_system=255, source_component=190)
        self.start: tuple[float, float] = (0.0, 0.0)
        self._beats = True
        threading.Thread(target=self._beat, daemon=True).start()

    def stop_heartbeats(self) -> None:
        """Send no heartbeats any more."""
        self._beats = False

    def _beat(self) -> None:
        while self._beats:
            self.link.mav.heartbeat_send(6, 8, 0, 0, 0)
            time.sleep(1.0)

    def receive(self, kind: str, condition: Callable[[Any], bool], timeout_s: float) -> Any:
        """Return the next message of a kind that fulfils a condition, or None after the timeout."""
        end = time.monotonic() + timeout_s
        while (left := end - time.monotonic()) > 0:
            message = self.link.recv_match(type=[kind, "STATUSTEXT"], blocking=True, timeout=left)
            if message is None:
                return None
            if message.get_type() == "STATUSTEXT":
                log.info("text: %s", message.text)
            elif condition(message):
                return message
        return None

    def command(self, number: int, *params: float, timeout_s: float = ANSWER_TIMEOUT_S) -> int | None:
        """Send a COMMAND_LONG, and return its final result. None if there is no answer."""
        self.link.mav.command_long_send(1, 1, number, 0, *params, *[0.0] * (7 - len(params)))

        def final(ack: Any) -> bool:
            return bool(ack.command == number and ack.result != mavlink.MAV_RESULT_IN_PROGRESS)

        answer = self.receive("COMMAND_ACK", final, timeout_s)
        return None if answer is None else int(answer.result)

    def position(self) -> Position:
        """Return the current position."""
        while self.link.recv_match(type="GLOBAL_POSITION_INT", blocking=False) is not None:
            continue
        message = self.receive("GLOBAL_POSITION_INT", lambda _: True, ANSWER_TIMEOUT_S)
        if message is None:
            sys.exit(f"no position was received within {ANSWER_TIMEOUT_S:g} s, so the attack has no result")
        lat, lon = self.start
        return Position(
            (message.lat / 1e7 - lat) * METRES_PER_DEGREE,
            (message.lon / 1e7 - lon) * METRES_PER_DEGREE * math.cos(math.radians(lat)),
            message.relative_alt / 1e3,
            message.time_boot_ms / 1e3,
        )

    def heartbeat(self) -> Any:
        """Return the next heartbeat."""
        beat = self.receive("HEARTBEAT", lambda message: message.get_srcSystem() == 1, ANSWER_TIMEOUT_S)
        if beat is None:
            sys.exit(f"no heartbeat was received within {ANSWER_TIMEOUT_S:g} s, so the attack has no result")
        return beat

    def armed(self) -> bool:
        """Return True if the motors run."""
        # The first heartbeats after a command may have been sent before it.
        beats = [self.heartbeat() for _ in range(3)]
        return all(beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED for beat in beats)

    def target(self, lat_e7: int, lon_e7: int, altitude_m: float, frame: int) -> None:
        """Send a position target."""
        self.link.mav.set_position_target_global_int_send(
            0, 1, 1, frame, POSITION_ONLY, lat_e7, lon_e7, altitude_m, *[0.0] * 8
        )

    def north(self, metres: float) -> None:
        """Send a position target north of the start."""
        lat, lon = self.start
        target = round((lat + metres / METRES_PER_DEGREE) * 1e7)
        self.target(target, round(lon * 1e7), ALTITUDE_M, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)

    def take_off(self) -> None:
        """Wait for control, arm and take off."""
        guided = self.receive("HEARTBEAT", lambda m: m.custom_mode == mavlink.COPTER_MODE_GUIDED, CONTROL_TIMEOUT_S)
        if guided is None:
            sys.exit("no control")
        self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 100_000)
        for _ in range(TAKEOFFS):
            # The services refuse for a moment while the link to the autopilot is slow.
            if self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) != mavlink.MAV_RESULT_ACCEPTED:
                continue
            self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, ALTITUDE_M)
            start = self.receive("GLOBAL_POSITION_INT", lambda m: m.relative_alt > 930 * ALTITUDE_M, CLIMB_TIMEOUT_S)
            if start is not None:
                self.start = (start.lat / 1e7, start.lon / 1e7)
                return
        sys.exit("the drone did not reach its altitude")

    def come_home(self) -> None:
        """Return to the start, and wait until the motors stop."""
        self.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        if self.receive("HEARTBEAT", lambda m: not m.base_mode & armed, LANDING_TIMEOUT_S) is None:
            sys.exit("the drone did not land")


def _number(name: str) -> float:
    return float(json.loads(os.environ[name]))


def leaves_corridor(vehicle: Vehicle) -> None:
    """Send a target far north, and then the same target in short steps. The test checks the track."""
    distance_m = _number("DISTANCE_M")
    steps = range(1, math.ceil(distance_m / STEP_M) + 1)
    for metres in (distance_m, *(STEP_M * step for step in steps)):
        vehicle.north(metres)
        end = time.monotonic() + (LEG_TIMEOUT_S if metres in {distance_m, STEP_M} else 1.0)
        while time.monotonic() < end:
            if vehicle.position().north_m > distance_m - STEP_M:
                breach(f"the drone flew {distance_m:g} m north")


def presses_border(vehicle: Vehicle) -> None:
    """Send velocities to the north. The test checks where the drone was."""
    end = time.monotonic() + _number("SECONDS")
    while time.monotonic() < end:
        vehicle.link.mav.set_position_target_local_ned_send(
            0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, VELOCITY_ONLY, 0, 0, 0, _number("SPEED_MPS"), 0, 0, 0, 0, 0, 0, 0
        )
        time.sleep(0.1)


def floods(vehicle: Vehicle) -> None:
    """Send many frames at once, every second of them damaged, and then require an answer to one command."""
    frame = bytearray(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3).pack(vehicle.link.mav))
    damaged = bytes([*frame[:-1], frame[-1] ^ 0xFF])
    for _ in range(round(_number("CALLS"))):
        vehicle.link.write(bytes(frame) + damaged)
    if vehicle.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) is None:
        breach("the gateway does not answer after the flood")


def _positions_after(vehicle: Vehicle, begin: Position, seconds: float) -> Iterator[Position]:
    """Yield the positions in the seconds of the vehicle after a position."""
    position = begin
    while position.time_s < begin.time_s + seconds:
        position = vehicle.position()
        yield position


def wrong_frames(vehicle: Vehicle) -> None:
    """Send targets that no drone may fly to, and frames that the gateway does not know.

    The platform may correct an altitude to the highest permitted one. The drone therefore climbs there first, so that no
    correction of a bad target can move it.
    """
    lat, lon = (round(degrees * 1e7) for degrees in vehicle.start)
    relative = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    vehicle.target(lat, lon, HIGHEST_M, relative)
    begin = vehicle.position()
    while any(abs(position.up_m - begin.up_m) > STILL_M for position in _positions_after(vehicle, begin, SETTLE_S)):
        begin = vehicle.position()
    bad = {
        "latitude and longitude exchanged": (lon, lat, ALTITUDE_M, relative),
        "altitude above mean sea level": (lat, lon, ALTITUDE_M + 1000.0, relative),
        "altitude in centimetres": (lat, lon, 100 * ALTITUDE_M, relative),
        "degrees as integer": (lat // 10_000_000, lon // 10_000_000, ALTITUDE_M, relative),
        "NaN": (lat, lon, math.nan, relative),
        "infinite altitude": (lat, lon, math.inf, relative),
        "above terrain": (lat, lon, 1000.0, mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT),
        "above mean sea level": (lat, lon, 1000.0, mavlink.MAV_FRAME_GLOBAL_INT),
        "unknown frame": (lat, lon, 1000.0, 99),
    }
    for title, (lat_e7, lon_e7, altitude_m, frame) in bad.items():
        begin = vehicle.position()
        vehicle.target(lat_e7, lon_e7, altitude_m, frame)
        log.info("sent: %s", title)
        for position in _positions_after(vehicle, begin, REACTION_S):
            moved_m = math.hypot(position.north_m - begin.north_m, position.east_m - begin.east_m)
            climbed_m = position.up_m - begin.up_m
            if moved_m > MAX_MOVE_M or climbed_m > MAX_CLIMB_M:
                breach(f"{title}: the drone flew {moved_m:.0f} m away and climbed {climbed_m:.0f} m")


def forges_identity(vehicle: Vehicle) -> None:
    """Send commands with the ids of others, and for other systems."""
    mav = vehicle.link.mav
    armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    disarm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    for system, component in ((1, 1), (1, 191), (255, 190), (254, 1), (0, 0)):
        mav.srcSystem = system
        mav.srcComponent = component
        for target in (0, 1, 2, 255):
            mav.command_long_send(target, 0, disarm, 0, 0, FORCE_DISARM, 0, 0, 0, 0, 0)
            mav.command_long_send(target, 1, mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 0, 1, 0, 0, 0, 0, 0, 0)
            mav.set_mode_send(target, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mavlink.COPTER_MODE_STABILIZE)
            mav.rc_channels_override_send(target, 1, 1000, 1000, 1000, 1000, 1000, 1000, 1000, 1000)
        mav.heartbeat_send(2, 3, armed, mavlink.COPTER_MODE_STABILIZE, 4)
    mav.srcSystem = 255
    mav.srcComponent = 190
    if not vehicle.armed():
        breach("the motors were stopped in flight")
    beat = vehicle.heartbeat()
    if beat.custom_mode == mavlink.COPTER_MODE_STABILIZE:
        breach("the autopilot flies in mode STABILIZE")


def forces_arming(vehicle: Vehicle) -> None:
    """Force the motors to stop in flight. `main` has tried to force arming before it had control."""
    for title, params in (("disarm", (0.0, 0.0)), ("forced disarm", (0.0, FORCE_DISARM))):
        result = vehicle.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, *params)
        log.info("%s in flight: result %s", title, result)
        if result == mavlink.MAV_RESULT_ACCEPTED or not vehicle.armed():
            breach(f"{title} in flight was accepted")
    result = vehicle.command(mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 1.0)
    if result == mavlink.MAV_RESULT_ACCEPTED or not vehicle.armed():
        breach("flight termination was accepted")


def stalls(vehicle: Vehicle) -> None:
    """Send nothing, and read nothing."""
    vehicle.stop_heartbeats()
    time.sleep(_number("SECONDS"))


def crashes(vehicle: Vehicle) -> None:
    """End the process at once."""
    vehicle.stop_heartbeats()
    sys.stderr.flush()
    os._exit(1)


ATTACKS: Mapping[str, Callable[[Vehicle], None]] = {
    "leaves-corridor": leaves_corridor,
    "presses-border": presses_border,
    "floods": floods,
    "wrong-frames": wrong_frames,
    "forges-identity": forges_identity,
    "forces-arming": forces_arming,
    "stalls": stalls,
    "crashes": crashes,
}


def force_arming_without_control(vehicle: Vehicle) -> None:
    """Force arming before the program has control. The gateway refuses the code that forces it."""
    if vehicle.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, FORCE_ARM) == mavlink.MAV_RESULT_ACCEPTED:
        breach("forced arming was accepted")


def main(name: str) -> None:
    """Run an attack in flight, and return home."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S", stream=sys.stderr)
    vehicle = Vehicle()
    if name == "forces-arming":
        force_arming_without_control(vehicle)
    vehicle.take_off()
    ATTACKS[name](vehicle)
    vehicle.come_home()


if __name__ == "__main__":
    main(sys.argv[1])
