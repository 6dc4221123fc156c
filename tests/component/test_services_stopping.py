"""A service that is stopped on the ground restores the owner's fence and parameters first, and does not arm meanwhile."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from fractus_services.errors import Unavailable
from fractus_services.mobility.settings import SETTINGS
from mobility_world import LAND, World, refusal, spec
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import fly

OWNED = {"RTL_ALT": 4000.0, "WPNAV_SPEED": 1000.0, "RTL_CLIMB_MIN": 500.0, "GUID_TIMEOUT": 3.0, "RALLY_LIMIT_KM": 0.3}
LIMITS = {"maxAltitude": 12, "maxSpeed": 3.5}


def held(world: World) -> dict[str, float]:
    return {name: world.plane.parameters[name] for name in OWNED}


async def fly_once(world: World, *, returns_control: bool = True) -> None:
    """Fly a mission, and return as soon as the motors have stopped."""
    grant = world.grants.put(spec(limits=LIMITS))
    await world.up(grant, 5.0)
    assert held(world) != OWNED
    assert world.fence.raised
    if returns_control:
        await world.control.return_control(grant)
    else:
        world.plane.set_to(LAND)
    await world.until(lambda: not world.plane.vehicle.armed)
    assert held(world) != OWNED


def test_stopped_service_restores_owner_values_of_a_landed_drone(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            await fly_once(world)
            began = world.plane.now
            await world.supervisor.stop()
            assert held(world) == OWNED
            assert not world.fence.raised
            assert not (tmp_path / "return.json").exists()
            assert world.plane.now - began < SETTINGS.lower_after_s, "nothing is waited for"

    fly(flight)


def test_stopped_service_restores_owner_values_while_the_mission_has_not_ended(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            await fly_once(world, returns_control=False)
            assert not world.outcome()
            await world.supervisor.stop()
            assert held(world) == OWNED
            assert not world.fence.raised

    fly(flight)


def test_stopped_service_leaves_a_flying_drone_to_the_failsafe_at_once(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            await world.up(world.grants.put(spec(limits=LIMITS)), 5.0)
            began = world.plane.now
            await world.supervisor.stop()
            assert world.plane.now == began
            assert world.plane.vehicle.armed
            assert world.fence.raised
            assert held(world) != OWNED

    fly(flight)


def test_stopped_service_waits_until_the_motors_of_a_landed_drone_stop(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            grant = world.grants.put(spec(limits=LIMITS))
            await world.drive(grant)
            await world.service.arm(grant)
            stopping = asyncio.ensure_future(world.supervisor.stop())
            await asyncio.sleep(5.0)
            assert not stopping.done()
            assert world.fence.raised
            world.plane.vehicle.armed = False
            await stopping
            assert held(world) == OWNED
            assert not world.fence.raised

    fly(flight)


def test_stopping_service_refuses_to_arm(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            await fly_once(world)
            await world.supervisor.stop()
            flown = world.plane.commands.count(mavlink.MAV_CMD_COMPONENT_ARM_DISARM)
            grant = world.grants.put(spec(limits=LIMITS), key="m2")
            await world.drive(grant)
            refused = await refusal(world.service.arm(grant))
            assert isinstance(refused, Unavailable)
            assert refused.verdict.code == "ServiceStopping"
            assert world.plane.commands.count(mavlink.MAV_CMD_COMPONENT_ARM_DISARM) == flown
            assert held(world) == OWNED

    fly(flight)


def test_stopping_service_ends_an_arming_attempt_before_the_motors_start(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            grant = world.grants.put(spec(limits=LIMITS))
            await world.drive(grant)
            raise_fence = world.fence.raise_around

            async def slowly(granted: object, *, retraces: bool) -> None:
                await asyncio.sleep(4)
                await raise_fence(granted, retraces=retraces)  # type: ignore[arg-type]

            world.fence.raise_around = slowly  # type: ignore[method-assign]
            arming = asyncio.ensure_future(world.service.arm(grant))
            await asyncio.sleep(1)
            await world.supervisor.stop()
            assert isinstance(await refusal(arming), Unavailable)
            assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM not in world.plane.commands
            assert not world.fence.raised
            assert held(world) == OWNED

    fly(flight)


def test_stopped_service_ends_at_once_if_the_autopilot_is_silent(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            await fly_once(world)
            world.plane.disconnected = True
            await asyncio.sleep(30)
            began = world.plane.now
            await world.supervisor.stop()
            assert world.plane.now == began
            assert (tmp_path / "return.json").exists(), "the next start restores the values"

    fly(flight)


def test_stopped_service_repeats_a_restore_whose_messages_are_lost(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            await fly_once(world)
            world.plane.fixed = ("WPNAV_SPEED",)
            stopping = asyncio.ensure_future(world.supervisor.stop())
            await asyncio.sleep(5)
            assert not stopping.done()
            world.plane.fixed = ()
            await stopping
            assert held(world) == OWNED

    fly(flight)


def test_stopped_service_gives_up_a_restore_that_the_autopilot_refuses(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            await fly_once(world)
            world.plane.fixed = ("WPNAV_SPEED",)
            began = world.plane.now
            await world.supervisor.stop()
            assert world.plane.now - began == pytest.approx(SETTINGS.stop_timeout_s, abs=1.0)
            assert (tmp_path / "return.json").exists(), "the next start restores the values"
            assert not world.fence.raised, "one failure does not prevent the other restore"

    fly(flight)
