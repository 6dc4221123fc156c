"""A pymavlink program that knows nothing about Fractus. It requests a target in a no-fly zone, and then a permitted one."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

HOSPITAL = (50.866100, 4.679500)
TARGET = (50.864239, 4.679068)
ALTITUDE_M = 12.0
TIMEOUT_S = 90.0


def beat(link: Any) -> None:
    """Send heartbeats of a ground station."""
    while True:
        link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
        time.sleep(1.0)


def receive(link: Any, kind: str, condition: Callable[[Any], bool]) -> Any:
    """Return the next message of a kind that fulfils a condition."""
    end = time.monotonic() + TIMEOUT_S
    while time.monotonic() < end:
        message = link.recv_match(type=[kind, "STATUSTEXT"], blocking=True, timeout=1.0)
        if message is not None and message.get_type() == "STATUSTEXT":
            print("text:", message.text, flush=True)
        elif message is not None and condition(message):
            return message
    sys.exit(f"timeout: {kind}")


def result(link: Any, command: int) -> int:
    """Return the final result of a command."""

    def final(ack: Any) -> bool:
        return bool(ack.command == command and ack.result != mavlink.MAV_RESULT_IN_PROGRESS)

    number = int(receive(link, "COMMAND_ACK", final).result)
    print("command", command, "result", number, flush=True)
    return number


def long(link: Any, command: int, *params: float) -> int:
    """Send a COMMAND_LONG, and return its result."""
    link.mav.command_long_send(1, 1, command, 0, *params, *[0.0] * (7 - len(params)))
    return result(link, command)


def reposition(link: Any, place: tuple[float, float]) -> int:
    """Send a target, and return the result."""
    lat, lon = (round(degrees * 1e7) for degrees in place)
    frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
    command = mavlink.MAV_CMD_DO_REPOSITION
    link.mav.command_int_send(1, 1, frame, command, 0, 0, -1, 1, 0, 0, lat, lon, ALTITUDE_M)
    return result(link, command)


def is_at_target(link: Any) -> bool:
    """Wait until the drone stands, and return True if it is at the target."""
    while link.recv_match(type="GLOBAL_POSITION_INT", blocking=False) is not None:
        continue  # received before the latest target was sent
    place = receive(link, "GLOBAL_POSITION_INT", lambda m: abs(m.vx) + abs(m.vy) < 20)
    return bool(abs(place.lat / 1e7 - TARGET[0]) < 2e-5)


def main() -> None:
    """Fly."""
    link: Any = mavutil.mavlink_connection("tcp:127.0.0.1:5760", source_system=255)
    threading.Thread(target=beat, args=(link,), daemon=True).start()
    receive(link, "HEARTBEAT", lambda m: m.custom_mode == mavlink.COPTER_MODE_GUIDED)
    long(link, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 200_000)
    while long(link, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) != mavlink.MAV_RESULT_ACCEPTED:
        time.sleep(1.0)
    if long(link, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, ALTITUDE_M) != mavlink.MAV_RESULT_ACCEPTED:
        sys.exit("the takeoff was refused")
    receive(link, "GLOBAL_POSITION_INT", lambda m: m.relative_alt > 500 * ALTITUDE_M)
    if reposition(link, HOSPITAL) != mavlink.MAV_RESULT_DENIED:
        sys.exit("the target in the no-fly zone was not denied")
    end = time.monotonic() + TIMEOUT_S
    while not is_at_target(link):
        # The platform stops the drone for a moment if the autopilot's messages are late, as on a busy machine.
        reposition(link, TARGET)
        time.sleep(2.0)
        if time.monotonic() > end:
            sys.exit("the permitted target was not reached")
    long(link, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    receive(link, "HEARTBEAT", lambda m: not m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    print("DONE", flush=True)


if __name__ == "__main__":
    main()
