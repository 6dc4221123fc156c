"""Navigator: follows the path of its first control point, then flies a zigzag inside the region of its second."""

from __future__ import annotations

import asyncio
import logging
import os
from dataclasses import replace

import fractus

log = logging.getLogger("navigator")


async def fly(drone: fractus.Mobility, control: fractus.Control) -> None:
    """Visit the remaining waypoints of a control point, and the detours between them."""
    altitudes = _altitudes()
    detours = _detours()
    tasks = [task.path or _positions(os.environ["ZIGZAG"]) for task in fractus.control_points()]
    first = 1 + sum(len(task) for task in tasks[: control.control_point])
    async for waypoint in control.remaining(tasks[control.control_point]):
        number = first + control.waypoints_reached
        await go(drone, f"WP{number}", replace(waypoint, alt=altitudes.get(number, waypoint.alt)))
        if number in detours:
            place, stay_s = detours[number]
            await go(drone, f"a detour after WP{number}", place, stay_s)


async def go(drone: fractus.Mobility, what: str, to: fractus.Position, stay_s: float = 0.0) -> None:
    """Fly to a position and hover there. Positions that policies forbid are skipped."""
    try:
        done = await drone.goto(to.lat, to.lon, to.alt)
    except fractus.PolicyDenied as refusal:
        log.info("%s refused, going on: %s", what, refusal)
    else:
        log.info("%s reached%s", what, f", corrected: {done.decision.reason}" if done.corrected else "")
        await asyncio.sleep(stay_s)


def _position(text: str) -> fractus.Position:
    lat, lon, alt = (float(part) for part in text.split(","))
    return fractus.Position(lat, lon, alt)


def _positions(text: str) -> tuple[fractus.Position, ...]:
    return tuple(_position(part) for part in text.split(";"))


def _altitudes() -> dict[int, float]:
    """Parse ALTITUDES, for example `1:20,6:4`: other altitudes for some waypoints."""
    pairs = (part.split(":") for part in os.environ.get("ALTITUDES", "").split(",") if part)
    return {int(number): float(altitude) for number, altitude in pairs}


def _detours() -> dict[int, tuple[fractus.Position, float]]:
    """Parse DETOURS, for example `2:39.3711,22.9307,10; 6:39.3704,22.9318,10,20`: positions after waypoints, with seconds to stay."""
    found = {}
    for pair in filter(str.strip, os.environ.get("DETOURS", "").split(";")):
        number, place = pair.split(":")
        where = place.split(",")[:3]
        stay = place.split(",")[3:]
        found[int(number)] = _position(",".join(where)), float(stay[0]) if stay else 0.0
    return found


if __name__ == "__main__":
    fractus.run(fly)
