"""A QGroundControl plan and an orbit, flown by the SDK with the real service, with a pause and a restart."""

from __future__ import annotations

import asyncio
import json
import math
from pathlib import Path

import fractus
import pytest
from mobility_rig import FRAME, Rig, grant
from test_mobility_sdk import endpoint

pytestmark = pytest.mark.timeout(300)

MIDDLE = FRAME.latlon(30.0, 0.0)
RADIUS_M = 20.0
ALTITUDE_M = 12.0


def saved_plan(path: Path) -> Path:
    """Write the plan that QGroundControl saves for a takeoff, a speed, two waypoints and a return."""

    def item(command: int, *params: float | None, frame: int = 3) -> dict[str, object]:
        return {"type": "SimpleItem", "command": command, "frame": frame, "params": list(params)}

    spots = [item(16, stay, 0, 0, None, *FRAME.latlon(x, 20.0), ALTITUDE_M) for x, stay in ((0.0, 0.0), (30.0, 1.0))]
    speed = item(178, 1, 6.0, -1, 0, 0, 0, 0, frame=2)
    home = item(20, 0, 0, 0, 0, 0, 0, 0, frame=2)
    items = [item(22, 0, 0, 0, None, *FRAME.latlon(0.0, 0.0), ALTITUDE_M), speed, *spots, home]
    path.write_text(json.dumps({"fileType": "Plan", "mission": {"items": items}}))
    return path


def distance_m(position: fractus.Position) -> float:
    """Return the horizontal distance from the centre of the orbit, in metres."""
    north = math.radians(position.lat - MIDDLE[0]) * 6_371_008.8
    east = math.radians(position.lon - MIDDLE[1]) * 6_371_008.8 * math.cos(math.radians(MIDDLE[0]))
    return math.hypot(north, east)


class Killed(Exception):
    """Raised to end the first run of the program in flight."""


async def test_plan_and_orbit_mission_survives_pause_and_restart(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service("--driver-grace", "30")
    rig.start_vehicle()
    middle = fractus.Position(*MIDDLE, ALTITUDE_M)
    around = fractus.orbit(middle, RADIUS_M, points=8, speed_mps=6.0)
    waypoints = (*fractus.read_plan(saved_plan(rig.directory / "survey.plan")), *around)
    assert len(waypoints) == 2 + 9
    under_way: dict[int, asyncio.Event] = {number: asyncio.Event() for number in range(1, len(waypoints) + 1)}

    async with fractus.mobility(endpoint(rig)) as drone:
        with pytest.raises(Killed):
            async with drone.control():
                await drone.arm()
                await drone.takeoff(ALTITUDE_M)
                mission = drone.mission(waypoints)
                flight = asyncio.ensure_future(mission.fly(lambda step: under_way[step.number].set()))
                await under_way[2].wait()
                mission.pause()
                await rig.until(lambda t: math.hypot(t.velocity.north_mps, t.velocity.east_mps) < 0.5, 60, "a hover")
                assert mission.paused and not under_way[3].is_set()
                mission.resume()
                await under_way[4].wait()
                flight.cancel()
                await asyncio.gather(flight, return_exceptions=True)
                raise Killed

    flown: list[int] = []
    radii: list[float] = []
    async with fractus.mobility(endpoint(rig)) as drone, drone.control() as control:
        assert control.waypoints_reached == 3  # the two waypoints of the plan, and the first of the orbit
        await drone.arm()
        await drone.takeoff(ALTITUDE_M)
        flight = asyncio.ensure_future(drone.mission(waypoints).fly(lambda step: flown.append(step.number)))
        async for state in drone.telemetry(0.2):
            if flight.done():
                break
            if state.position is not None and flown and flown[-1] > 4:
                radii.append(distance_m(state.position))
        assert await flight == {}
        assert set(flown) == set(range(4, len(waypoints) + 1)), (
            "a completed waypoint was flown again, or another waypoint was omitted"
        )
        await drone.turn(135)
        attitude = await anext(drone.watch.attitude())
        assert abs((attitude.yaw_deg - 135 + 180) % 360 - 180) < 10
    assert control.mission_complete
    # The orbit has eight waypoints. The middle of a line between two of them is at 92 % of the radius.
    assert radii and all(0.8 * RADIUS_M < radius < 1.2 * RADIUS_M for radius in radii), (min(radii), max(radii))
    await rig.until(lambda t: not t.armed, 120, "landing")
