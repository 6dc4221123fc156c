"""A DroneKit program that connects, arms, takes off, flies to a position, and returns."""

from __future__ import annotations

import collections
import collections.abc
import sys
import time
from collections.abc import Callable

# DroneKit 2.9 imports these names from `collections`, where Python 3.10 and later do not have them.
for _name in ("MutableMapping", "Mapping", "Callable", "Iterable"):
    if not hasattr(collections, _name):
        setattr(collections, _name, getattr(collections.abc, _name))

from dronekit import LocationGlobalRelative, VehicleMode, connect  # noqa: E402


def wait_until(condition: Callable[[], bool], description: str, timeout_s: float = 60.0) -> None:
    """Poll a condition."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f"timeout: {description}")
        time.sleep(0.05)
    print("ok:", description, flush=True)


def main(address: str) -> None:
    """Fly the program with the vehicle at an address."""
    vehicle = connect(address, wait_ready=True, timeout=90, heartbeat_timeout=60)
    wait_until(lambda: str(vehicle.version).startswith("APM:Copter-4."), "version")
    wait_until(lambda: vehicle.is_armable, "armable")
    vehicle.mode = VehicleMode("GUIDED")
    vehicle.armed = True
    wait_until(lambda: vehicle.armed and vehicle.mode.name == "GUIDED", "armed in GUIDED")
    vehicle.simple_takeoff(10)
    wait_until(lambda: vehicle.location.global_relative_frame.alt > 9.5, "takeoff")
    commands = vehicle.commands
    commands.download()
    commands.wait_ready()
    home = vehicle.home_location
    vehicle.groundspeed = 5
    target = LocationGlobalRelative(home.lat + 30 / 111_319, home.lon, 12)
    vehicle.simple_goto(target)
    wait_until(lambda: abs(vehicle.location.global_relative_frame.lat - target.lat) * 111_319 < 1.0, "goto")
    vehicle.mode = VehicleMode("RTL")
    wait_until(lambda: not vehicle.armed, "landed and disarmed", 90.0)
    vehicle.close()
    print("DONE")


if __name__ == "__main__":
    main(sys.argv[1])
