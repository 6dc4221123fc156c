"""Return flights: start from standstill, retries after refusals, limits, new zones, and cleanup after the mission."""

from __future__ import annotations

import asyncio
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from fractus_core.control.state import FlightMode
from fractus_core.policy.decision_types import GotoArgs, TakeoffArgs
from fractus_runtime.mavlink_codec import message
from mobility_world import (
    GUIDED,
    LAND,
    RTL,
    SMART_RTL,
    World,
    area,
    at,
    clearance_m,
    end,
    partial,
    refusal,
    spec,
    touring,
    zone,
)
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import fly

WALL = (-40.0, 25.0, 40.0, 40.0)
REPOSITION = 192


async def return_from_behind_wall(world: World) -> None:
    """Return control at a position from which a zone blocks the direct route home."""
    grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
    await world.up(grant)
    for x, y in ((60, 30), (60, 70), (0, 70)):
        await end(world.service.goto(grant, GotoArgs(*at(x, y), 10.0), 0))
    await world.control.return_control(grant)


def test_return_to_launch_begins_after_drone_stopped(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            flying = asyncio.ensure_future(end(world.service.goto(grant, GotoArgs(*at(0, 90), 10.0), 0)))
            await world.until(lambda: world.plane.velocity[1] > 6)
            turned: list[float] = []
            go_to = world.plane.go_to

            async def noted(*position: Any) -> None:
                turned.append(math.hypot(*world.plane.velocity))
                await go_to(*position)

            world.plane.go_to = noted  # type: ignore[method-assign]
            await end(world.service.return_to_launch(grant))
            assert turned
            assert max(turned) < 0.5
            with pytest.raises(Exception, match="replaced"):
                await flying

    fly(flight)


def test_return_to_launch_proceeds_if_gusts_prevent_standstill(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            report_state = world.plane._report_state

            def gusty() -> None:
                report_state()
                world.plane.vehicle.east_mps += 0.7

            world.plane._report_state = gusty  # type: ignore[method-assign]
            await end(world.service.return_to_launch(grant))

    fly(flight)


def test_return_avoids_zone_after_one_refused_command(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            plane = world.plane
            await return_from_behind_wall(world)
            plane.commands.clear()
            plane.refuses.add(REPOSITION)
            await world.until(lambda: REPOSITION in plane.commands)
            plane.refuses.clear()
            await world.until(lambda: not plane.vehicle.armed)
            assert clearance_m(world, *WALL) > 1.0
            assert "NoLegalWay" not in {e["code"] for e in world.kinds("control")}

    fly(flight)


def test_return_avoids_zone_that_appeared_while_position_was_not_trusted(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, GotoArgs(*at(0, 70), 10.0), 0))
            world.plane.vehicle.position_problem = "GPS glitch"
            world.plane.vehicle.position_problem_at = world.plane.now
            await world.control.return_control(grant)
            await asyncio.sleep(5.0)
            world.grants.put(spec(zone("wall", "ignore", *WALL)))
            await asyncio.sleep(5.0)
            assert world.plane.xy[1] > 60.0, "the drone waits"
            world.plane.trace.clear()
            world.plane.vehicle.position_problem = ""
            await world.until(lambda: not world.plane.vehicle.armed)
            assert clearance_m(world, *WALL) > 1.0

    fly(flight)


@pytest.mark.parametrize(("remembers", "mode"), [(True, SMART_RTL), (False, RTL)])
def test_return_is_left_to_autopilot_after_three_refused_commands(
    tmp_path: Path, remembers: bool, mode: FlightMode
) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            plane = world.plane
            plane.vehicle.path_lost = not remembers
            if remembers:
                await return_from_behind_wall(world)
            else:
                grant = world.grants.put(spec())
                await world.up(grant)
                await end(world.service.goto(grant, GotoArgs(*at(0, 70), 10.0), 0))
                world.grants.put(spec(zone("wall", "ignore", *WALL)))
                await world.control.return_control(grant)
            plane.commands.clear()
            plane.refuses.add(REPOSITION)
            await world.until(lambda: plane.vehicle.mode in {RTL, SMART_RTL, LAND})
            assert plane.vehicle.mode == mode
            assert plane.commands.count(REPOSITION) == 3
            notes = [e["reason"] for e in world.kinds("control") if e["code"] == "NoLegalWay"]
            assert "the autopilot refused 3 times" in notes[-1]

    fly(flight)


@pytest.mark.parametrize("how", ["returned", "grace", "removed", "refused", "unused"])
def test_fence_is_lowered_after_mission_ends(tmp_path: Path, how: str) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            if how in {"refused", "unused"}:
                await world.drive(grant)
                world.plane.refuses |= {mavlink.MAV_CMD_COMPONENT_ARM_DISARM} if how == "refused" else set()
                arming = asyncio.ensure_future(world.service.arm(grant))
                await world.until(lambda: world.fence.raised)
                await asyncio.wait([arming])
                if how == "unused":
                    assert world.fence.raised, "the fence stays loaded while the motors run"
                    await world.service.disarm(grant)
                else:
                    assert "command COMPONENT_ARM_DISARM" in str(arming.exception())
            else:
                stream = await world.up(grant)
                await end(world.service.land(grant))
                await asyncio.sleep(15)
                assert world.fence.raised, "the fence stays loaded, because the driver may take off again"
                if how == "returned":
                    await world.control.return_control(grant)
                elif how == "grace":
                    stream.cancel()
                else:
                    world.grants.remove(grant)
            await world.until(lambda: not world.fence.raised)
            assert not world.plane.vehicle.armed

    fly(flight)


def test_fence_is_not_lowered_during_arming(tmp_path: Path) -> None:
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


def test_return_altitude_is_capped_below_fence(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            world.plane.parameters |= {"RTL_ALT": 9000.0, "FENCE_ENABLE": 1.0, "FENCE_TYPE": 5.0, "FENCE_ALT_MAX": 55.0}
            await world.service.arm(grant)
            assert world.gate.situation().airframe.return_altitude_m == 53.0

    fly(flight)


def test_failsafe_setup_is_retried_after_missing_parameter(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            control = world.control
            plane = world.plane
            grant = world.grants.put(spec())
            plane.parameters |= {"SYSID_MYGCS": 244.0}
            removed_value = plane.parameters.pop("FS_GCS_ENABLE")
            world.observer.found()
            await world.until(lambda: control.failsafe_status is not None)
            assert control.failsafe_status is not None
            assert "FS_GCS_ENABLE" in control.failsafe_status.problem
            plane.parameters["FS_GCS_ENABLE"] = removed_value
            await world.until(lambda: control.failsafe_status is not None and not control.failsafe_status.problem, 10)
            await world.drive(grant)
            await world.service.arm(grant)

    fly(flight)


def test_failsafe_setup_is_retried_after_exception(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            control = world.control
            plane = world.plane
            plane.parameters |= {"SYSID_MYGCS": 244.0}
            read = plane.vehicle_parameters.read
            broken = [KeyError("FENCE_ENABLE"), KeyError("FENCE_ENABLE")]

            async def breaking(requested: Any) -> dict[str, float]:
                if broken:
                    raise broken.pop()
                return await read(requested)

            plane.vehicle_parameters.read = breaking  # type: ignore[method-assign]
            world.observer.found()
            await world.until(lambda: control.failsafe_status is not None and not control.failsafe_status.problem, 10)
            assert not broken

    fly(flight)


@pytest.mark.parametrize("pilot_kind", ["tour", "driver"])
def test_internal_error_ends_mission_without_arming_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pilot_kind: str
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    async def flight() -> None:
        async with World(tmp_path) as world:
            monkeypatch.setattr("fractus_services.mobility.flight.route_following.route_steps", broken)
            grant = world.grants.put(touring(tour=((0.0, 60.0),)) if pilot_kind == "tour" else partial())
            if pilot_kind == "driver":
                reason = await refusal(world.drive(grant))
                assert "has an internal error" in str(reason)
            await world.until(world.outcome)
            assert world.outcome().startswith("failed: the mobility service has an internal error")
            await world.until(lambda: not world.plane.vehicle.armed)
            assert world.plane.commands.count(mavlink.MAV_CMD_COMPONENT_ARM_DISARM) == 1, "the drone is not armed again"
            await asyncio.sleep(20)
            assert world.plane.commands.count(mavlink.MAV_CMD_COMPONENT_ARM_DISARM) == 1

    fly(flight)


SLOW = {"maxAltitude": 60, "maxSpeed": 4}


@pytest.mark.parametrize("controller", ["driver", "failsafe", "system"])
def test_return_avoids_new_zone_within_speed_limit(tmp_path: Path, controller: str) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, GotoArgs(*at(0, 120), 10.0), 0))
            homeward = None
            if controller == "system":
                await world.control.return_control(grant)
            elif controller == "driver":
                homeward = asyncio.ensure_future(end(world.service.return_to_launch(grant)))
            else:
                plane.vehicle.failsafe = True
                plane.set_to(RTL)
                world.observer.heartbeat()
            await world.until(lambda: plane.xy[1] < 90)
            world.grants.put(spec(zone("wall", "ignore", *WALL), limits=SLOW))
            plane.trace.clear()
            await asyncio.sleep(6)
            fastest = 0.0
            while plane.vehicle.armed:
                await plane.update(0.1)
                fastest = max(fastest, math.hypot(*plane.velocity))
            assert fastest <= 4.0 + 1e-6
            assert clearance_m(world, *WALL) > 1.0
            assert math.hypot(*plane.xy) < 1.0
            alarms = [entry["action"] for entry in world.kinds("monitor")]
            assert ("takeBack" in alarms) == (controller == "failsafe")
            if homeward is not None:
                await homeward

    fly(flight)


def test_pilot_rtl_toward_new_zone_is_reported_without_takeover(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, GotoArgs(*at(0, 120), 10.0), 0))
            plane.set_to(RTL)
            world.observer.heartbeat()
            await world.until(lambda: plane.xy[1] < 90)
            world.grants.put(spec(zone("wall", "revoke", *WALL), limits=SLOW))
            commands = len(plane.commands)
            await world.until(lambda: not plane.vehicle.armed)
            alarms = [(entry["action"], entry["code"]) for entry in world.kinds("monitor")]
            assert {("alarm", "ExclusionZoneAhead"), ("alarm", "SpeedAboveLimit")} <= set(alarms)
            assert len(alarms) < 10, "each violation is reported once"
            assert "zone wall-zone" in caplog.text
            assert mavlink.MAV_CMD_DO_SET_MODE not in plane.commands[commands:]

    fly(flight)


@pytest.mark.parametrize("failsafe", [False, True])
def test_restarted_service_takes_over_only_failsafe_return(tmp_path: Path, failsafe: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, GotoArgs(*at(0, 120), 10.0), 0))
            plane.vehicle.failsafe = failsafe
            plane.set_to(RTL)
            world.observer.heartbeat()
            await world.until(lambda: plane.xy[1] < 90)
        async with World(tmp_path, after=world, initialised=False) as restarted:
            restarted.grants.put(spec(zone("wall", "revoke", *WALL)))
            restarted.observer.found()
            restarted.plane.trace.clear()
            commands = len(restarted.plane.commands)
            await restarted.until(lambda: not restarted.plane.vehicle.armed)
            expected_action = "takeBack" if failsafe else "alarm"
            assert (expected_action, "ExclusionZoneAhead") in [
                (e["action"], e["code"]) for e in restarted.kinds("monitor")
            ]
            assert (mavlink.MAV_CMD_DO_SET_MODE in restarted.plane.commands[commands:]) is failsafe
            assert (clearance_m(restarted, *WALL) > 1.0) is failsafe

    fly(flight)


@pytest.mark.parametrize("controller", ["driver", "system"])
@pytest.mark.parametrize("low", [12.0, 5.0])
def test_return_keeps_altitude_and_speed_limits(tmp_path: Path, controller: str, low: float) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            limit = {
                "type": "LimitControl",
                "kind": "altitude",
                "upperLimit": low,
                "selector": {"zones": ["near-zone"]},
            }
            near = {"name": "near", "spec": limit, "zones": [{"name": "near-zone", "area": area(-60, -30, 60, 50)}]}
            limits = {"maxAltitude": 12, "maxSpeed": 3}
            grant = world.grants.put(spec(near, limits=limits))
            plane.vehicle.mode = GUIDED
            await world.up(grant, min(low, 10.0))
            await end(world.service.goto(grant, GotoArgs(*at(0, 49), min(low, 10.0)), 0))
            await end(world.service.goto(grant, GotoArgs(*at(0, 90), 10.0), 0))
            plane.trace.clear()
            fastest = 0.0
            if controller == "system":
                await world.control.return_control(grant)
            else:
                homeward = asyncio.ensure_future(end(world.service.return_to_launch(grant)))
            while plane.vehicle.armed:
                await plane.update(0.1)
                fastest = max(fastest, math.hypot(*plane.velocity))
            assert fastest <= 3.0 + 1e-6
            assert max(z for *_, z in plane.trace) <= 12.2
            assert max(z for _, y, z in plane.trace if y < 50) <= low + 0.3
            assert math.hypot(*plane.xy) < 1.0
            if controller == "driver":
                await homeward

    fly(flight)


@pytest.mark.parametrize("code", ["AltitudeAboveLimit", "SpeedAboveLimit"])
def test_failsafe_return_above_limit_is_replaced_by_landing(tmp_path: Path, code: str) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            limits = {"maxAltitude": 12, "maxSpeed": 12} if code == "AltitudeAboveLimit" else SLOW
            grant = world.grants.put(spec(limits=limits))
            await world.up(grant)
            await end(world.service.goto(grant, GotoArgs(*at(0, 120), 10.0, speed_mps=4.0), 0))
            plane.vehicle.failsafe = True
            plane.speed_mps = 8.0
            plane.set_to(RTL)
            world.observer.heartbeat()
            await world.until(lambda: not plane.vehicle.armed)
            assert [entry["code"] for entry in world.kinds("monitor")] == [code]
            assert plane.vehicle.mode == LAND
            assert max(z for *_, z in plane.trace) < limits["maxAltitude"] + 2.5

    fly(flight)


@pytest.mark.parametrize("upper", [10.0, 40.0])
def test_takeover_with_land_action_returns_home_if_zone_is_below(tmp_path: Path, upper: float) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant, 20.0)
            await end(world.service.goto(grant, GotoArgs(*at(0, 60), 20.0), 0))
            below = zone("below", "land", -20, 45, 20, 80)
            below["zones"][0]["altitude"] = {"lower": -5.0, "upper": upper, "reference": "home"}
            grant = world.grants.put(spec(below))
            if upper < 20.0:
                await refusal_of(world, GotoArgs(*at(0, 55), 5.0))
            await world.until(lambda: not world.plane.vehicle.armed)
            assert (math.hypot(*world.plane.xy) < 2.0) is (upper < 20.0), "a drone inside the zone lands at once"
            assert world.outcome().startswith("failed:")

    fly(flight)


async def refusal_of(world: World, leg: GotoArgs) -> None:
    (grant,) = world.grants.active.values()
    with pytest.raises(Exception, match="lands it"):
        await end(world.service.goto(grant, leg, 0))


def test_rtl_without_legal_route_is_not_interrupted_by_monitor(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.goto(grant, GotoArgs(*at(0, 120), 10.0), 0))
            world.grants.put(spec(zone("all-around", "ignore", -20, -20, 20, 20)))
            await world.control.return_control(grant)
            await world.until(lambda: not plane.vehicle.armed)
            assert plane.vehicle.mode == RTL
            alarms = [(entry["action"], entry["code"]) for entry in world.kinds("monitor")]
            assert alarms == [("alarm", "ExclusionZoneAhead"), ("alarm", "InsideExclusionZone")]

    fly(flight)


def test_monitor_stops_failsafe_return_into_zone_after_earlier_return_was_given_up(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            plane = world.plane
            grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
            await world.up(grant)
            for x, y in ((60, 30), (60, 70), (0, 70)):
                await end(world.service.goto(grant, GotoArgs(*at(x, y), 10.0), 0))
            world.monitor._return_flight.given_up = grant  # state after a return flight that a driver interrupted
            await asyncio.sleep(2)
            plane.vehicle.failsafe = True
            plane.set_to(RTL)
            world.observer.heartbeat()
            await world.until(lambda: not plane.vehicle.armed)
            assert "takeBack" in [entry["action"] for entry in world.kinds("monitor")]
            assert clearance_m(world, *WALL) > 0

    fly(flight)


def test_failsafe_landing_into_zone_is_not_redirected(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            below = zone("below", "ignore", -20, 45, 20, 80)
            below["zones"][0]["altitude"] = {"lower": -5.0, "upper": 10.0, "reference": "home"}
            grant = world.grants.put(spec(below))
            await world.up(grant, 20.0)
            await end(world.service.goto(grant, GotoArgs(*at(0, 60), 20.0), 0))
            plane.vehicle.failsafe = True  # a critical battery
            plane.set_to(LAND)
            world.observer.heartbeat()
            await world.until(lambda: not plane.vehicle.armed)
            assert math.hypot(*plane.xy) > 50.0
            assert plane.vehicle.mode == LAND

    fly(flight)


def test_landing_does_not_violate_minimum_altitude(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            low = {"type": "LimitControl", "kind": "altitude", "lowerLimit": 5.0}
            grant = world.grants.put(spec({"name": "low", "spec": low, "zones": []}))
            await world.up(grant)
            await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert not world.kinds("monitor")

    fly(flight)


def change_parameter(world: World, name: str, value: float, *, announced: bool = True) -> None:
    """Change a parameter as another station does. If `announced`, the vehicle broadcasts PARAM_VALUE."""
    plane = world.plane
    plane.parameters[name] = value
    if announced:
        plane.take(message("PARAM_VALUE", param_id=name.encode(), param_value=value, param_count=1, param_index=65535))


@pytest.mark.parametrize("announced", [True, False])
def test_failsafe_parameter_changed_in_flight_is_restored(tmp_path: Path, announced: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            grant = world.grants.put(spec())
            await world.until(lambda: world.control.failsafe_status is not None, 10)
            await world.up(grant)
            change_parameter(world, "FS_GCS_ENABLE", 0.0, announced=announced)
            await world.until(lambda: world.plane.parameters["FS_GCS_ENABLE"] == 1.0, 1 if announced else 12)
            await world.until(lambda: any("FS_GCS_ENABLE was 0 and is 1" in str(e) for _, e in world.entries), 2)
            assert world.control.lease is not None, "the driver keeps control"

    fly(flight)


def test_changed_acceleration_parameter_is_applied_in_flight(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            grant = world.grants.put(spec())
            await world.until(lambda: world.control.failsafe_status is not None, 10)
            await world.up(grant)
            assert world.gate.situation().airframe.accel_mps2 == 2.5
            change_parameter(world, "WPNAV_ACCEL", 100.0)
            assert world.gate.situation().airframe.accel_mps2 == 1.0
            change_parameter(world, "WPNAV_ACCEL", 50.0, announced=False)
            await world.until(lambda: world.gate.situation().airframe.accel_mps2 == 0.5, 12)
            await world.until(lambda: any("flight parameters changed" in str(e) for _, e in world.entries), 2)

    fly(flight)


def test_mission_ends_if_failsafe_parameter_cannot_be_restored(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            grant = world.grants.put(spec())
            await world.until(lambda: world.control.failsafe_status is not None, 10)
            await world.up(grant)
            world.plane.fixed = ("FS_GCS_ENABLE",)
            change_parameter(world, "FS_GCS_ENABLE", 0.0)
            await world.until(world.outcome, 10)
            assert "FS_GCS_ENABLE is 0 and cannot be set to 1" in world.outcome()
            await world.until(lambda: not world.plane.vehicle.armed, 120)

    fly(flight)


def test_parameter_changed_on_ground_is_verified_before_arming(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            grant = world.grants.put(spec())
            await world.until(lambda: world.control.failsafe_status is not None, 10)
            await world.drive(grant)
            change_parameter(world, "WPNAV_ACCEL", 100.0)
            reason = await refusal(world.service.arm(grant))
            assert reason.verdict.code == "FailsafesNotVerified"
            await world.until(
                lambda: world.control.failsafe_status is not None and not world.control.failsafe_status.problem, 5
            )
            await world.service.arm(grant)
            assert world.gate.situation().airframe.accel_mps2 == 1.0

    fly(flight)


def test_takeoff_stops_below_zone_added_above(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            await world.service.arm(grant)
            climbing = asyncio.ensure_future(refusal(world.service.take_off(grant, TakeoffArgs(30.0))))
            await world.until(lambda: world.plane.height > 6)
            above = zone("above", "ignore", -60.0, -60.0, 60.0, 60.0)
            above["zones"][0]["altitude"] = {"lower": 15.0, "reference": "home"}
            world.grants.put(spec(above))
            assert (await climbing).verdict.policies == ("above",)
            await asyncio.sleep(5.0)
            assert 6 < max(height for _, _, height in world.plane.trace) < 15

    fly(flight)


def test_return_stays_below_zone_added_close_overhead(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant, 20.0)
            await end(world.service.goto(grant, GotoArgs(*at(0, 60), 20.0), 0))
            overhead = zone("overhead", "ignore", -60.0, -60.0, 60.0, 100.0)
            overhead["zones"][0]["altitude"] = {"lower": 21.5, "reference": "home"}
            beside = zone("beside", "ignore", -30.0, 61.5, 30.0, 80.0)
            grant = world.grants.put(spec(overhead, beside))
            await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert math.hypot(*world.plane.xy) < 2.0
            assert "NoLegalWay" not in {entry["code"] for entry in world.kinds("control") if "code" in entry}
            assert max(height for _, _, height in world.plane.trace) < 21.0
            assert max(y for _, y, _ in world.plane.trace) < 61.5

    fly(flight)


@pytest.mark.parametrize("how", ["schedule", "validity"])
def test_goto_stops_when_scheduled_zone_becomes_active_on_leg(tmp_path: Path, how: str) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            began = datetime.fromtimestamp(world.gate.situation().time_s + 25.0, UTC)
            later = zone("later", "ignore", -30.0, 150.0, 30.0, 170.0)
            if how == "validity":
                later["spec"]["validFrom"] = began.isoformat()
            else:
                later["zones"][0]["schedule"] = [{"validFrom": began.isoformat()}]
            grant = world.grants.put(spec(later))
            await world.up(grant)
            await world.until(lambda: world.gate.situation().time_s > began.timestamp() - 5.0, 30)
            stopped = await refusal(end(world.service.goto(grant, GotoArgs(*at(0, 190), 10.0), 0)))
            assert stopped.verdict.policies == ("later",)
            assert 10.0 < world.plane.xy[1] < 80.0, "the drone stops long before the zone"

    fly(flight)
