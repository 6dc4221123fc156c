"""Motions that meet: one begins while another ends, and nobody loses sight of the drone in between."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from fractus_core.policy.values import GotoArgs, VelocityArgs
from fractus_services.mobility.autopilot import AutopilotError
from mobility_world import World, at, fly, refusal, spec


def goto(x: float, y: float, alt: float = 10.0, **more: Any) -> GotoArgs:
    return GotoArgs(*at(x, y), alt, **more)


# Setpoints


def test_a_setpoint_right_after_another_motion_runs_out_as_well(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            held = world.grants.put(spec())
            await world.up(held)
            await world.service.set_velocity(held, VelocityArgs(3.0, 0.0, hold_s=2.0))
            await asyncio.sleep(0.5)
            await world.service.hover(held)
            await world.service.set_velocity(held, VelocityArgs(4.0, 0.0, hold_s=0.5))
            await asyncio.sleep(0.4)
            assert world.plane.wanted == (0.0, 4.0, 0.0)
            await asyncio.sleep(0.2)
            assert world.plane.wanted == (0.0, 0.0, 0.0)
            assert world.control.motion is None

    fly(flight)


def test_a_second_stream_of_the_driver_ends_the_setpoint_of_the_first(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            held = world.grants.put(spec())
            await world.up(held)
            await world.service.set_velocity(held, VelocityArgs(4.0, 0.0, hold_s=2.0))
            await world.drive(held)
            await asyncio.sleep(0.3)
            assert world.plane.wanted == (0.0, 0.0, 0.0), "nobody watches it but us"
            assert world.control.motion is None
            await world.service.set_velocity(held, VelocityArgs(0.0, 2.0, hold_s=0.5))
            assert world.plane.wanted == (2.0, 0.0, 0.0)

    fly(flight)


def test_a_setpoint_that_fails_ends_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            held = world.grants.put(spec())
            await world.up(held)
            await world.service.set_velocity(held, VelocityArgs(4.0, 0.0, hold_s=2.0))
            await asyncio.sleep(0.3)

            async def refuses(*_: object) -> None:
                raise AutopilotError("not now")

            with monkeypatch.context() as broken:
                broken.setattr(world.control.helm, "change_mode", refuses)
                with pytest.raises(AutopilotError, match="not now"):
                    await world.service.set_velocity(held, VelocityArgs(5.0, 0.0, hold_s=2.0))
                await asyncio.sleep(0.05)
            for _ in range(10):
                await asyncio.sleep(0.1)
                assert world.plane.wanted == (0.0, 0.0, 0.0)

    fly(flight)


def test_a_setpoint_that_waited_is_watched_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            held = world.grants.put(spec())
            await world.up(held)
            await world.service.set_velocity(held, VelocityArgs(4.0, 0.0, hold_s=0.5))
            change_mode = world.control.helm.change_mode

            async def slow(*args: Any) -> None:
                monkeypatch.setattr(world.control.helm, "change_mode", change_mode)
                await asyncio.sleep(1.0)
                await change_mode(*args)

            monkeypatch.setattr(world.control.helm, "change_mode", slow)
            await world.service.set_velocity(held, VelocityArgs(0.0, 3.0, hold_s=0.5))
            assert world.plane.wanted == (3.0, 0.0, 0.0)
            await asyncio.sleep(0.7)
            assert world.plane.wanted == (0.0, 0.0, 0.0), "it ran out"

    fly(flight)
