"""Navigator, the driver: flies its waypoints once, and continues after a restart."""

from __future__ import annotations

import logging
import os

import fractus

CRUISE_MPS = 12.0
log = logging.getLogger("navigator")


async def fly(drone: fractus.Mobility, control: fractus.Control) -> None:
    """Take off and visit the remaining waypoints. After a restart in the air, arm and takeoff complete at once."""
    path = control.task.path
    await drone.arm()
    log.info("armed; taking off")
    log_result("takeoff", await drone.takeoff(path[0].alt))
    speed = await drone.set_speed(CRUISE_MPS)
    log.info("flying at %.1f m/s%s", speed.speed_mps, f": {speed.decision.reason}" if speed.corrected else "")
    async for waypoint in control.remaining():
        number = control.waypoints_reached + 1
        if number == int(os.environ.get("DETOUR_BEFORE", "0")):
            await detour(drone)
        log_result(f"waypoint {number}/{len(path)}", await drone.goto(waypoint.lat, waypoint.lon, waypoint.alt))


async def detour(drone: fractus.Mobility) -> None:
    """Try to fly to DETOUR (lat,lon,alt), which policies may forbid."""
    lat, lon, alt = (float(part) for part in os.environ["DETOUR"].split(","))
    try:
        log_result("detour", await drone.goto(lat, lon, alt))
    except fractus.PolicyDenied as refusal:
        log.info("detour refused, continuing: %s", refusal)


def log_result(name: str, result: fractus.Progress) -> None:
    """Log the end of a motion and its correction."""
    correction = f" (corrected: {result.decision.reason})" if result.corrected else ""
    log.info("%s reached: %s%s", name, result.target, correction)


if __name__ == "__main__":
    fractus.run(fly)
