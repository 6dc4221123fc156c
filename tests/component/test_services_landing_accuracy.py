"""Landings at home after return flights by the system, on the simulated vehicle, which overshoots as a real ArduCopter does."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from closed_loop import Drone, Sky, Weather
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_services.grant_files import ActiveGrant
from mobility_world import goto, spec
from sky_drone import fly, ready, until

ACCURACY_M = 0.3
"""Largest distance between the places of arming and of landing."""

WEATHERS = {
    "calm": Weather(uplink_s=0.02, downlink_s=0.02),
    "windy": Weather(uplink_s=0.02, downlink_s=0.02, wind_mps=6.0),
    "slow": Weather(uplink_s=0.2, downlink_s=0.2, loss=0.03, wind_mps=3.0),
}


async def _fly_out(drone: Drone, grant: ActiveGrant, sky: Sky, target: tuple[float, float]) -> tuple[float, float]:
    """Take off, and fly to a point. Return the position of arming."""
    body = sky.truth.body
    await drone.service.arm(grant, 120.0)
    begun = (body.north, body.east)
    async for _ in drone.service.take_off(grant, TakeoffArgs(12.0)):
        pass
    async for _ in drone.service.goto(grant, goto(*target, 12.0, speed_mps=8.0), 0.0):
        pass
    return begun


@pytest.mark.parametrize(("by", "weather"), [("system", "calm"), ("driver", "windy"), ("system", "slow")])
def test_return_flight_lands_where_it_armed(tmp_path: Path, by: str, weather: str) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            drone.grants.put(spec())
            north_m, east_m = await _fly_out(drone, grant, sky, (45.0, 20.0))
            if by == "driver":
                async for _ in drone.service.return_to_launch(grant):
                    pass
            else:
                drone.grants.remove(grant)
            await until(lambda: not sky.truth.armed)
            body = sky.truth.body
            assert math.hypot(body.north - north_m, body.east - east_m) < ACCURACY_M

    fly(work, tmp_path, None, WEATHERS[weather])
