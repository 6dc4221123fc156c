"""Suspension of a driver while its drone flies to a target that a geofence corrected."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fractus_core.policy.decision_types import SetSpeedArgs, TakeoffArgs, VelocityArgs
from fractus_services.errors import Unavailable
from fractus_services.grant_files import ActiveGrant
from mobility_world import World, clearance_m, end, goto, refusal, spec, zone
from virtual_time import fly

WALL = (-40.0, 60.0, 40.0, 80.0)
LEGAL_M = 56.0
"""A corrected leg to the north ends about here, before the wall."""


async def begin_corrected_leg(world: World) -> tuple[ActiveGrant, asyncio.Task[Any]]:
    """Request a leg through the wall, which the engine ends before it, and wait until the drone flies."""
    grant = world.grants.put(spec(zone("wall", "adjust", *WALL)))
    await world.up(grant)
    leg = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 120), 0)))
    await world.until(lambda: world.plane.xy[1] > 10)
    return grant, leg


MOTIONS: dict[str, Callable[[World, ActiveGrant], Any]] = {
    "Goto": lambda world, grant: world.service.goto(grant, goto(0, 0), 0),
    "SetVelocity": lambda world, grant: world.service.set_velocity(grant, VelocityArgs(-1, 0)),
    "Takeoff": lambda world, grant: world.service.take_off(grant, TakeoffArgs(30)),
}


@pytest.mark.parametrize("method", MOTIONS)
def test_motion_is_refused_until_corrected_target_is_reached(tmp_path: Path, method: str) -> None:
    async def request(world: World, grant: ActiveGrant) -> Any:
        # Motions are generator functions that judge their call when they are called.
        motion = MOTIONS[method](world, grant)
        return await (end(motion) if hasattr(motion, "__aiter__") else motion)

    async def flight() -> None:
        async with World(tmp_path) as world:
            grant, leg = await begin_corrected_leg(world)
            refused = await refusal(request(world, grant))
            assert isinstance(refused, Unavailable)
            assert (refused.verdict.code, refused.verdict.policies) == ("Suspended", ("wall",))
            assert refused.retry_after_s > 0
            assert [call["method"] for call in world.kinds("call") if call["code"] == "Suspended"] == [method]
            assert (await leg).verdict.action == "correct"
            assert world.plane.xy[1] == pytest.approx(LEGAL_M, abs=3)
            await world.until(lambda: abs(world.plane.velocity[1]) < 0.1)
            await request(world, grant)

    fly(flight)


def test_speed_may_change_during_corrected_leg(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant, leg = await begin_corrected_leg(world)
            verdict, _ = await world.service.set_speed(grant, SetSpeedArgs(2.0))
            assert verdict.permits
            await leg

    fly(flight)


@pytest.mark.parametrize("method", ["hover", "land", "return_to_launch"])
def test_stopping_motions_end_corrected_leg(tmp_path: Path, method: str) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant, leg = await begin_corrected_leg(world)
            call = getattr(world.service, method)(grant)
            await (call if method == "hover" else end(call))
            assert (await refusal(leg)).verdict.code == "Replaced"
            if method == "hover":
                await end(world.service.goto(grant, goto(0, 0), 0))

    fly(flight)


def test_cancelled_leg_suspends_no_further_motion(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant, leg = await begin_corrected_leg(world)
            leg.cancel()
            await asyncio.gather(leg, return_exceptions=True)
            await end(world.service.goto(grant, goto(0, 0), 0))

    fly(flight)


def test_suspension_ends_after_a_minute(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(zone("wall", "adjust", *WALL)))
            await world.up(grant)
            began = world.plane.now
            leg = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 120, speed_mps=0.3), 0)))
            await world.until(lambda: world.plane.now > began + 59)
            assert (await refusal(_goto(world, grant))).verdict.code == "Suspended"
            await world.until(lambda: world.plane.now > began + 61)
            await end(world.service.goto(grant, goto(0, 0), 0))
            assert (await refusal(leg)).verdict.code == "Replaced"
            assert clearance_m(world, *WALL) > 0

    fly(flight)


async def _goto(world: World, grant: ActiveGrant) -> Any:
    return await end(world.service.goto(grant, goto(0, 0), 0))


def test_uncorrected_leg_may_be_replaced(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(zone("wall", "adjust", *WALL)))
            await world.up(grant)
            leg = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 40), 0)))
            await world.until(lambda: world.plane.xy[1] > 10)
            await end(world.service.goto(grant, goto(0, 0), 0))
            assert (await refusal(leg)).verdict.code == "Replaced"

    fly(flight)


def test_leg_corrected_in_altitude_only_may_be_replaced(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            low = {"name": "low", "spec": {"type": "LimitControl", "kind": "altitude", "upperLimit": 12}, "zones": []}
            grant = world.grants.put(spec(low))
            await world.up(grant)
            leg = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 80, 30), 0)))
            await world.until(lambda: world.plane.xy[1] > 10)
            await end(world.service.goto(grant, goto(0, 0), 0))
            assert (await refusal(leg)).verdict.code == "Replaced"

    fly(flight)
