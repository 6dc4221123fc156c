"""Another station accelerates the drone in GUIDED while its driver hovers. The monitor must stop the drone in time."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest
import shapely
import virtual_time
from closed_loop import Account, Oracle, Sky
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_runtime.mavlink_codec import Endpoint
from fractus_services.mobility.autopilot import VELOCITY_HISTORY_S
from mobility_world import FRAME, World, end, goto, spec, zone
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until

WALL = shapely.box(-100.0, 40.0, 100.0, 70.0)
MIN_DISTANCE_M = 1.0


@pytest.mark.parametrize("action", ["ignore", "returnToLaunch"])
def test_drone_commanded_by_another_station_stops_before_zone(action: str, tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        station = Endpoint(255, mavlink.MAV_COMP_ID_MISSIONPLANNER)
        oracle = Oracle(sky, Account(0))

        def send(name: str, **values: float) -> None:
            frame = station.encode(name, {"target_system": 1, "target_component": 1, **values})
            sky.craft.receive(sky.wires[0]._channel, frame)

        async with ready(sky, directory) as (drone, grant):
            drone.grants.put(spec(zone("wall", action, *WALL.bounds)))
            await drone.service.arm(grant, 120.0)
            async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                pass
            # Wait until the previous grant no longer affects the monitor.
            await asyncio.sleep(35.0)
            distances_m: list[float] = []
            sky.witnesses.append(lambda: distances_m.append(WALL.distance(shapely.Point(*oracle.place()[:2]))))
            lat, lon = FRAME.latlon(0.0, 90.0)
            send(
                "COMMAND_INT", command=mavlink.MAV_CMD_DO_REPOSITION, frame=mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, param1=12.0,
                param4=math.nan, x=round(lat * 1e7), y=round(lon * 1e7), z=15.0,
            )  # fmt: skip
            send(
                "COMMAND_LONG",
                command=mavlink.MAV_CMD_DO_CHANGE_SPEED,
                param1=mavlink.SPEED_TYPE_GROUNDSPEED,
                param2=12.0,
                param3=-1.0,
            )
            await until(lambda: oracle.speeds()[0] > 5.0)
            await until(lambda: oracle.speeds()[0] < 0.2 or not sky.truth.armed)
            assert MIN_DISTANCE_M <= min(distances_m) < 15.0

    fly(work, tmp_path)


@pytest.mark.parametrize(("speed_mps", "stopped"), [(0.45, False), (0.6, True)])
def test_gust_does_not_brake_hovering_drone_beside_zone(speed_mps: float, stopped: bool, tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(zone("wall", "ignore", *WALL.bounds)))
            await world.up(grant)
            await end(world.service.goto(grant, goto(0.0, 37.5), 0.0))
            await asyncio.sleep(35.0)
            plane = world.plane
            plane.commands.clear()
            plane.vehicle.north_mps = speed_mps
            plane.vehicle.velocity_history.clear()
            plane.vehicle.velocity_history.extend([(0.0, -speed_mps, 0.0), (VELOCITY_HISTORY_S, speed_mps, 0.0)])
            assert plane.vehicle.keeps_place(plane.now) is not stopped
            world.monitor.check()
            assert bool(plane.commands) is stopped

    virtual_time.fly(flight)
