"""Ways home: begun at rest, tried again when the autopilot refuses, and what stays behind after them."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest
import shapely
from fractus_core.control.values import FlightMode
from fractus_core.policy.values import GotoArgs
from fractus_mavlink.enums import MAV_CMD
from fractus_services.mobility.authority import drivers
from mobility_world import LAND, RTL, SMART_RTL, World, at, end, fly, partial, refusal, spec, touring, zone

WALL = (-40.0, 25.0, 40.0, 40.0)
REPOSITION = 192


def clear_m(world: World, *box: float) -> float:
    return float(min(shapely.box(*box).distance(shapely.Point(x, y)) for x, y, _ in world.plane.trace))


async def beyond_the_wall(world: World) -> None:
    """A driver whose way home is behind a wall gives the drone back."""
    grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
    await world.up(grant)
    for x, y in ((60, 30), (60, 70), (0, 70)):
        await end(world.service.goto(grant, GotoArgs(*at(x, y), 10.0), 0))
    await drivers.give_back(world.control, grant)


def test_a_driver_turns_home_from_standstill(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(end(world.service.goto(grant, GotoArgs(*at(0, 90), 10.0), 0)))
            await world.until(lambda: world.plane.velocity[1] > 6)
            turned: list[float] = []
            obey = world.plane.set_to

            def noted(mode: FlightMode) -> None:
                if mode == RTL:
                    turned.append(math.hypot(*world.plane.velocity))
                obey(mode)

            world.plane.set_to = noted  # type: ignore[method-assign]
            await end(world.service.return_to_launch(grant))
            assert turned
            assert max(turned) < 0.5
            with pytest.raises(Exception, match="replaced"):
                await flying

    fly(flight)


def test_a_drone_that_finds_no_rest_flies_home_all_the_same(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            tell = world.plane._tell

            def gusty() -> None:
                tell()
                world.plane.vehicle.east_mps += 0.7

            world.plane._tell = gusty  # type: ignore[method-assign]
            await end(world.service.return_to_launch(grant))

    fly(flight)


def test_one_refused_command_leads_through_no_zone(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            plane = world.plane
            await beyond_the_wall(world)
            plane.commands.clear()
            plane.refuses.add(REPOSITION)
            await world.until(lambda: REPOSITION in plane.commands)
            plane.refuses.clear()
            await world.until(lambda: not plane.vehicle.armed)
            assert clear_m(world, *WALL) > 1.0
            assert "NoLegalWay" not in {e["code"] for e in world.kinds("control")}

    fly(flight)


@pytest.mark.parametrize(("remembers", "mode"), [(True, SMART_RTL), (False, RTL)])
def test_an_autopilot_that_refuses_again_and_again_brings_the_drone_home_itself(
    tmp_path: Path, remembers: bool, mode: FlightMode
) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            plane = world.plane
            plane.vehicle.path_lost = not remembers
            if remembers:
                await beyond_the_wall(world)
            else:
                grant = world.grants.put(spec())
                await world.up(grant)
                await end(world.service.goto(grant, GotoArgs(*at(0, 70), 10.0), 0))
                world.grants.put(spec(zone("wall", "ignore", *WALL)))
                await drivers.give_back(world.control, grant)
            plane.commands.clear()
            plane.refuses.add(REPOSITION)
            await world.until(lambda: plane.vehicle.mode in {RTL, SMART_RTL, LAND})
            assert plane.vehicle.mode == mode
            assert plane.commands.count(REPOSITION) == 3
            notes = [e["reason"] for e in world.kinds("control") if e["code"] == "NoLegalWay"]
            assert "the autopilot refused 3 times" in notes[-1]

    fly(flight)


@pytest.mark.parametrize("how", ["returned", "grace", "removed", "refused", "unused"])
def test_no_fence_outlives_its_mission(tmp_path: Path, how: str) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            if how in {"refused", "unused"}:
                await world.drive(grant)
                world.plane.refuses |= {MAV_CMD.COMPONENT_ARM_DISARM} if how == "refused" else set()
                arming = asyncio.ensure_future(world.service.arm(grant))
                await world.until(lambda: world.fence.raised)
                await asyncio.wait([arming])
                if how == "unused":
                    assert world.fence.raised, "while the motors run"
                    await world.service.disarm(grant)
                else:
                    assert "command COMPONENT_ARM_DISARM" in str(arming.exception())
            else:
                stream = await world.up(grant)
                await end(world.service.land(grant))
                await asyncio.sleep(15)
                assert world.fence.raised, "the driver may take off again"
                if how == "returned":
                    await drivers.give_back(world.control, grant)
                elif how == "grace":
                    stream.cancel()
                else:
                    world.grants.remove(grant)
            await world.until(lambda: not world.fence.raised)
            assert not world.plane.vehicle.armed

    fly(flight)


def test_a_fence_is_not_lowered_under_who_arms(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            raising = world.fence.raise_around

            async def slowly(*what: object, **how: object) -> None:
                await raising(*what, **how)  # type: ignore[arg-type]
                await asyncio.sleep(12)

            world.fence.raise_around = slowly  # type: ignore[method-assign]
            await world.service.arm(grant)
            assert world.fence.raised

    fly(flight)


def test_the_way_home_is_judged_below_the_fence_of_the_mission(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            world.plane.parameters |= {"RTL_ALT": 9000.0, "FENCE_ENABLE": 1.0, "FENCE_TYPE": 5.0, "FENCE_ALT_MAX": 65.0}
            await world.service.arm(grant)
            assert world.guard.situation().airframe.return_altitude_m == 63.0

    fly(flight)


def test_failsafes_are_set_again_when_a_message_was_lost(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            control, plane = world.control, world.plane
            grant = world.grants.put(spec())
            plane.parameters |= {"SYSID_MYGCS": 244.0}
            lost = plane.parameters.pop("FS_GCS_ENABLE")
            world.observer.found()
            await world.until(lambda: control.checked is not None)
            assert control.checked is not None
            assert "FS_GCS_ENABLE" in control.checked.problem
            plane.parameters["FS_GCS_ENABLE"] = lost
            await world.until(lambda: control.checked is not None and not control.checked.problem, 10)
            await world.drive(grant)
            await world.service.arm(grant)

    fly(flight)


def test_failsafes_are_set_again_when_setting_them_broke(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            control, plane = world.control, world.plane
            plane.parameters |= {"SYSID_MYGCS": 244.0}
            read, broken = plane.read_parameter, [KeyError("FENCE_ENABLE"), KeyError("FENCE_ENABLE")]

            async def breaking(name: str, attempts: int = 4) -> float | None:
                if broken:
                    raise broken.pop()
                return await read(name, attempts)

            plane.read_parameter = breaking  # type: ignore[method-assign]
            world.observer.found()
            await world.until(lambda: control.checked is not None and not control.checked.problem, 10)
            assert not broken

    fly(flight)


@pytest.mark.parametrize("who", ["tour", "driver"])
def test_a_fault_of_ours_ends_the_mission_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, who: str) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    async def flight() -> None:
        async with World(tmp_path) as world:
            monkeypatch.setattr("fractus_services.mobility.flight.courses.searching", broken)
            grant = world.grants.put(touring(tour=((0.0, 60.0),)) if who == "tour" else partial())
            if who == "driver":
                why = await refusal(world.drive(grant))
                assert "has a fault" in str(why)
            await world.until(world.outcome)
            assert world.outcome().startswith("failed: the mobility service has a fault")
            await world.until(lambda: not world.plane.vehicle.armed)
            assert world.plane.commands.count(MAV_CMD.COMPONENT_ARM_DISARM) == 1, "not armed again"
            await asyncio.sleep(20)
            assert world.plane.commands.count(MAV_CMD.COMPONENT_ARM_DISARM) == 1

    fly(flight)
