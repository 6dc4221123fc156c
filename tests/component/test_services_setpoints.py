"""Velocity setpoints of a driver: repetition, replacement and expiry."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest
from fractus_core.policy.decision_types import VelocityArgs
from fractus_core.policy.kinematics import motion_before_reaction
from fractus_services.errors import AutopilotError
from mobility_world import World, clearance_m, end, goto, refusal, spec, zone
from virtual_time import fly

WALL = (-40.0, 25.0, 40.0, 40.0)


def test_velocity_setpoint_expires_after_hold_time(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            _, flown = await world.service.set_velocity(grant, VelocityArgs(4.0, 0.0, hold_s=1.0))
            assert flown.north_mps == 4.0
            await asyncio.sleep(0.9)
            assert world.plane.velocity[1] > 1.5
            await world.until(lambda: abs(world.plane.velocity[1]) < 0.1, 10)
            assert world.control.motion is None
            assert world.control.state.controller == grant.identity
            assert world.plane.xy[1] < 15

    fly(flight)


def test_velocity_setpoints_in_succession_keep_drone_moving(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            for _ in range(50):
                await world.service.set_velocity(grant, VelocityArgs(3.0, 1.0, -0.5, hold_s=0.5))
                await asyncio.sleep(0.1)
            assert world.plane.velocity == pytest.approx([1.0, 3.0], abs=0.1)
            assert world.plane.height > 11
            assert world.plane.commands.count(84) > 40

    fly(flight)


def test_velocity_setpoints_do_not_enter_exclusion_zone(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(zone("no-fly", "ignore", -50, 30, 50, 60)))
            await world.up(grant)
            refused = 0
            for _ in range(120):
                try:
                    await world.service.set_velocity(grant, VelocityArgs(8.0, 0.0, hold_s=1.0))
                except Exception as error:
                    refused += 1
                    assert "no-fly" in str(error)
                await asyncio.sleep(0.2)
            assert refused > 50
            assert clearance_m(world, -50, 30, 50, 60) > 0.5
            assert world.control.state.controller == grant.identity

    fly(flight)


def test_goto_and_velocity_setpoint_replace_each_other(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 100), 0)))
            await world.until(lambda: world.plane.velocity[1] > 3)
            await world.service.set_velocity(grant, VelocityArgs(0.0, 3.0, hold_s=2.0))
            assert (await flying).verdict.code == "Replaced"
            await end(world.service.goto(grant, goto(30, 30), 0))
            await asyncio.sleep(5)
            assert math.dist(world.plane.xy, (30, 30)) < 1.5, "the hold time does not stop the Goto"

    fly(flight)


def test_velocity_setpoint_ends_when_driver_is_lost(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            stream = await world.up(grant)
            await world.service.set_velocity(grant, VelocityArgs(5.0, 0.0, hold_s=2.0))
            await asyncio.sleep(0.5)
            sent = len(world.plane.commands)
            stream.cancel()
            await asyncio.sleep(0.5)
            assert set(world.plane.commands[sent:]) <= {84, 176}
            await world.until(lambda: abs(world.plane.velocity[1]) < 0.2, 5)
            assert world.control.state.controller == "system"

    fly(flight)


def test_velocity_setpoint_expires_directly_after_hover(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await world.service.set_velocity(grant, VelocityArgs(3.0, 0.0, hold_s=2.0))
            await asyncio.sleep(0.5)
            await world.service.hover(grant)
            await world.service.set_velocity(grant, VelocityArgs(4.0, 0.0, hold_s=0.5))
            await asyncio.sleep(0.4)
            assert world.plane.velocity_setpoint == (0.0, 4.0, 0.0)
            await asyncio.sleep(0.2)
            assert world.plane.velocity_setpoint == (0.0, 0.0, 0.0)
            assert world.control.motion is None

    fly(flight)


def test_failed_velocity_setpoint_stops_previous_setpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await world.service.set_velocity(grant, VelocityArgs(4.0, 0.0, hold_s=2.0))
            await asyncio.sleep(0.3)

            async def refuses(*_: object) -> None:
                raise AutopilotError("not now")

            with monkeypatch.context() as broken:
                broken.setattr(world.control.modes, "change_mode", refuses)
                with pytest.raises(AutopilotError, match="not now"):
                    await world.service.set_velocity(grant, VelocityArgs(5.0, 0.0, hold_s=2.0))
                await asyncio.sleep(0.05)
            for _ in range(10):
                await asyncio.sleep(0.1)
                assert world.plane.velocity_setpoint == (0.0, 0.0, 0.0)

    fly(flight)


def test_delayed_velocity_setpoint_expires_after_hold_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await world.service.set_velocity(grant, VelocityArgs(4.0, 0.0, hold_s=0.5))
            change_mode = world.control.modes.change_mode

            async def slow(*args: Any) -> None:
                monkeypatch.setattr(world.control.modes, "change_mode", change_mode)
                await asyncio.sleep(1.0)
                await change_mode(*args)

            monkeypatch.setattr(world.control.modes, "change_mode", slow)
            await world.service.set_velocity(grant, VelocityArgs(0.0, 3.0, hold_s=0.5))
            assert world.plane.velocity_setpoint == (3.0, 0.0, 0.0)
            await asyncio.sleep(0.7)
            assert world.plane.velocity_setpoint == (0.0, 0.0, 0.0), "the setpoint expired"

    fly(flight)


def test_predicted_deceleration_ends_at_the_setpoint(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.measured = True
            grant = world.grants.put(spec())
            await world.up(grant)
            for north in (8.0, 8.0, 8.0, 4.0):
                await world.service.set_velocity(grant, VelocityArgs(north, 0.0, hold_s=2.0))
                await asyncio.sleep(1.4)
            now = world.gate.situation()
            assert now.forward_mps2 is not None
            assert now.forward_mps2 < -2.0
            assert now.pending == ((4.0, 0.0, 0.0),)
            assert motion_before_reaction(now).speed_mps == pytest.approx(now.north_mps)
            await world.service.hover(grant)
            await asyncio.sleep(1.0)
            assert world.gate.situation().pending == ((0.0, 0.0, 0.0),)

    fly(flight)
