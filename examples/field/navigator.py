"""Navigator: follows the path of its first control point, then flies a zigzag inside the region of its second."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Mapping, Sequence
from dataclasses import replace

import fractus

log = logging.getLogger("navigator")


async def main() -> None:
    """Take control at each control point in turn, fly, give it back; SIGTERM breaks off."""
    flight = asyncio.current_task()
    assert flight is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, flight.cancel)
    altitudes, detours = _altitudes(), _detours()
    tasks = [task.path or _positions(os.environ["ZIGZAG"]) for task in fractus.control_points()]
    async with fractus.mobility() as drone:
        complete = False
        while not complete:
            try:
                async with drone.control() as control:
                    at = control.control_point
                    log.info("in control at CTRL%d", at + 1)
                    first = 1 + sum(len(task) for task in tasks[:at])
                    await fly(drone, _at(tasks[at], first, altitudes), first, control.waypoints_reached, detours)
                log.info("control returned at CTRL%d", at + 1)
                complete = control.mission_complete
            except fractus.MissionComplete:
                complete = True
            except fractus.ControlLost as lost:
                log.info("control lost: %s", lost)
                break
    await asyncio.Event().wait()


async def fly(
    drone: fractus.Mobility,
    waypoints: Sequence[fractus.Position],
    first: int,
    reached: int,
    detours: Mapping[int, tuple[fractus.Position, float]],
) -> None:
    """Visit what is left of some waypoints, which are numbered from `first` on, and what is asked for in between."""
    for number, waypoint in enumerate(waypoints, start=first):
        if number - first >= reached:
            await go(drone, f"WP{number}", waypoint)
        if number in detours:
            place, stay_s = detours[number]
            await go(drone, f"a detour after WP{number}", place, stay_s)


async def go(drone: fractus.Mobility, what: str, to: fractus.Position, stay_s: float = 0.0) -> None:
    """Fly somewhere, and hover there for a while; what policies forbid is passed over."""
    try:
        done = await drone.goto(to.lat, to.lon, to.alt)
    except fractus.PolicyDenied as refusal:
        log.info("%s refused, going on: %s", what, refusal)
    else:
        log.info("%s reached%s", what, f", corrected: {done.decision.reason}" if done.corrected else "")
        await asyncio.sleep(stay_s)


def _at(
    waypoints: Sequence[fractus.Position], first: int, altitudes: Mapping[int, float]
) -> tuple[fractus.Position, ...]:
    return tuple(replace(w, alt=altitudes.get(number, w.alt)) for number, w in enumerate(waypoints, start=first))


def _position(text: str) -> fractus.Position:
    lat, lon, alt = (float(part) for part in text.split(","))
    return fractus.Position(lat, lon, alt)


def _positions(text: str) -> tuple[fractus.Position, ...]:
    return tuple(_position(part) for part in text.split(";"))


def _altitudes() -> dict[int, float]:
    """ALTITUDES, such as `1:20,6:4`: other altitudes for some waypoints."""
    pairs = (part.split(":") for part in os.environ.get("ALTITUDES", "").split(",") if part)
    return {int(number): float(altitude) for number, altitude in pairs}


def _detours() -> dict[int, tuple[fractus.Position, float]]:
    """DETOURS, such as `2:39.3711,22.9307,10; 6:39.3704,22.9318,10,20`: where to go after some waypoints, and how many seconds to stay."""
    found = {}
    for pair in filter(str.strip, os.environ.get("DETOURS", "").split(";")):
        number, place = pair.split(":")
        where, stay = place.split(",")[:3], place.split(",")[3:]
        found[int(number)] = _position(",".join(where)), float(stay[0]) if stay else 0.0
    return found


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    try:
        asyncio.run(main())
    except (asyncio.CancelledError, KeyboardInterrupt):
        log.info("told to stop")
    except fractus.FractusError as error:
        raise SystemExit(f"navigator: {error}") from None
