"""Motions: speeds, overlapping motions, lost commands, system flights, changed grants and link outages."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest
from fractus_core.api.geometry import Position
from fractus_core.control import Authority
from fractus_core.policy.decision_types import Call, SetSpeedArgs, TakeoffArgs, VelocityArgs
from fractus_core.policy.engine import judge
from fractus_core.policy.monitoring import monitor
from fractus_services.errors import AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.mobility.authority.effects import FlightConstraints
from fractus_services.mobility.flight import monitor as monitoring
from fractus_services.mobility.flight.route_following import RouteFollower, SystemFlight
from mobility_world import GUIDED, LOITER, World, area, clearance_m, end, goto, partial, refusal, spec, zone
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import fly

WALL = (-40.0, 25.0, 40.0, 40.0)


def limit(which: str, upper: float) -> dict[str, Any]:
    """Return a speed or altitude limit with the action `enforce`."""
    return {
        "name": "limited",
        "spec": {"type": "LimitControl", "kind": which, "upperLimit": upper, "action": "enforce"},
        "zones": [],
    }


async def fastest(world: World, motion: Any) -> float:
    """Complete a motion and return the highest ground speed in m/s."""
    top = 0.0
    async for _ in motion:
        top = max(top, math.hypot(*world.plane.velocity))
    return top


# Speeds


def test_goto_uses_its_own_speed_regardless_of_previous_motion(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            go = world.service.goto
            assert await fastest(world, go(grant, goto(0, 40, speed_mps=3.0), 0)) == pytest.approx(3.0, abs=0.2)
            assert await fastest(world, go(grant, goto(0, -30), 0)) == pytest.approx(8.0, abs=0.5)
            await world.service.set_speed(grant, SetSpeedArgs(4.0))
            await world.service.set_velocity(grant, VelocityArgs(2.0, 0.0, hold_s=0.5))
            assert await fastest(world, go(grant, goto(0, 40), 0)) == pytest.approx(4.0, abs=0.2)
            assert await fastest(world, go(grant, goto(0, 0, speed_mps=6.0), 0)) == pytest.approx(6.0, abs=0.2)
            assert await fastest(world, go(grant, goto(0, 40), 0)) == pytest.approx(4.0, abs=0.2)

    fly(flight)


def test_transit_keeps_speed_limit(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(partial(limit("speed", 3.0)))
            bringing = asyncio.ensure_future(world.drive(grant))
            top = 0.0
            while not bringing.done():
                await world.plane.update(0.1)
                top = max(top, math.hypot(*world.plane.velocity))
            assert math.dist(world.plane.xy, (0, 70)) < 1.5
            assert top == pytest.approx(2.55, abs=0.05)

    fly(flight)


def test_corrected_speed_holds_when_leg_is_resent(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 150), 0)))
            await world.until(lambda: world.plane.velocity[1] > 6)
            world.grants.put(spec(limit("speed", 3.0)))
            await world.until(lambda: world.plane.speed_mps == pytest.approx(2.55))
            world.plane.goal = (world.plane.xy[0], world.plane.xy[1])  # the vehicle loses its target
            world.plane.positions = False
            stayed = world.plane.xy[1] + 10
            await world.until(lambda: world.plane.xy[1] > stayed)
            assert world.plane.velocity[1] == pytest.approx(2.55, abs=0.05)
            await flying
            grant = world.grants.put(spec())
            assert await fastest(world, world.service.goto(grant, goto(0, 90), 0)) > 6, "no limit applies"

    fly(flight)


SLOW_FROM = 60.0
"""Southern edge of the zone with a speed limit, in metres north of home."""


def slow_zone() -> dict[str, Any]:
    slow = limit("speed", 3.0)
    slow["spec"]["selector"] = {"zones": ["slow-zone"]}
    return slow | {"zones": [{"name": "slow-zone", "area": area(-50, SLOW_FROM, 50, 180)}]}


@pytest.mark.parametrize("requested_mps", [None, 3.0])
def test_set_speed_is_limited_by_current_leg(tmp_path: Path, requested_mps: float | None) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(slow_zone()))
            await world.up(grant)
            flying = asyncio.ensure_future(
                fastest(world, world.service.goto(grant, goto(0, 90, speed_mps=requested_mps), 0))
            )
            await world.until(lambda: world.plane.velocity[1] > 2.2)
            verdict, speed = await world.service.set_speed(grant, SetSpeedArgs(1.0))
            assert (verdict.action, speed, world.plane.speed_mps) == ("allow", 1.0, 1.0)
            verdict, speed = await world.service.set_speed(grant, SetSpeedArgs(12.0))
            assert (verdict.action, verdict.code, verdict.policies) == ("correct", "SpeedAboveLimit", ("limited",))
            assert verdict.args == SetSpeedArgs(speed)
            assert speed == world.plane.speed_mps == pytest.approx(2.55)
            assert await flying == pytest.approx(2.55, abs=0.05)
            assert await fastest(world, world.service.goto(grant, goto(0, 65), 0)) == pytest.approx(2.55, abs=0.05)
            await end(world.service.goto(grant, goto(0, 0), 0))
            assert await fastest(world, world.service.goto(grant, goto(0, -120), 0)) > 10, "no limit applies"

    fly(flight)


def test_set_speed_accelerates_current_leg_if_legal(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(slow_zone()))
            await world.up(grant)
            flying = asyncio.ensure_future(fastest(world, world.service.goto(grant, goto(0, -120, speed_mps=3.0), 0)))
            await world.until(lambda: world.plane.velocity[1] < -2.5)
            verdict, speed = await world.service.set_speed(grant, SetSpeedArgs(10.0))
            assert (verdict.action, speed) == ("allow", 10.0)
            assert await flying == pytest.approx(10.0, abs=0.2)

    fly(flight)


def test_set_speed_keeps_current_speed_if_leg_would_be_denied(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(fastest(world, world.service.goto(grant, goto(0, 90, speed_mps=3.0), 0)))
            await world.until(lambda: world.plane.velocity[1] > 2.2)
            grant = world.grants.put(spec(zone("new", "ignore", -30, 85, 30, 100)))
            verdict, speed = await world.service.set_speed(grant, SetSpeedArgs(10.0))
            assert (verdict.action, verdict.policies, speed) == ("correct", ("new",), 3.0)
            flying.cancel()

    fly(flight)


def test_speed_setpoint_is_not_inherited_by_next_driver(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await world.service.set_speed(grant, SetSpeedArgs(2.0))
            assert world.gate.situation().speed_setpoint_mps == 2.0
            await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            grant = world.grants.put(spec(), "m2")
            await world.up(grant)
            assert await fastest(world, world.service.goto(grant, goto(0, 60), 0)) > 6

    fly(flight)


@pytest.mark.parametrize(("driven_mps", "limited"), [(0.3, False), (12.0, False), (12.0, True)])
def test_return_uses_vehicle_speed_within_limits(tmp_path: Path, driven_mps: float, limited: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            wall = zone("wall", "ignore", *WALL)
            grant = world.grants.put(spec(wall))
            await world.up(grant)
            for x, y in ((60, 30), (60, 70), (0, 70)):
                await end(world.service.goto(grant, goto(x, y), 0))
            await world.service.set_speed(grant, SetSpeedArgs(driven_mps))
            if limited:
                world.grants.put(spec(wall, limit("speed", 3.0)))
            await world.control.return_control(grant)
            await world.until(lambda: world.control.motion is not None and world.control.motion.speed_mps is not None)
            expected_mps = 3.0 if limited else 8.0
            assert world.gate.situation().speed_setpoint_mps == 8.0
            top = 0.0
            while world.plane.vehicle.mode == GUIDED:
                await world.plane.update(0.1)
                top = max(top, math.hypot(*world.plane.velocity))
            assert top == pytest.approx(expected_mps, abs=0.5)
            await world.until(lambda: not world.plane.vehicle.armed)

    fly(flight)


def test_speed_setpoint_is_restored_when_driver_reconnects(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            stream = await world.up(grant)
            await world.service.set_speed(grant, SetSpeedArgs(2.0))
            stream.cancel()
            await world.until(lambda: world.control.authority is Authority.SYSTEM, 10)
            assert world.gate.situation().speed_setpoint_mps == 8.0
            await world.drive(grant)
            assert world.gate.situation().speed_setpoint_mps == 2.0

    fly(flight)


def test_altitude_correction_uses_vehicle_speed_instead_of_driver_speed(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant, 25.0)
            await world.service.set_speed(grant, SetSpeedArgs(0.2))
            world.grants.put(spec(limit("altitude", 15.0)))
            await world.until(lambda: world.plane.speed_mps == 8.0, 5)
            assert world.control.motion is not None
            assert world.control.motion.kind == "Correction"
            assert world.gate.situation().speed_setpoint_mps == 8.0
            await world.until(lambda: world.control.motion is None, 20)
            assert world.gate.situation().speed_setpoint_mps == 0.2

    fly(flight)


def test_late_speed_correction_applies_to_next_motion(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 150), 0)))
            await world.until(lambda: world.plane.velocity[1] > 7)
            world.grants.put(spec(limit("speed", 3.0)))
            world.monitor.check()
            world.control.begin_motion("Goto").speed_mps = 8.0  # a new motion begins before the speed command is sent
            begun = world.plane.now
            await world.until(lambda: world.plane.speed_mps == pytest.approx(2.55), 5)
            assert world.plane.now - begun < 0.5
            assert (await flying).verdict.code == "Replaced"

    fly(flight)


def test_speed_correction_does_not_raise_requested_speed(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            replaced = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 150), 0)))
            await world.until(lambda: world.plane.velocity[1] > 7)
            flying = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 150, speed_mps=2.0), 0)))
            await world.until(lambda: world.plane.speed_mps == 2.0)
            world.grants.put(spec(limit("speed", 3.0)))
            await world.until(lambda: world.kinds("monitor"), 5)
            await asyncio.sleep(0.5)
            assert world.plane.speed_mps == 2.0
            assert (await replaced).verdict.code == "Replaced"
            flying.cancel()

    fly(flight)


def test_correction_is_dropped_after_pilot_takeover(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant, 25.0)
            world.grants.put(spec(limit("altitude", 15.0)))
            world.monitor.check()
            world.plane.set_to(LOITER)
            world.observer.heartbeat()
            commands = len(world.plane.commands)
            await asyncio.sleep(5)
            assert world.control.authority is Authority.PILOT
            assert mavlink.MAV_CMD_DO_REPOSITION not in world.plane.commands[commands:]
            assert world.control.motion is None

    fly(flight)


@pytest.mark.parametrize("flight_kind", ["course", "launch"])
def test_refused_system_flight_leaves_current_motion_running(tmp_path: Path, flight_kind: str) -> None:
    def forbidden(_motion: object) -> Any:
        def check() -> None:
            raise PreconditionFailed("ControlLost", "the driver is gone")

        return check

    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flown = world.control.begin_motion("Goto")
            trip = SystemFlight(FlightConstraints(grant, grant.compiled), "Transit", forbidden)
            away = goto(0, 50)
            with pytest.raises(PreconditionFailed, match="is gone"):
                async for _ in (
                    RouteFollower(world.control, world.gate).fly(trip, away)
                    if flight_kind == "course"
                    else world.poi_missions._launch(trip, Position(lat=away.lat, lon=away.lon))
                ):
                    pass
            flown.check()
            assert world.control.motion is flown

    fly(flight)


# Lost commands


def test_goto_is_judged_again_at_current_position_after_lost_command(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            grant = world.grants.put(spec(zone("no-fly", "ignore", -200, 63, 200, 100)))
            await world.up(grant)
            first = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 56), 0)))
            await world.until(lambda: plane.velocity[1] > 5 and plane.xy[1] > 22)
            send = plane.send
            lost_count = []

            def lossy(outgoing: Any) -> None:
                if outgoing.name == "COMMAND_INT" and len(lost_count) < 3:
                    lost_count.append(math.hypot(*plane.velocity))
                else:
                    send(outgoing)

            plane.send = lossy  # type: ignore[method-assign]
            begun = len(plane.commands)
            final = await end(world.service.goto(grant, goto(-60, 50), 0))
            assert final.verdict.permits
            assert min(lost_count[:2]) > 5, "the drone continued its previous leg for some time"
            assert plane.commands[begun] == 84, "the drone must stop before the turn"
            assert (await first).verdict.code == "Replaced"
            assert clearance_m(world, -200, 63, 200, 100) > 1.0

    fly(flight)


@pytest.mark.parametrize(("lost_count", "arrives"), [(3, True), (100, False)])
def test_goto_stops_and_restarts_once_after_lost_speed_command(tmp_path: Path, lost_count: int, arrives: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            grant = world.grants.put(spec(limit("speed", 2.0)))
            await world.up(grant)
            send = plane.send
            remaining = lost_count
            top = 0.0

            def lossy(outgoing: Any) -> None:
                nonlocal remaining, top
                top = max(top, math.hypot(*plane.velocity))
                if (
                    outgoing.name == "COMMAND_LONG"
                    and outgoing.integer("command") == mavlink.MAV_CMD_DO_CHANGE_SPEED
                    and remaining > 0
                ):
                    remaining -= 1
                else:
                    send(outgoing)

            plane.send = lossy  # type: ignore[method-assign]
            flying = asyncio.ensure_future(fastest(world, world.service.goto(grant, goto(0, 60), 0)))
            if arrives:
                assert await flying == pytest.approx(1.7, abs=0.06)
            else:
                with pytest.raises(AutopilotError, match="does not acknowledge the speed"):
                    await flying
                await world.until(lambda: math.hypot(*plane.velocity) < 0.2, 5)
            assert top < 4.0, "the drone must not fly at its default speed"

    fly(flight)


# Motions that begin while the drone is braking


@pytest.mark.parametrize("target", [(0.0, 20.0), (40.0, 30.0)])
def test_permitted_goto_is_flown_while_drone_brakes_before_new_zone(
    tmp_path: Path, target: tuple[float, float]
) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.measured = True
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 90), 0)))
            await world.until(lambda: world.plane.velocity[1] > 7.5 and world.plane.xy[1] > 30)
            grant = world.grants.put(spec(zone("new", "ignore", -30, 50, 30, 70)))
            assert (await flying).verdict.code == "ExclusionZoneAhead"
            toward_home = goto(*target)
            await world.until(
                lambda: judge(Call("Goto", toward_home), world.gate.situation(), grant.compiled).permits, 5
            )
            assert world.plane.velocity[1] > 5, "the drone is still moving toward the zone"
            await end(world.service.goto(grant, toward_home, 0))
            assert clearance_m(world, -30, 50, 30, 70) > 0.0
            codes = [note["code"] for note in world.kinds("control") if note["action"] == "brake"]
            assert codes == ["ExclusionZoneAhead"], "the monitor stopped only the first motion"

    fly(flight)


def test_altitude_correction_is_not_stopped_by_replaced_motion(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 60, 45.0), 0)))
            await world.until(lambda: world.plane.height > 25)
            world.grants.put(spec(limit("altitude", 15.0)))
            assert (await flying).verdict.code == "AltitudeAboveLimit"
            begun = len(world.plane.commands)
            await world.until(lambda: world.plane.height < 16.0, 8)
            assert 84 not in world.plane.commands[begun:], "no stop command interrupts the descent"
            await world.until(lambda: world.control.motion is None, 10)
            assert world.control.state.controller == grant.identity

    fly(flight)


# System flights


async def start_return(world: World) -> bool:
    """Start a return flight around a wall. Return True if the drone passes the wall on the east side."""
    grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
    await world.up(grant)
    for x, y in ((60, 30), (60, 70), (0, 70)):
        await end(world.service.goto(grant, goto(x, y), 0))
    await world.control.return_control(grant)
    await world.until(lambda: abs(world.plane.velocity[0]) > 3)
    return world.plane.velocity[0] > 0


def test_return_stays_inside_shrunk_inclusion_zone(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            side = 1 if await start_return(world) else -1
            edge = world.plane.xy[0] + side * 16.0
            west, east = (-200.0, edge) if side > 0 else (edge, 200.0)
            inclusion_zone = zone("shrunk", "revoke", west, -200.0, east, 200.0)
            inclusion_zone["spec"]["kind"] = "inclusion"
            world.grants.put(spec(zone("wall", "ignore", *WALL), inclusion_zone))
            begun = len(world.plane.trace)
            await world.until(lambda: not world.plane.vehicle.armed)
            codes = [note["code"] for note in world.kinds("control") if note["action"] == "brake"]
            assert codes[:1] == ["InclusionBorderAhead"]
            del world.plane.trace[: begun - 1]
            assert max(side * x for x, _, _ in world.plane.trace) < side * edge
            assert math.dist(world.plane.xy, (0, 0)) < 1.5

    fly(flight)


def test_return_brakes_if_position_is_lost(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            await start_return(world)
            report_state = world.plane._report_state
            begun = world.plane.now

            def blind() -> None:
                report_state()
                world.plane.vehicle.position_at = begun

            world.plane._report_state = blind  # type: ignore[method-assign]
            await world.until(lambda: world.kinds("control")[-1]["action"] != "returned", 3)
            codes = [note["code"] for note in world.kinds("control") if note["action"] == "brake"]
            assert codes == ["PositionUnknown"]
            await world.until(lambda: world.plane.vehicle.mode != GUIDED, 20)
            await world.until(lambda: not world.plane.vehicle.armed)

    fly(flight)


# Changed Grants


@pytest.fixture
def changed(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Record the `fences_changed` argument of each monitor call."""
    recorded: list[bool] = []

    def recording_monitor(*args: Any, fences_changed: bool, **more: Any) -> Any:
        recorded.append(fences_changed)
        return monitor(*args, fences_changed=fences_changed, **more)

    monkeypatch.setattr(monitoring, "monitor", recording_monitor)
    return recorded


def test_monitor_flags_fences_changed_until_drone_is_at_rest(tmp_path: Path, changed: list[bool]) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            going = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 90), 1.0)))
            await world.until(lambda: world.plane.xy[1] > 3)
            assert not any(changed[-20:]), "the fences have not changed since the leg began"
            grant = world.grants.put(spec(zone("far", "ignore", 60, 60, 90, 90)))
            await asyncio.sleep(0.2)
            assert changed[-1]
            await world.service.hover(grant)
            with pytest.raises(Refused):
                await going
            assert changed[-1], "the drone still moves, so the change of the fences still matters"
            await world.until(lambda: math.hypot(*world.plane.velocity) < 0.01)
            await asyncio.sleep(2.0)
            await end(world.service.goto(grant, goto(0, 40), 1.0))
            assert not any(changed[-20:])

    fly(flight)


def test_monitor_flags_fences_changed_after_immediately_completed_goto(tmp_path: Path, changed: list[bool]) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, goto(0, 45), 50.0))
            assert world.control.motion is None
            world.grants.put(spec(zone("far", "ignore", 60, 60, 90, 90)))
            await world.until(lambda: world.plane.xy[1] > 3)
            assert changed[-1], "the change matters, because the autopilot still flies the leg of the completed Goto"

    fly(flight)


def test_takeoff_continues_after_lost_acknowledgement(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            await world.service.arm(grant)
            plane = world.plane
            obey = world.plane._obey
            attempts = 0

            def once(outgoing: Any) -> None:
                nonlocal attempts
                if outgoing.integer("command") == mavlink.MAV_CMD_NAV_TAKEOFF:
                    attempts += 1
                    plane.refuses.add(mavlink.MAV_CMD_NAV_TAKEOFF)
                    if attempts == 1:
                        plane._reply = lambda _: None  # type: ignore[method-assign]
                        asyncio.get_running_loop().call_later(0.1, delattr, plane, "_reply")
                obey(outgoing)

            plane._obey = once  # type: ignore[method-assign]
            await end(world.service.take_off(grant, TakeoffArgs(10.0)))
            assert plane.height > 9.0
            assert plane.commands.count(mavlink.MAV_CMD_NAV_TAKEOFF) == 2

    fly(flight)


# Link outages


async def cut(world: World, seconds: float, *, frozen: bool = False) -> None:
    """Cut the link for some seconds. If `frozen` is set, the vehicle and its clock stand still during the outage."""
    plane = world.plane
    step = plane._step
    plane.disconnected = True
    if frozen:
        plane._step = lambda: None  # type: ignore[method-assign]
    await asyncio.sleep(seconds)
    plane._step = step
    plane.disconnected = False  # type: ignore[method-assign]


@pytest.mark.parametrize(("seconds", "frozen"), [(1.5, False), (3.0, False), (4.5, False), (5.0, True)])
def test_driver_keeps_control_after_short_link_outage(tmp_path: Path, seconds: float, frozen: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path, grace_s=10.0) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 150), 0)))
            await world.until(lambda: world.plane.velocity[1] > 3)
            await cut(world, seconds, frozen=frozen)
            stopped = await flying
            assert isinstance(stopped, Unavailable), "the error is Unavailable, so the SDK retries the call"
            assert world.control.authority is Authority.DRIVER
            if seconds > 1.5:
                with pytest.raises(Unavailable):
                    world.service.goto(grant, goto(0, 150), 0)
            await world.until(lambda: world.control.state.grace is None, 3)
            await world.until(lambda: math.hypot(*world.plane.velocity) < 0.5, 10)
            await end(world.service.goto(grant, goto(0, 150), 0))
            assert math.dist(world.plane.xy, (0, 150)) < 1.5
            assert [event.state.name for event in world.events] == ["GRANTED"]
            actions = [note["action"] for note in world.kinds("control") if note["code"] != ""]
            assert "brake" in actions

    fly(flight)


def test_mission_ends_if_link_outage_outlasts_grace(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, grace_s=5.0) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 150), 0)))
            await world.until(lambda: world.plane.velocity[1] > 3)
            await cut(world, 7.0)
            assert isinstance(await flying, Unavailable)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert world.outcome().startswith("failed: the drone's position is unknown")
            assert [event.state.name for event in world.events] == ["GRANTED", "LOST"]
            assert math.dist(world.plane.xy, (0, 0)) < 1.5

    fly(flight)


def test_motions_are_unavailable_while_link_is_too_slow(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, grace_s=15.0) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 190), 0)))
            await world.until(lambda: world.plane.velocity[1] > 3)
            world.plane.uplink_s = world.plane.downlink_s = 1.0
            assert isinstance(await flying, Unavailable)
            await world.until(lambda: math.hypot(*world.plane.velocity) < 0.1, 20)
            assert isinstance(await refusal(world.service.set_velocity(grant, VelocityArgs(3.0, 0.0))), Unavailable)
            world.plane.uplink_s = world.plane.downlink_s = 0.0
            await world.until(lambda: world.control.state.grace is None, 14)
            await end(world.service.goto(grant, goto(0, 190), 0))

    fly(flight)


def test_arming_is_not_ready_with_slow_link(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.uplink_s = world.plane.downlink_s = 0.7
            await asyncio.sleep(6)
            grant = world.grants.put(spec())
            assert "takes 1.4 s" in str(world.control.not_ready_reason(grant.key))

    fly(flight)
