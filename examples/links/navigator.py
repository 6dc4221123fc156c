"""Navigator: takes off at the first waypoint and flies slowly to the other waypoints. The system flies the drone home."""

from __future__ import annotations

import logging
import os

import fractus

log = logging.getLogger("navigator")


async def fly(drone: fractus.Mobility, control: fractus.Control) -> None:
    """Fly the remaining path. After a restart in the air, arm and takeoff complete at once."""
    path = control.task.path
    await drone.arm()
    await drone.takeoff(path[0].alt)
    speed = await drone.set_speed(float(os.environ["SPEED_MPS"]))
    log.info("flying at %.1f m/s", speed.speed_mps)
    async for waypoint in control.remaining():
        await drone.goto(waypoint.lat, waypoint.lon, waypoint.alt)
        log.info("waypoint %d of %d reached", control.waypoints_reached + 1, len(path))


if __name__ == "__main__":
    fractus.run(fly)
