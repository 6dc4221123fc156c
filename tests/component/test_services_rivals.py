"""Another station that commands the drone in GUIDED while its driver hovers: the monitor counts how it speeds up."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest
import shapely
from closed_loop import Account, Oracle, Sky
from fractus_core.policy.values import TakeoffArgs
from fractus_mavlink import Endpoint
from fractus_mavlink.enums import MAV_CMD, MAV_COMPONENT, MAV_FRAME, SPEED_TYPE
from mobility_world import FRAME, spec, zone
from sky_drone import fly, ready, until

WALL = shapely.box(-100.0, 40.0, 100.0, 70.0)
KEPT_M = 1.0


@pytest.mark.parametrize("action", ["ignore", "returnToLaunch"])
def test_a_drone_that_another_station_sends_into_a_zone_is_stopped_before_it(action: str, tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        station, oracle = Endpoint(255, MAV_COMPONENT.MISSIONPLANNER), Oracle(sky, Account(0))

        def tell(name: str, **values: float) -> None:
            frame = station.encode(name, {"target_system": 1, "target_component": 1, **values})
            sky.craft.receive(sky.wires[0]._channel, frame)

        async with ready(sky, directory) as (drone, grant):
            drone.grants.put(spec(zone("wall", action, *WALL.bounds)))
            await drone.service.arm(grant, 120.0)
            async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                pass
            # Longer ago than what the grant was before may matter.
            await asyncio.sleep(35.0)
            kept_m: list[float] = []
            sky.witnesses.append(lambda: kept_m.append(WALL.distance(shapely.Point(*oracle.place()[:2]))))
            lat, lon = FRAME.latlon(0.0, 90.0)
            tell(
                "COMMAND_INT", command=MAV_CMD.DO_REPOSITION, frame=MAV_FRAME.GLOBAL_RELATIVE_ALT, param1=12.0,
                param4=math.nan, x=round(lat * 1e7), y=round(lon * 1e7), z=15.0,
            )  # fmt: skip
            tell(
                "COMMAND_LONG", command=MAV_CMD.DO_CHANGE_SPEED, param1=SPEED_TYPE.GROUNDSPEED, param2=12.0, param3=-1.0
            )
            await until(lambda: oracle.speeds()[0] > 5.0)
            await until(lambda: oracle.speeds()[0] < 0.2 or not sky.truth.armed)
            assert KEPT_M <= min(kept_m) < 15.0

    fly(work, tmp_path)
