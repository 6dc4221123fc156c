"""A GPS that reports a wrong position in flight: the drone stops, and flies again when the position is consistent again."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator
from dataclasses import replace
from pathlib import Path

import pytest
import shapely
from closed_loop import Account, Drone, Oracle, Sky
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_services.errors import AutopilotError, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.flight import return_to_launch
from fractus_services.mobility.rpc.telemetry import located
from fractus_services.mobility.settings import SETTINGS
from mobility_world import end, goto, spec, zone
from sky_drone import fly, ready, until

SOUTH = shapely.box(-60.0, -80.0, 190.0, -23.0)
"""A zone 23 m beside a course to the east. A vehicle whose estimate is 33 m north of its course flies south into the zone."""

GLITCH_DEG = 0.0003
"""About 33 m."""


@contextlib.asynccontextmanager
async def flying_past_zone(
    sky: Sky, directory: Path, *, homeward: bool = False
) -> AsyncGenerator[tuple[Drone, list[float]]]:
    """A drone on a leg beside the zone, and its true distances from the zone. Its driver retries as the SDK does.

    If `homeward` is True, the driver has left, and the system flies the drone home.
    """
    oracle = Oracle(sky, Account(0))
    async with ready(sky, directory) as (drone, grant):
        drone.grants.put(spec(zone("south", "ignore", *SOUTH.bounds)))
        await drone.service.arm(grant, 120.0)
        async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
            pass
        distances_m: list[float] = []
        sky.witnesses.append(lambda: distances_m.append(SOUTH.distance(shapely.Point(*oracle.place()[:2]))))
        driving = asyncio.ensure_future(_drive(drone, grant))
        await asyncio.sleep(4.0)
        assert oracle.speeds()[0] > 4.0
        if homeward:
            await asyncio.sleep(10.0)
            driving.cancel()
            drone.grants.remove(grant)
            await until(lambda: sky.truth.body.ve < -4.0)
        yield drone, distances_m
        driving.cancel()


async def _fly_above_zone(drone: Drone, grant: ActiveGrant) -> None:
    """Fly to a place above a zone that ends 13 m below the drone."""
    below = zone("below", "ignore", 10.0, -40.0, 60.0, 40.0)
    below["zones"][0]["altitude"] = {"lower": -5.0, "upper": 12.0, "reference": "home"}
    drone.grants.put(spec(below))
    await drone.service.arm(grant, 120.0)
    await end(drone.service.take_off(grant, TakeoffArgs(25.0)))
    await end(drone.service.goto(grant, goto(35.0, 0.0, 25.0), 0.0))


async def _drive(drone: Drone, grant: ActiveGrant) -> None:
    """Fly to the end of the zone and back."""
    for call in (
        lambda: drone.service.goto(grant, goto(150.0, 0.0, 15.0), 0.0),
        lambda: drone.service.return_to_launch(grant),
    ):
        while True:
            try:
                async for _ in call():
                    pass
                break
            except (Unavailable, AutopilotError):
                await asyncio.sleep(0.5)
            except Refused:
                return


@pytest.mark.parametrize("homeward", [False, True])
@pytest.mark.parametrize("lasting_s", [3.0, 10.0, 40.0])
def test_drone_never_enters_zone_while_gps_is_wrong(tmp_path: Path, lasting_s: float, homeward: bool) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with flying_past_zone(sky, directory, homeward=homeward) as (_drone, distances_m):
            sky.truth.params.assign("SIM_GPS_GLITCH_X", GLITCH_DEG)
            await asyncio.sleep(lasting_s)
            sky.truth.params.assign("SIM_GPS_GLITCH_X", 0.0)
            await until(lambda: not sky.truth.armed, 300.0)
            assert min(distances_m) > 15.0
            assert not sky.truth.body.crashed

    fly(work, tmp_path)


def test_drone_returns_home_after_glitch_and_lands_there(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with flying_past_zone(sky, directory) as (drone, _distances_m):
            sky.truth.params.assign("SIM_GPS_GLITCH_X", GLITCH_DEG)
            await asyncio.sleep(10.0)
            sky.truth.params.assign("SIM_GPS_GLITCH_X", 0.0)
            await until(lambda: drone.control.state.returning, 30.0)
            await until(lambda: not sky.truth.armed, 300.0)
            assert math.hypot(sky.truth.body.north, sky.truth.body.east) < 3.0

    fly(work, tmp_path)


def test_drone_lands_where_it_is_if_jump_of_position_is_not_undone(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with flying_past_zone(sky, directory) as (_drone, _distances_m):
            sky.truth.params.assign("SIM_GPS_GLITCH_X", GLITCH_DEG)
            await asyncio.sleep(8.0)
            east_m = sky.truth.body.east
            await until(lambda: not sky.truth.armed, 300.0)
            assert sky.truth.body.east == pytest.approx(east_m, abs=2.0)
            assert abs(sky.truth.body.north) < 2.0

    fly(work, tmp_path)


def test_drone_above_zone_waits_longer_for_position_before_it_lands(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await _fly_above_zone(drone, grant)
            sky.truth.params.assign("SIM_GPS_GLITCH_X", GLITCH_DEG)
            await asyncio.sleep(110.0)
            assert -sky.truth.body.down > 20.0
            assert sky.truth.body.east == pytest.approx(35.0, abs=3.0)
            sky.truth.params.assign("SIM_GPS_GLITCH_X", 0.0)
            await until(lambda: not sky.truth.armed, 200.0)
            assert math.hypot(sky.truth.body.north, sky.truth.body.east) < 3.0

    fly(work, tmp_path)


def test_drone_above_zone_lands_if_position_stays_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(return_to_launch, "SETTINGS", replace(SETTINGS, position_problem_above_zone_timeout_s=70.0))

    async def work(sky: Sky, directory: Path) -> None:
        async with ready(sky, directory) as (drone, grant):
            await _fly_above_zone(drone, grant)
            sky.truth.params.assign("SIM_GPS_GLITCH_X", GLITCH_DEG)
            await asyncio.sleep(68.0)
            assert -sky.truth.body.down > 20.0
            await until(lambda: not sky.truth.armed, 100.0)
            assert sky.truth.body.east == pytest.approx(35.0, abs=3.0)

    fly(work, tmp_path)


def test_drone_brakes_as_soon_as_gps_and_estimate_disagree(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with flying_past_zone(sky, directory) as (drone, _distances_m):
            sky.truth.params.assign("SIM_GPS_GLITCH_X", GLITCH_DEG)
            await until(lambda: not located(drone.control), 2.0)
            await until(lambda: abs(sky.truth.body.ve) < 0.5, 6.0)

    fly(work, tmp_path)


def test_mission_cannot_begin_in_flight_while_position_is_not_trusted(tmp_path: Path) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        async with flying_past_zone(sky, directory) as (drone, _distances_m):
            (key,) = drone.control.state.missions
            assert drone.control.not_ready_reason(key) is None
            sky.truth.params.assign("SIM_GPS_GLITCH_X", GLITCH_DEG)
            await until(lambda: bool(drone.control.autopilot.vehicle.position_problem), 2.0)
            assert drone.control.not_ready_reason(key) == "position and home are not known yet"

    fly(work, tmp_path)
