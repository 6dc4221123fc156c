"""Navigator, the drone's driver: flies its waypoints once, and after a restart goes on where it was."""

from __future__ import annotations

import asyncio
import logging
import os
import signal

import fractus

CRUISE_MPS = 12.0
READY_TIMEOUT_S = 120.0
log = logging.getLogger("navigator")


async def main() -> None:
    """Fly, then stay idle until the pod is deleted; SIGTERM breaks off, and the system takes the drone home."""
    flight = asyncio.current_task()
    assert flight is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, flight.cancel)
    (task,) = fractus.control_points()
    async with fractus.mobility() as drone:
        try:
            async with drone.control() as control:
                log.info("in control; %d of %d waypoints reached before", control.waypoints_reached, len(task.path))
                await fly(drone, task.path, control.waypoints_reached)
        except fractus.MissionComplete:
            log.info("the mission is over; nothing left to fly")
        else:
            log.info("control returned: the system flies the drone home")
    await asyncio.Event().wait()


async def fly(drone: fractus.Mobility, path: tuple[fractus.Position, ...], reached: int) -> None:
    """Take off unless the drone is in the air, and visit what is left of the path."""
    async with asyncio.timeout(READY_TIMEOUT_S):
        async for state in drone.telemetry(interval_s=0.5):
            if state.in_air or state.ready:
                break
    if not state.in_air:
        await drone.arm()
        log.info("armed; taking off")
        tell("takeoff", await drone.takeoff(path[0].alt))
    speed = await drone.set_speed(CRUISE_MPS)
    log.info("flying at %.1f m/s%s", speed.speed_mps, f": {speed.decision.reason}" if speed.corrected else "")
    for number, waypoint in enumerate(path, start=1):
        if number <= reached:
            continue
        if number == int(os.environ.get("DETOUR_BEFORE", "0")):
            await detour(drone)
        tell(f"waypoint {number}/{len(path)}", await drone.goto(waypoint.lat, waypoint.lon, waypoint.alt))


async def detour(drone: fractus.Mobility) -> None:
    """Try for a closer look at DETOUR (lat,lon,alt), which policies may forbid."""
    lat, lon, alt = (float(part) for part in os.environ["DETOUR"].split(","))
    try:
        tell("detour", await drone.goto(lat, lon, alt))
    except fractus.PolicyDenied as refusal:
        log.info("detour refused, going on: %s", refusal)


def tell(what: str, done: fractus.Progress) -> None:
    """Log where a motion ended, and what a policy made of it."""
    log.info("%s reached: %s%s", what, done.target, f" (corrected: {done.decision.reason})" if done.corrected else "")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    try:
        asyncio.run(main())
    except (asyncio.CancelledError, KeyboardInterrupt):
        log.info("told to stop")
    except TimeoutError:
        raise SystemExit(f"navigator: the autopilot was not ready to arm within {READY_TIMEOUT_S:.0f} s") from None
    except fractus.FractusError as error:
        raise SystemExit(f"navigator: {error}") from None
