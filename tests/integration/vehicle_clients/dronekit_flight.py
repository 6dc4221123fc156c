"""A DroneKit program that connects, arms, takes off, flies to a position, flies a mission, and returns."""

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

from dronekit import Command, LocationGlobalRelative, VehicleMode, connect  # noqa: E402


def wait_until(condition: Callable[[], bool], description: str, timeout_s: float = 40.0) -> None:
    """Poll a condition."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f"timeout: {description}")
        time.sleep(0.05)
    print("ok:", description, flush=True)


def main(address: str) -> None:
    """Fly the program with the vehicle at an address."""
    vehicle = connect(address, wait_ready=True, timeout=60, heartbeat_timeout=20)
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
    assert abs(home.lat - 48.2) < 1e-4, home
    vehicle.groundspeed = 5
    target = LocationGlobalRelative(home.lat + 30 / 111_319, home.lon, 12)
    vehicle.simple_goto(target)
    wait_until(lambda: abs(vehicle.location.global_relative_frame.lat - target.lat) * 111_319 < 1.0, "goto")
    commands.clear()
    for east in (10, 20):
        commands.add(Command(0, 0, 0, 3, 16, 0, 0, 0, 0, 0, 0, target.lat, target.lon + east / 74_000, 12))
    commands.upload(timeout=20)
    vehicle.mode = VehicleMode("AUTO")
    wait_until(lambda: commands.next >= 2, "mission")
    vehicle.parameters["RTL_ALT"] = 1200
    assert vehicle.parameters["RTL_ALT"] == 1200
    vehicle.mode = VehicleMode("RTL")
    wait_until(lambda: not vehicle.armed, "landed and disarmed", 60.0)
    vehicle.close()
    print("DONE")


if __name__ == "__main__":
    main(sys.argv[1])
