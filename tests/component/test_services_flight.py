"""Flights by the mobility service: transits, returns and POI missions around zones, and superseded commands."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace
from pathlib import Path

import pytest
from fractus_core.control import Authority, StreamState
from fractus_core.control.state import FlightMode
from fractus_core.policy.decision_types import Call, GotoArgs, SetSpeedArgs, TakeoffArgs, Verdict
from fractus_runtime.mavlink_codec import Message, message
from fractus_services.errors import AutopilotError, Refused
from fractus_services.grant_files import ActiveGrant
from mobility_world import (
    GUIDED,
    LAND,
    RTL,
    SMART_RTL,
    World,
    clearance_m,
    end,
    goto,
    partial,
    refusal,
    spec,
    touring,
    zone,
)
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import fly

WALL = (-40.0, 25.0, 40.0, 40.0)


# Transit and return flights


def test_transit_and_return_fly_around_exclusion_zone(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            grant = world.grants.put(partial(zone("wall", "ignore", *WALL), corridor=[]))
            stream = await world.drive(grant)
            assert math.dist(world.plane.xy, (0, 70)) < 1.5
            assert [n.reason for n in world.events if n.state is StreamState.WAITING][
                -1
            ] == "the system flies to the control point"
            assert await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert math.dist(world.plane.xy, (0, 0)) < 1.5
            assert clearance_m(world, *WALL) > 1.0
            assert max(abs(x) for x, _, _ in world.plane.trace) > 41
            await stream

    fly(flight)


def test_transit_replans_around_zone_added_in_flight(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            grant = world.grants.put(partial())
            driving = asyncio.ensure_future(world.drive(grant))
            await world.until(lambda: world.plane.xy[1] > 8)
            world.grants.put(partial(zone("wall", "ignore", *WALL)))
            await driving
            assert math.dist(world.plane.xy, (0, 70)) < 1.5
            assert clearance_m(world, *WALL) > 0.5
            assert world.kinds("control")[-1]["action"] == "granted"

    fly(flight)


def test_transit_is_revoked_if_zone_with_revoke_action_appears_ahead(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(partial())
            driving = asyncio.ensure_future(world.drive(grant))
            await world.until(lambda: world.plane.xy[1] > 16)
            wall = (-40.0, 40.0, 40.0, 55.0)
            world.grants.put(partial(zone("wall", "revoke", *wall)))
            await world.until(lambda: not world.plane.vehicle.armed)
            assert world.outcome().startswith("revoked:")
            assert clearance_m(world, *wall) > 0.5
            with pytest.raises(Refused, match="about to enter zone wall-zone"):
                await driving

    fly(flight)


@pytest.mark.parametrize("measured", [True, False])
def test_accelerating_drone_brakes_before_new_zone_without_takeover(tmp_path: Path, measured: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.measured = measured
            grant = world.grants.put(spec())
            await world.up(grant)
            going = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 90), 0)))
            await world.until(lambda: world.plane.xy[1] > 8)
            assert math.hypot(*world.plane.velocity) < 7, "the drone is still accelerating"
            world.grants.put(spec(zone("wall", "revoke", *WALL)))
            why = await going
            assert (why.verdict.code, why.verdict.action) == ("ExclusionZoneAhead", "deny")
            await asyncio.sleep(20)
            assert world.control.authority is Authority.DRIVER, "a drone that can stop is not taken over"
            assert clearance_m(world, *WALL) > 5

    fly(flight)


@pytest.mark.parametrize("speed_mps", [2.0, 6.0, 11.0])
@pytest.mark.parametrize("measured", [True, False])
def test_shortened_leg_is_flown_to_its_corrected_target(tmp_path: Path, speed_mps: float, measured: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.measured = measured
            grant = world.grants.put(spec(zone("wall", "adjust", *WALL)))
            await world.up(grant)
            arrived = await end(world.service.goto(grant, goto(0, 70, speed_mps=speed_mps), 0))
            assert arrived.verdict.code == "LegShortened"
            assert "wall" in arrived.verdict.policies
            assert isinstance(arrived.verdict.args, GotoArgs)
            assert world.plane.vehicle.distance_m(arrived.verdict.args.lat, arrived.verdict.args.lon) < 1.5
            assert not world.kinds("monitor")
            assert 1.0 < clearance_m(world, *WALL) < 5.0

    fly(flight)


def test_repeated_refused_transits_do_not_extend_driver_grace(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(partial(zone("around", "ignore", -20, 50, 20, 90)))
            refused: list[float] = []
            while not world.outcome():
                why = await refusal(world.drive(grant))
                refused.append(world.plane.now)
                assert why.verdict.code in {"NoLegalWay", "ControlLost"}
                await asyncio.sleep(2)
            assert len(refused) > 1
            assert refused[-1] - refused[0] < 10, "the driver grace of 5 s has expired"
            await world.until(lambda: not world.plane.vehicle.armed)
            assert math.hypot(*world.plane.xy) < 1

    fly(flight)


def test_transit_is_refused_with_policy_name_if_control_point_is_unreachable(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(partial(zone("around", "ignore", -20, 50, 20, 90)))
            why = await refusal(world.drive(grant))
            assert why.verdict.code == "NoLegalWay"
            assert "around" in str(why)
            assert world.control.authority is Authority.SYSTEM

    fly(flight)


@pytest.mark.parametrize(("retraces", "mode"), [(True, SMART_RTL), (False, RTL)])
def test_return_uses_autopilot_mode_if_no_legal_route_exists(tmp_path: Path, retraces: bool, mode: FlightMode) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=retraces) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, goto(0, 70), 0))
            world.grants.put(spec(zone("home", "ignore", -15, -15, 15, 15)))
            why = await refusal(world.service.return_to_launch(grant)) if not retraces else None
            assert why is None or why.verdict.code == "NoLegalWay"
            await world.control.return_control(grant)
            await world.until(lambda: world.plane.vehicle.mode == mode)
            assert "NoLegalWay" in {e["code"] for e in world.kinds("control")}
            await world.until(lambda: not world.plane.vehicle.armed)

    fly(flight)


def test_smart_rtl_is_not_assumed_after_vehicle_lost_its_path(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            assert world.gate.situation().airframe.retraces
            world.plane.vehicle.path_lost = True
            assert not world.gate.situation().airframe.retraces

    fly(flight)


def test_return_respects_zones_of_removed_grant(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
            await world.up(grant)
            for x, y in ((60, 30), (60, 70), (0, 70)):
                await end(world.service.goto(grant, goto(x, y), 0))
            world.grants.remove(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert clearance_m(world, *WALL) > 1.0
            assert world.outcome() == "revoked: the grant was removed"

    fly(flight)


def test_drone_of_lost_driver_hovers_and_returns_around_zone(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
            stream = await world.up(grant)
            for x, y in ((60, 30), (60, 70)):
                await end(world.service.goto(grant, goto(x, y), 0))
            flying = asyncio.ensure_future(end(world.service.goto(grant, goto(-60, 70), 0)))
            await world.until(lambda: world.plane.xy[0] < 20)
            stream.cancel()
            await world.until(lambda: abs(world.plane.velocity[0]) < 0.2)
            assert world.plane.vehicle.mode == GUIDED
            assert world.plane.xy[0] > -30
            await world.until(lambda: not world.plane.vehicle.armed)
            assert clearance_m(world, *WALL) > 1.0
            assert math.dist(world.plane.xy, (0, 0)) < 1.5
            assert world.outcome() == "failed: driver lost"
            with pytest.raises(Exception, match="driver"):
                await flying

    fly(flight)


def test_return_replans_around_zone_added_in_flight(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
            await world.up(grant)
            for x, y in ((60, 30), (60, 70), (0, 70)):
                await end(world.service.goto(grant, goto(x, y), 0))
            await world.control.return_control(grant)
            await world.until(lambda: math.hypot(*world.plane.velocity) > 3)
            east = world.plane.velocity[0] > 0
            second = (41.0, 20.0, 90.0, 60.0) if east else (-90.0, 20.0, -41.0, 60.0)
            world.grants.put(spec(zone("wall", "ignore", *WALL), zone("second", "ignore", *second)))
            begun = len(world.plane.trace)
            await world.until(lambda: not world.plane.vehicle.armed)
            del world.plane.trace[: begun - 1]
            assert clearance_m(world, *WALL) > 0.5
            assert clearance_m(world, *second) > 0.5

    fly(flight)


# POI missions


def test_poi_mission_visits_all_points_and_returns(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True, boarding_s=30) as world:
            grant = world.grants.put(touring(zone("wall", "ignore", *WALL), tour=((0, 70), (60, 70))))
            await asyncio.sleep(5)
            assert not world.plane.vehicle.armed
            world.poi_missions.passenger_called(grant)
            await world.until(lambda: world.outcome() == "complete")
            assert world.control.state.missions["m1"].waypoints == 2
            await world.until(lambda: not world.plane.vehicle.armed)
            assert clearance_m(world, *WALL) > 1.0
            for place in ((0, 70), (60, 70)):
                assert min(math.dist(place, (x, y)) for x, y, _ in world.plane.trace) < 1.2
            assert not world.kinds("takeover")

    fly(flight)


def test_poi_mission_starts_after_boarding_time_without_passenger_call(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, boarding_s=30) as world:
            world.grants.put(touring(tour=((0, 30),)))
            begun = world.plane.now
            await world.until(lambda: world.plane.vehicle.armed)
            assert 29 < world.plane.now - begun < 33

    fly(flight)


def test_poi_mission_ends_after_pilot_takeover_and_is_not_restarted(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.grants.put(touring(tour=((0, 100),)))
            await world.until(lambda: world.plane.xy[1] > 20)
            observer = world.observer
            world.plane.set_to(LAND)
            observer.heartbeat()
            assert world.control.authority is Authority.PILOT
            await world.until(lambda: not world.plane.vehicle.armed)
            observer.heartbeat()
            assert world.control.state.touring is None
            assert world.outcome() == "failed: a human pilot took the drone and landed it"
            world.plane.vehicle.mode = GUIDED
            await asyncio.sleep(20)
            assert not world.plane.vehicle.armed

    fly(flight)


def test_poi_mission_fails_with_reason_if_point_is_unreachable(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.grants.put(touring(tour=((0, 30), (0, 500))))
            await world.until(world.outcome)
            assert world.outcome().startswith("failed: the system cannot fly to")
            await world.until(lambda: not world.plane.vehicle.armed)
            assert math.dist(world.plane.xy, (0, 0)) < 1.5

    fly(flight)


def test_poi_mission_resumes_at_next_point_after_service_restart(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.grants.put(touring(tour=((0, 40), (0, 80))))
            await world.until(lambda: world.plane.xy[1] > 50)
        flown = len(world.plane.trace)
        second = World(tmp_path, boarding_s=1000, after=world)
        second.grants.put(touring(tour=((0, 40), (0, 80))))
        async with second:
            await second.until(lambda: second.outcome() == "complete")
            assert min(y for _, y, _ in second.plane.trace[flown:]) > 45, "the first point is not visited twice"
            await second.until(lambda: not second.plane.vehicle.armed)

    fly(flight)


def test_poi_mission_waits_until_driver_returns_control(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            world.grants.put(touring(tour=((0, 30),)), "m2")
            await asyncio.sleep(10)
            assert world.control.state.controller == grant.identity
            await world.control.return_control(grant)
            await world.until(lambda: world.outcome("m2"))

    fly(flight)


# Turns, and stale or repeated commands


def test_goto_brakes_first_before_sharp_turn_near_zone(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(zone("no-fly", "ignore", -200, 63, 200, 100)))
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 56), 0)))
            await world.until(lambda: world.plane.velocity[1] > 5 and world.plane.xy[1] > 35)
            first = world.service.calls.check(Call("Goto", goto(-60, 50)), grant)
            assert first.brake_first, first
            final = await end(world.service.goto(grant, goto(-60, 50), 0))
            assert final.verdict.permits
            assert not final.verdict.brake_first
            assert (await flying).verdict.code == "Replaced"
            assert clearance_m(world, -200, 63, 200, 100) > 1.0

    fly(flight)


def test_goto_is_refused_if_drone_does_not_stop(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(zone("no-fly", "ignore", -200, 190, 200, 199)))
            await world.up(grant)
            flying = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 180), 0)))
            await world.until(lambda: world.plane.velocity[1] > 5)
            world.gate.judge = lambda *_args, **_more: replace(Verdict("allow", goto(-60, 50)), brake_first=True)  # type: ignore[method-assign]
            world.plane._command = lambda: (0.0, 1.0, 0.0)  # type: ignore[method-assign]
            why = await refusal(world.service.goto(grant, goto(-60, 50), 0))
            assert why.verdict.code == "NotStopping"
            assert world.plane.commands.count(192) == 1
            await flying

    fly(flight)


def test_verdict_on_route_contains_first_correction_and_refusal(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            pool = zone("pool", "adjust", -20, 40, 20, 60)
            grant = world.grants.put(spec(pool, zone("wall", "ignore", 50, -200, 60, 200)))
            await world.up(grant)
            inside = [Call("Goto", goto(0, 50)), Call("Goto", goto(0, 20))] * 3
            check = world.service.calls.check_route
            ((position, correction),) = await check([Call("Goto", goto(0, 20)), *inside], lambda: grant)
            assert (position, correction.action) == (1, "correct")
            changed = await check([*inside, Call("Goto", goto(100, 0)), *inside], lambda: grant)
            assert [(position, verdict.action) for position, verdict in changed] == [(0, "correct"), (6, "deny")]

    fly(flight)


@pytest.mark.parametrize("calls", [[], [Call("Goto", goto(0, 20))]])
def test_passenger_may_not_check_a_route(calls: list[Call], tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(touring(tour=((0, 20),)))
            why = await refusal(world.service.calls.check_route(calls, lambda: grant))
            assert why.verdict.code == "NotADriver"

    fly(flight)


@pytest.mark.parametrize("event", ["takeover", "returned", "revoked", "lost"])
def test_pending_command_is_dropped_after_control_is_lost(tmp_path: Path, event: str) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            stream = await world.up(grant)
            assert world.control.effects.takeover_reason == "", "there is no takeover while a driver has control"
            world.plane.disconnected = True  # the autopilot gets no command, so the service repeats its commands
            asking = asyncio.ensure_future(refusal(world.service.set_speed(grant, SetSpeedArgs(3.0))))
            await asyncio.sleep(0.3)
            if event == "takeover":
                world.control.take_over(world.service.calls.check(Call("Goto", goto(0, 5000)), grant))
            elif event == "returned":
                await world.control.return_control(grant)
            elif event == "revoked":
                world.grants.remove(grant)
            else:
                stream.cancel()
                await asyncio.sleep(0)
            world.plane.disconnected = False
            why = await asking
            assert why.verdict.code in {"NotInControl", "ControlLost"}
            assert mavlink.MAV_CMD_DO_CHANGE_SPEED not in world.plane.commands, "the command is not repeated"
            assert world.control.effects.takeover_reason, "the service reports the reason of the takeover"
            await world.until(lambda: not world.plane.vehicle.armed)
            world.control.note("landed", "the motors are stopped")
            assert not world.control.effects.takeover_reason, "the reason is cleared after the landing"

    fly(flight)


def test_resent_goto_is_judged_again(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            world.plane.disconnected = True
            asking = asyncio.ensure_future(refusal(world.service.goto(grant, goto(0, 70, speed_mps=5.0), 0)))
            await asyncio.sleep(0.3)
            world.grants.put(spec(zone("wall", "ignore", *WALL)))
            world.plane.disconnected = False
            why = await asking
            assert why.verdict.code == "LegThroughExclusionZone"
            assert 192 not in world.plane.commands

    fly(flight)


def test_repeated_takeoff_climbs_further_or_completes_without_descending(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            roof = zone("roof", "ignore", -30, -30, 30, 60)
            roof["zones"][0]["altitude"] = {"lower": 25.0, "upper": 60.0, "reference": "home"}
            grant = world.grants.put(spec(roof))
            await world.up(grant, 5.0)
            flying = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 60, 5.0), 0)))
            await world.until(lambda: world.plane.velocity[1] > 4)
            done = await end(world.service.take_off(grant, TakeoffArgs(12.0)))
            assert done.verdict.action == "allow"
            assert abs(world.plane.height - 12.0) < 1.0
            await asyncio.wait([flying])
            stood = world.plane.xy[1]
            await end(world.service.take_off(grant, TakeoffArgs(6.0)))
            assert abs(world.plane.height - 12.0) < 1.0, "a takeoff never descends"
            with pytest.raises(Refused, match="roof"):
                world.service.take_off(grant, TakeoffArgs(40.0))
            assert abs(world.plane.xy[1] - stood) < 1.0

    fly(flight)


def test_smart_rtl_is_not_used_after_arming_away_from_home(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, goto(0, 60), 0))
            await end(world.service.land(grant))
            assert world.control.retraces
            await world.service.arm(grant)
            assert not world.control.retraces
            assert world.plane.parameters["FS_GCS_ENABLE"] == 1.0

    fly(flight)


# Heading


def test_goto_with_heading_waits_for_yaw(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, goto(0, 30, yaw_deg=90.0), 0))
            assert world.plane.heading == 90.0
            world.plane.refuses.add(mavlink.MAV_CMD_CONDITION_YAW)
            with pytest.raises(AutopilotError, match="failed command CONDITION_YAW"):
                await end(world.service.goto(grant, goto(0, 40, yaw_deg=180.0), 0))

    fly(flight)


# Refusals by the autopilot


def _text(text: str) -> Message:
    return message("STATUSTEXT", severity=mavlink.MAV_SEVERITY_CRITICAL, text=text.encode())


def test_refused_leg_quotes_no_earlier_text_and_names_probable_reason(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            world.plane.take(_text("Arming motors"))
            world.plane.refuses.add(mavlink.MAV_CMD_DO_REPOSITION)
            with pytest.raises(AutopilotError) as refused:
                await end(world.service.goto(grant, goto(0, 40), 0))
            reason = "the autopilot failed command DO_REPOSITION without a reason"
            assert str(refused.value) == f"{reason}; probably the target is outside the vehicle's fence"

    fly(flight)


@pytest.mark.parametrize(
    ("text", "quoted"), [("Mode change to RTL failed: requires position", True), ("Mission: 1 Takeoff", False)]
)
def test_refused_mode_quotes_text_received_after_command(tmp_path: Path, text: str, quoted: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.take(_text("Mode change to RTL failed: requires home"))
            world.plane.refuses.add(mavlink.MAV_CMD_DO_SET_MODE)
            await asyncio.sleep(0.1)
            world.plane.downlink_s = 0.1
            asyncio.get_running_loop().call_later(0.05, world.plane.take, _text(text))
            with pytest.raises(AutopilotError) as refused:
                await world.plane.set_mode(RTL)
            assert str(refused.value) == "the autopilot failed command DO_SET_MODE" + (f": {text}" if quoted else "")

    fly(flight)


def test_goto_altitude_is_converted_from_amsl_and_refused_for_unknown_terrain(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            final = await end(world.service.goto(grant, goto(0, 30, 28.0, reference="amsl"), 0))
            assert final.verdict.args == replace(goto(0, 30, 18.0), speed_mps=final.verdict.args.speed_mps)  # type: ignore[union-attr]
            assert world.plane.height == pytest.approx(18.0, abs=0.9)
            why = await refusal(_goto(world, grant, goto(0, 40, 20.0, reference="terrain")))
            assert why.verdict.code == "TerrainUnknown"

    fly(flight)


async def _goto(world: World, grant: ActiveGrant, args: GotoArgs) -> None:
    await end(world.service.goto(grant, args, 0))


# Internal failures


def test_flight_continues_if_journal_write_fails_in_flight(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)

            def full(_data: bytes) -> None:
                raise OSError(28, "No space left on device")

            world.journal._write = full  # type: ignore[method-assign]
            await end(world.service.goto(grant, goto(0, 30), 0))
            await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)

    fly(flight)


def test_system_takes_over_armed_drone_without_authority_after_restart(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            await world.up(world.grants.put(spec()))
        async with World(tmp_path, after=world) as second:  # a restarted service finds the drone armed
            second.grants.put(spec())
            await second.until(lambda: second.kinds("takeover"))
            assert second.kinds("takeover")[0]["code"] == "NoControlAuthority"
            await second.until(lambda: not second.plane.vehicle.armed)
            assert math.dist(second.plane.xy, (0, 0)) < 1.5

    fly(flight)


def test_drone_returns_home_straight_if_planner_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(zone("far", "ignore", 150, 150, 160, 160)))
            await world.up(grant)
            await end(world.service.goto(grant, goto(0, 30), 0))
            monkeypatch.setattr("fractus_services.mobility.flight.return_to_launch.check_straight_return", broken)
            await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert math.dist(world.plane.xy, (0, 0)) < 1.5

    fly(flight)


@pytest.mark.parametrize(("idle_s", "replaced"), [(10.0, False), (31.0, True)])
def test_second_process_replaces_driver_without_liveness_requests_that_makes_no_calls(
    tmp_path: Path, idle_s: float, replaced: bool
) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            first = await world.up(grant)
            await asyncio.sleep(idle_s)
            if not replaced:
                assert (await refusal(world.drive(grant))).verdict.code == "ControlHeld"
                assert not first.done()
                return
            await world.drive(grant)
            assert first.done()
            states = [event.state.name for event in world.events]
            assert sorted(states[-2:]) == ["GRANTED", "LOST"]
            await end(world.service.goto(grant, goto(0, 20), 0))

    fly(flight)


def test_second_process_does_not_replace_driver_during_its_motion(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            first = await world.up(grant)
            leg = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 190, speed_mps=3.0), 0)))
            await asyncio.sleep(40)
            assert not leg.done()
            assert (await refusal(world.drive(grant))).verdict.code == "ControlHeld"
            assert not first.done()
            await leg

    fly(flight)
