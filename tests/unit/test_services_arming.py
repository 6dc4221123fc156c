"""Arming: one at a time, on failsafes that are known at that moment, which a link that comes back leaves as chosen."""

from __future__ import annotations

import asyncio
from pathlib import Path

from fractus_core.api.plans import GrantSpec
from fractus_core.policy.values import TakeoffArgs
from mobility_world import World, end, fly, refusal, spec


class Slow:
    """A fence that takes its time; tells whether the drone was armed when each raising began."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.began_armed: list[bool] = []

    async def __call__(self, _spec: GrantSpec, *, retraces: bool) -> None:
        del retraces
        self.began_armed.append(self._world.plane.vehicle.armed)
        await asyncio.sleep(4)
        self._world.fence.raised = True


def test_who_asks_twice_arms_once(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            held = world.grants.put(spec())
            await world.drive(held)
            slow = world.fence.raise_around = Slow(world)
            first, second = (asyncio.ensure_future(world.service.arm(held)) for _ in range(2))
            await first
            await end(world.service.take_off(held, TakeoffArgs(10.0)))
            await second
            assert slow.began_armed == [False], "nothing is prepared under a drone that flies"
            assert world.plane.commands.count(400) == 1
            assert world.plane.vehicle.armed

    fly(flight)


def test_who_waits_to_arm_must_still_be_allowed_to(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            held = world.grants.put(spec())
            await world.drive(held)
            slow = world.fence.raise_around = Slow(world)
            calls = [asyncio.ensure_future(world.service.arm(held)) for _ in range(2)]
            await asyncio.sleep(1)
            await world.control.give_back(held)
            for call in calls:
                await refusal(call)
            assert slow.began_armed == [False]
            assert 400 not in world.plane.commands

    fly(flight)
