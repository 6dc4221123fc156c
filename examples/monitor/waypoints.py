"""Waypoints: a DroneKit program that flies a course, and lands at its end. It uses only DroneKit.

A leg ends when its target is reached, or after a timeout. Until then, the target is sent up to three times, because a drone
that was stopped in between does not continue by itself.
"""

from __future__ import annotations

import collections
import collections.abc
import logging
import os
import time
from collections.abc import Callable

# DroneKit 2.9 imports these names from `collections`, where Python 3.10 and later do not have them.
for _name in ("MutableMapping", "Mapping", "Callable", "Iterable"):
    if not hasattr(collections, _name):
        setattr(collections, _name, getattr(collections.abc, _name))

from dronekit import (  # type: ignore[import-not-found, import-untyped, unused-ignore]  # noqa: E402
    LocationGlobalRelative,
    Vehicle,
    VehicleMode,
    connect,
)

METRES_PER_DEGREE = 111_320.0
REACHED_M = 1.0
STANDING_MPS = 0.3
ATTEMPTS = 3
START_TIMEOUT_S = 120.0
log = logging.getLogger("waypoints")


def wait_until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Poll a condition. Return False after the timeout."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def require(condition: Callable[[], bool], description: str) -> None:
    """Wait for a condition, and end the program if it does not hold in time."""
    if not wait_until(condition, START_TIMEOUT_S):
        raise SystemExit(f"timeout: {description}")
    log.info("%s", description)


def is_at(vehicle: Vehicle, target: LocationGlobalRelative) -> bool:
    """Return True if the drone stands at a position."""
    here = vehicle.location.global_relative_frame
    # Away from the equator a degree of longitude is shorter, so the distance is not underestimated.
    away_m = max(abs(here.lat - target.lat), abs(here.lon - target.lon)) * METRES_PER_DEGREE
    return bool(away_m < REACHED_M and abs(here.alt - target.alt) < REACHED_M and vehicle.groundspeed < STANDING_MPS)


def fly_to(vehicle: Vehicle, target: LocationGlobalRelative, timeout_s: float) -> bool:
    """Fly to a position. Return False if it was not reached in time."""
    for _ in range(ATTEMPTS):
        vehicle.simple_goto(target)
        if wait_until(lambda: is_at(vehicle, target), timeout_s / ATTEMPTS):
            return True
    return False


def course() -> list[LocationGlobalRelative]:
    """Parse COURSE, for example `39.361622,22.931433,15; 39.361802,22.932245,15`."""
    return [LocationGlobalRelative(*map(float, part.split(","))) for part in os.environ["COURSE"].split(";")]


def main() -> None:
    """Fly the course."""
    timeout_s = float(os.environ.get("LEG_TIMEOUT_S", "40"))
    positions = course()
    vehicle = connect(os.environ.get("FRACTUS_VEHICLE", "tcp:127.0.0.1:5760"), wait_ready=True, timeout=START_TIMEOUT_S)
    vehicle.add_message_listener("STATUSTEXT", lambda _vehicle, _name, message: log.info("vehicle: %s", message.text))
    require(lambda: vehicle.is_armable, "armable")
    vehicle.mode = VehicleMode("GUIDED")
    require(lambda: vehicle.mode.name == "GUIDED", "in control")
    vehicle.armed = True
    require(lambda: vehicle.armed, "armed")
    vehicle.simple_takeoff(positions[0].alt)
    # If the climb was interrupted, the drone climbs on the way to its first position.
    wait_until(lambda: vehicle.location.global_relative_frame.alt > 0.95 * positions[0].alt, timeout_s / ATTEMPTS)
    for number, target in enumerate(positions, start=1):
        reached = fly_to(vehicle, target, timeout_s)
        log.info("position %d %s", number, "reached" if reached else "not reached, continuing")
    vehicle.mode = VehicleMode("LAND")
    require(lambda: not vehicle.armed, "landed")
    vehicle.close()


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    main()
