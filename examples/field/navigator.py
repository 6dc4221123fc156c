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
            target, stay_s = detours[number]
            await go(drone, f"a detour after WP{number}", target, stay_s)


async def go(drone: fractus.Mobility, name: str, target: fractus.Position, stay_s: float = 0.0) -> None:
    """Fly to a position and hover there. Positions that policies forbid are skipped."""
    try:
        result = await drone.goto(target.lat, target.lon, target.alt)
    except fractus.PolicyDenied as refusal:
        log.info("%s refused, continuing: %s", name, refusal)
    else:
        log.info("%s reached%s", name, f", corrected: {result.decision.reason}" if result.corrected else "")
        await asyncio.sleep(stay_s)


def _position(text: str) -> fractus.Position:
    lat, lon, alt = (float(part) for part in text.split(","))
    return fractus.Position(lat, lon, alt)


def _positions(text: str) -> tuple[fractus.Position, ...]:
    return tuple(_position(part) for part in text.split(";"))


def _altitudes() -> dict[int, float]:
    """Parse ALTITUDES, which replaces the altitudes of waypoints by number, for example `1:20,6:4`."""
    pairs = (part.split(":") for part in os.environ.get("ALTITUDES", "").split(",") if part)
    return {int(number): float(altitude) for number, altitude in pairs}


def _detours() -> dict[int, tuple[fractus.Position, float]]:
    """Parse DETOURS, for example `2:39.3711,22.9307,10; 6:39.3704,22.9318,10,20`.

    Each entry is a position that is visited after a waypoint, optionally with the seconds to hover there.
    """
    detours = {}
    for entry in filter(str.strip, os.environ.get("DETOURS", "").split(";")):
        number, values = entry.split(":")
        lat, lon, alt, *stay = values.split(",")
        detours[int(number)] = _position(f"{lat},{lon},{alt}"), float(stay[0]) if stay else 0.0
    return detours


if __name__ == "__main__":
    fractus.run(fly)
