"""Flights that lose their driver, service, Grant or control authority."""

from __future__ import annotations

import asyncio
import math
import signal
from typing import Any

import grpc
import pytest
from fractus_core.control.state import FlightMode
from fractus_proto.v1 import mobility_pb2 as pb
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from mobility_rig import DRIVER, FRAME, NAVIGATOR_MISSION, Driver, Rig, denied, fence, flown, grant, outcomes, xy
from pymavlink.dialects.v20 import ardupilotmega as mavlink

LOST = pb.ControlEvent.STATE_LOST


async def flying(rig: Rig, *policies: dict[str, Any], speedup: float = 3.0, altitude_m: float = 6.0) -> Driver:
    rig.write_grant(grant(*policies))
    rig.start_service()
    rig.start_vehicle(speedup)
    driver = Driver(rig)
    await driver.up(altitude_m)
    return driver


def outcome(telemetry: pb.Telemetry) -> str:
    return outcomes(telemetry).get(NAVIGATOR_MISSION, "")


def speed(telemetry: pb.Telemetry) -> float:
    velocity = telemetry.velocity
    return math.hypot(velocity.north_mps, velocity.east_mps, velocity.down_mps)


# `make test` shows this with test_drone_of_lost_driver_hovers_and_returns_around_zone and test_suspended_driver_process_is_detected_as_lost.
@pytest.mark.slow
async def test_lost_driver_causes_hover_then_return(rig: Rig) -> None:
    driver = await flying(rig)
    going = driver.start_goto(0, 90)
    await rig.until(lambda t: t.velocity.north_mps > 3)
    await driver.channel.close()
    del going
    hover = await rig.until(lambda t: t.controller == "system" and t.velocity.north_mps < 0.3, 20, "hover")
    assert hover.mode == "GUIDED"
    assert xy(hover.position)[1] < 75, "the drone flew on to the target"
    home = await rig.until(outcome, 20, "return")
    assert outcome(home) == "failed: driver lost"
    assert home.mode == "GUIDED", "the autopilot, not the system, flies the drone home"
    landed = await rig.until(lambda t: not t.armed, 90, "landing")
    assert landed.mode == "LAND"
    assert math.hypot(*xy(landed.position)) < 2


# `make test` shows this with test_killed_navigator_continues_mission_and_keeps_running_after_it.
@pytest.mark.slow
async def test_driver_resumes_control_within_grace(rig: Rig) -> None:
    driver = await flying(rig)
    await driver.goto(0, 40)
    driver.drop()
    await rig.until(lambda t: t.controller == "system", 15)
    again = Driver(rig)
    event = await again.take(3)
    assert event.waypoints_reached == 1
    await again.goto(40, 40)
    await asyncio.sleep(0)
    assert (await rig.telemetry()).controller == DRIVER


async def test_killed_service_resumes_flight_after_restart(rig: Rig) -> None:
    driver = await flying(rig, speedup=1.0)  # the service restarts before the failsafe of the vehicle acts
    going = driver.start_goto(0, 90)
    await rig.until(lambda t: t.velocity.north_mps > 3)
    del going
    rig.kill("service")
    rig.start_service("--driver-grace", "15")
    hover = await rig.until(lambda t: t.armed and t.controller == "system" and t.mode == "GUIDED", 20, "takeover")
    assert hover.in_air
    again = Driver(rig)
    await again.take(5)
    await goto_once_located(again, 0, 30)
    reply = await again.stub.ReturnControl(pb.ReturnControlRequest(), timeout=5)
    assert reply.mission_complete
    assert "drone in flight, sending heartbeats" in rig.log("service"), (
        "the starting service sent no heartbeats while it imported modules"
    )
    await rig.until(lambda t: t.controller == "system" and t.velocity.north_mps < -1, 30, "return flight")


async def test_autopilot_returns_home_while_service_is_down(rig: Rig) -> None:
    await flying(rig)
    rig.kill("service")
    # The autopilot's failsafe acts after 5 s of vehicle time. The service must not give control back to the driver.
    await until_mode(rig.link, ARDUCOPTER.return_retracing)
    rig.start_service()
    late = Driver(rig)
    code, why = await denied(first(late))
    assert code == grpc.StatusCode.FAILED_PRECONDITION
    assert why.code == "MissionEnded"
    state = await rig.telemetry()
    assert state.mode == "SMART_RTL" or not state.armed
    assert outcome(state).startswith("failed:")
    await rig.until(lambda t: not t.armed, 90, "landing")


async def goto_once_located(driver: Driver, x: float, y: float) -> None:
    """Retry Goto until the restarted service has measured the delay of its link. Until then it refuses the call."""
    async with asyncio.timeout(60):
        while True:
            try:
                await driver.goto(x, y)
            except grpc.aio.AioRpcError as error:
                if error.code() is not grpc.StatusCode.UNAVAILABLE:
                    raise
                await asyncio.sleep(0.2)
            else:
                return


async def until_mode(link: str, mode: FlightMode) -> None:
    """Wait for a flight mode. Use system id 255, because the heartbeats must not look like those of the service."""
    watcher = MavlinkAutopilot(link, ARDUCOPTER, sysid=255)
    task = asyncio.create_task(watcher.run())
    try:
        async with asyncio.timeout(20):
            while watcher.vehicle.mode != mode:
                await watcher.update(1.0)
    finally:
        task.cancel()


async def first(driver: Driver) -> None:
    async for event in driver.stub.GetControl(pb.GetControlRequest(), wait_for_ready=True, timeout=20):
        if event.state == pb.ControlEvent.STATE_GRANTED:
            return


# `make test` shows this with test_accelerating_drone_brakes_before_new_zone_without_takeover.
@pytest.mark.slow
async def test_zone_added_in_flight_stops_drone(rig: Rig) -> None:
    driver = await flying(rig, speedup=2.0)
    going = driver.start_goto(0, 90)
    await rig.until(lambda t: xy(t.position)[1] > 5)
    rig.write_grant(grant(fence("new", "exclusion", "ignore", -30, 50, 30, 70)))
    code, why = await denied(flown(going))
    assert code == grpc.StatusCode.ABORTED
    assert why.code == "ExclusionZoneAhead"
    assert list(why.policies) == ["new"]
    hover = await rig.until(lambda t: speed(t) < 0.2, 20, "standstill")
    assert hover.controller == DRIVER, "a policy with action ignore took control from the driver"
    assert xy(hover.position)[1] < 50
    await driver.goto(0, 20)


# `make test` shows this with test_goto_into_zone_with_takeover_action_ends_mission and test_monitor_aborts_flight_into_zone_that_appears.
@pytest.mark.slow
async def test_zone_added_around_drone_revokes_control_and_lands(rig: Rig) -> None:
    driver = await flying(rig)
    rig.write_grant(grant(fence("new", "exclusion", "revoke", -30, -30, 30, 30)))
    event = await driver.next(LOST, 10)
    assert "new" in event.reason
    state = await rig.until(lambda t: t.mode == "LAND", 15, "landing, because the drone is at home")
    assert outcome(state).startswith("revoked:")
    _, why = await denied(driver.stub.Hover(pb.HoverRequest(), timeout=5))
    assert why.code == "NotInControl"
    await rig.until(lambda t: not t.armed, 90, "landing")


@pytest.mark.parametrize(
    "action",
    # The component tests fly all actions in virtual time (control_scripts.py).
    ["revoke", *(pytest.param(action, marks=pytest.mark.slow) for action in ("land", "returnToLaunch"))],
)
async def test_goto_into_zone_with_takeover_action_ends_mission(rig: Rig, action: str) -> None:
    driver = await flying(rig, fence("no-fly", "exclusion", action, -60, -10, -40, 10))
    code, why = await denied(flown(driver.start_goto(-50, 0)))
    assert code == grpc.StatusCode.PERMISSION_DENIED
    assert why.action == why.ACTION_TAKEOVER
    await driver.next(LOST, 15)
    state = await rig.until(lambda t: t.mode == "LAND", 10, "landing, because the drone is at home")
    assert outcome(state).startswith("revoked:" if action == "revoke" else "failed:")
    await rig.until(lambda t: not t.armed, 90, "landing")
    assert rig.entries("takeover")[0]["policies"] == ["no-fly"]


# `make test` shows this with test_return_respects_zones_of_removed_grant and test_corrupt_grant_file_revokes_control.
@pytest.mark.slow
async def test_grant_removed_in_flight_returns_drone_home(rig: Rig) -> None:
    driver = await flying(rig)
    going = driver.start_goto(0, 90)
    await rig.until(lambda t: t.velocity.north_mps > 3)
    (rig.grants / "app-navigator.json").unlink()
    code, why = await denied(flown(going))
    assert (code, why.code) == (grpc.StatusCode.FAILED_PRECONDITION, "ControlLost")
    await driver.next(LOST, 15)
    state = await rig.until(lambda t: t.controller == "system" and outcome(t), 15)
    assert outcome(state) == "revoked: the grant was removed"
    await rig.until(lambda t: not t.armed, 90, "landing")


async def test_corrupt_grant_file_revokes_control(rig: Rig) -> None:
    driver = await flying(rig)
    path = rig.grants / "app-navigator.json"
    fresh = path.with_suffix(".new")
    fresh.write_text('{"kind": "Grant", "spec"')
    fresh.replace(path)
    await driver.next(LOST, 15)
    await rig.until(lambda t: t.mode == "LAND", 30)


async def test_pilot_mode_change_ends_control_of_driver(rig: Rig) -> None:
    driver = await flying(rig)
    going = driver.start_goto(0, 90)
    await rig.until(lambda t: t.velocity.north_mps > 3)
    pilot = MavlinkAutopilot(rig.link, ARDUCOPTER)
    task = asyncio.create_task(pilot.run())
    async with asyncio.timeout(5):
        while not pilot.connected:
            await pilot.update(0.5)
    await pilot.set_mode(ARDUCOPTER.mode(mavlink.COPTER_MODE_LOITER))
    event = await driver.next(LOST, 15)
    assert event.reason == "a human pilot changed the mode to LOITER"
    code, why = await denied(flown(going))
    assert (code, why.code) == (grpc.StatusCode.FAILED_PRECONDITION, "ControlLost")
    state = await rig.telemetry()
    assert (state.controller, state.mode) == ("pilot", "LOITER")
    code, why = await denied(driver.goto(0, 10))
    assert why.code == "NotInControl"
    await pilot.set_mode(ARDUCOPTER.land)
    await rig.until(lambda t: not t.armed, 90, "landing")
    assert outcome(await rig.telemetry()).startswith("failed: a human pilot")
    task.cancel()


async def test_suspended_driver_process_is_detected_as_lost(rig: Rig) -> None:
    """SIGSTOP leaves the connection open, so only unanswered pings reveal the loss."""
    await asyncio.sleep(0)
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle()
    await rig.until(lambda t: t.ready and t.HasField("position"), 20)
    rig.start_driver()
    await rig.until(lambda t: t.controller == DRIVER and t.position.altitude_m > 2, 30, "flight of the driver process")
    rig.send_signal("driver", signal.SIGSTOP)
    await rig.until(lambda t: t.controller == "system", 20, "loss of the driver")
    rig.send_signal("driver", signal.SIGCONT)


CONTROL_POINTS = ((15, 20), (30, 20))
"""Path of the driver with partial control, as offsets in metres (x, y)."""


def partial() -> dict[str, Any]:
    """Return a Grant with which the system flies the drone to the first control point."""
    path = [dict(zip(("lat", "lon", "alt"), (*FRAME.latlon(x, y), 8.0), strict=True)) for x, y in CONTROL_POINTS]
    points = [{"navigation": "pathBased", "path": path}]
    services = [{"service": "mobility", "methods": ["Goto", "GetPosition"]}]
    return grant(control="partial", controlPoints=points, services=services)


async def test_partial_control_begins_at_control_point_after_transit(rig: Rig) -> None:
    rig.write_grant(partial())
    rig.start_service()
    rig.start_vehicle()
    driver = Driver(rig)
    event = await driver.take(40)
    assert event.control_point == 0
    waits = [e.reason for e in driver.events if e.state == pb.ControlEvent.STATE_WAITING]
    assert "the system flies to the control point" in waits
    state = await rig.telemetry()
    assert math.dist(xy(state.position), CONTROL_POINTS[0]) < 2.0
    _, why = await denied(driver.stub.Hover(pb.HoverRequest(), timeout=5))
    assert why.code == "MethodNotGranted"
    await driver.goto(*CONTROL_POINTS[1])
    await driver.stub.ReturnControl(pb.ReturnControlRequest(), timeout=5)
    await rig.until(lambda t: not t.armed, 90, "landing")


async def until_reason(driver: Driver, reason: str) -> None:
    """Open a control stream, and wait until it reports a reason."""
    driver._stream = driver.stub.GetControl(pb.GetControlRequest(), wait_for_ready=True)
    async with asyncio.timeout(30):
        while (await driver._stream.read()).reason != reason:
            pass


async def test_driver_lost_during_transit_takeoff_ends_mission_and_lands(rig: Rig) -> None:
    rig.write_grant(partial())
    rig.start_service()
    rig.start_vehicle()
    driver = Driver(rig)
    await until_reason(driver, "the system takes off")
    await driver.channel.close()
    await rig.until(lambda t: outcome(t) == "failed: driver lost", 20, "end of the mission")
    await rig.until(lambda t: not t.armed, 90, "landing")


async def test_grant_revoked_during_arming_prevents_takeoff(rig: Rig) -> None:
    rig.write_grant(partial())
    rig.start_service()
    rig.start_vehicle(1.0)
    driver = Driver(rig)
    await until_reason(driver, "the system arms the drone")
    (rig.grants / "app-navigator.json").unlink()
    state = await rig.until(lambda t: outcome(t).startswith("revoked"), 15, "revocation")
    state = await rig.until(lambda t: not t.armed, 20, "stop of the motors")
    assert state.position.altitude_m < 5


async def test_landing_during_mission_does_not_move_home(rig: Rig) -> None:
    driver = await flying(rig)
    await driver.goto(0, 30)
    await flown(driver.stub.Land(pb.LandRequest(), timeout=60))
    await driver.arm()
    await driver.take_off(4.0)
    state = await rig.until(lambda t: t.home.latitude_deg != 0, 15)
    assert math.dist(xy(state.home), (0, 0)) < 2


async def test_service_without_journal_returns_flying_drone_home(rig: Rig) -> None:
    await flying(rig, speedup=1.0)
    rig.kill("service")
    for path in (rig.directory / "state").glob("journal*"):
        path.unlink()
    rig.start_service()
    # If the service starts too slowly, the failsafe has already started the return flight or the landing.
    state = await rig.until(lambda t: t.mode in {"RTL", "SMART_RTL"}, 60, "return")
    assert state.controller == "system"
    await rig.until(lambda t: not t.armed, 90, "landing")
