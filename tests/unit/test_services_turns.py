"""Long computations and floods of calls leave the loop to monitor, watchdog and heartbeats."""

from __future__ import annotations

import asyncio
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from fractus_core.policy.values import Call
from fractus_services.mobility import background, courses, service
from fractus_services.mobility.background import in_slices
from mobility_world import World, fly, partial, spec, zone

WALL = (-40.0, 25.0, 40.0, 40.0)


class Clock:
    """Each look at it costs a millisecond."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def perf_counter(self) -> float:
        self.seconds += 0.001
        return self.seconds


async def test_others_have_their_turn_during_a_long_computation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background, "time", Clock())
    turns = 0

    async def other() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    def long() -> Generator[None, None, str]:
        for _ in range(400):
            yield
        return "done"

    task = asyncio.ensure_future(other())
    assert await in_slices(long()) == "done"
    task.cancel()
    assert turns > 80, "every four milliseconds"


def test_fences_that_change_during_a_search_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            held = world.grants.put(partial())
            searches = 0

            async def slowly(search: Any) -> Any:
                nonlocal searches
                searches += 1
                if searches == 1:
                    world.grants.put(partial(zone("wall", "ignore", *WALL)))
                return await in_slices(search)

            monkeypatch.setattr(courses, "in_slices", slowly)
            await world.drive(held)
            assert searches > 2
            assert max(abs(x) for x, _, _ in world.plane.trace) > 41, "around the wall from the first leg on"
            assert not [e for e in world.kinds("control") if e["action"] == "brake"]

    fly(flight)


def test_who_asks_much_waits_and_who_drives_waits_less(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            held = world.grants.put(spec())
            other = world.grants.put(spec(instance="app-viewer", **{"class": "passenger", "control": None}), "m2")
            await world.drive(held)
            monkeypatch.setattr(service, "time", Clock())

            async def ask(who: Any, times: int) -> float:
                async def once() -> None:
                    await world.service.turn(who)
                    world.service.check(Call("GetPosition"), who)

                begun = world.plane.now
                await asyncio.gather(*(once() for _ in range(times)))
                return world.plane.now - begun

            flood = asyncio.ensure_future(ask(other, 101))
            assert await ask(held, 101) == pytest.approx(0.1, abs=0.02)
            assert not flood.done()
            assert await flood == pytest.approx(0.4, abs=0.05)

    fly(flight)
