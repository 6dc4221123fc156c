"""Transit flights, missions of passengers, velocity setpoints, dry runs, the autopilot's fence, and MAVLink links."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import grpc
import pytest
import shapely
from fractus_cluster.ports import free_port
from fractus_core.api.names import node_identity
from fractus_proto.v1 import mobility_pb2 as pb
from fractus_proto.v1 import types_pb2
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.mission_protocol import download
from mobility_rig import (
    FRAME,
    NAVIGATOR_MISSION,
    NODE,
    PASSENGER,
    VIEWER_MISSION,
    Driver,
    Rig,
    altitude_limit,
    area,
    denied,
    fence,
    grant,
    outcomes,
    passenger_grant,
    place,
    xy,
)

WALL = (-20.0, 15.0, 20.0, 25.0)
"""Zone across the straight line from home to the control point in the north, as offsets in metres (x, y)."""


class Trace:
    """Records the positions of the drone, 20 per second."""

    def __init__(self, rig: Rig) -> None:
        self.points: list[tuple[float, float]] = []
        self.attitudes = 0
        self._task = asyncio.create_task(self._follow(rig))

    async def _follow(self, rig: Rig) -> None:
        stub = rig.stub(node_identity(NODE))
        while True:
            try:
                async for t in stub.SubscribeTelemetry(
                    pb.SubscribeTelemetryRequest(interval_s=0.05), wait_for_ready=True
                ):
                    if t.in_air and t.HasField("position"):
                        self.points.append(xy(t.position))
                        self.attitudes += t.HasField("attitude")
            except grpc.aio.AioRpcError:
                await asyncio.sleep(0.1)

    def distance_m(self, *box: float) -> float:
        return float(min(shapely.box(*box).distance(shapely.Point(p)) for p in self.points))

    def stop(self) -> None:
        self._task.cancel()


def positions(*points: tuple[float, float], alt: float = 12.0) -> list[dict[str, float]]:
    return [dict(zip(("lat", "lon", "alt"), (*FRAME.latlon(x, y), alt), strict=True)) for x, y in points]


def partial(*policies: dict[str, Any], at: tuple[float, float]) -> dict[str, Any]:
    points = [{"navigation": "pathBased", "path": positions(at)}]
    services = [{"service": "mobility", "methods": ["Goto", "GetPosition"]}]
    return grant(*policies, control="partial", controlPoints=points, services=services)


# `make test` shows this with test_transit_and_return_fly_around_exclusion_zone and
# test_partial_control_begins_at_control_point_after_transit.
@pytest.mark.slow
async def test_transit_flies_around_zone_to_control_point_and_home(rig: Rig) -> None:
    rig.write_grant(partial(fence("wall", "exclusion", "ignore", *WALL), at=(0, 45)))
    rig.start_service()
    rig.start_vehicle(3.0)
    trace = Trace(rig)
    driver = Driver(rig)
    await driver.take(120)
    assert math.dist(xy((await rig.telemetry()).position), (0, 45)) < 2.0
    assert max(abs(x) for x, _ in trace.points) > 21.0, "the drone flew through the zone"
    reply = await driver.stub.ReturnControl(pb.ReturnControlRequest(), timeout=5)
    assert reply.mission_complete
    landed = await rig.until(lambda t: not t.armed, 120, "landing")
    trace.stop()
    assert math.dist(xy(landed.position), (0, 0)) < 2.0
    assert trace.distance_m(*WALL) > 1.0
    assert trace.attitudes > 0.9 * len(trace.points)
    idle = "failed: no part of the path was flown: no leg of the driver was completed"
    assert outcomes(landed) == {NAVIGATOR_MISSION: idle}
    assert not rig.log("service").count("Traceback")


# `make test` shows this with test_poi_mission_visits_all_points_and_returns and test_sdk_dry_runs_and_passenger_poi_mission.
@pytest.mark.slow
async def test_poi_mission_visits_points_of_passenger_without_driver(rig: Rig) -> None:
    tour = positions((15, 15), (-15, 15))
    everywhere = [{"service": "mobility", "methods": ["GetControl", "GetPosition"]}]
    poi = {"points": tour, "serviceAccess": "path"}
    rig.write_grant(passenger_grant(tour=tour, pointsOfInterest=poi, services=everywhere))
    rig.start_service("--driver-grace", "20")
    rig.start_vehicle(3.0)
    await rig.until(lambda t: t.ready, 30)
    await asyncio.sleep(0)
    assert not (await rig.telemetry()).armed, "the drone was armed before the passenger requested the flight"
    stub = rig.stub(PASSENGER)

    async def ride() -> list[Any]:
        return [e async for e in stub.GetControl(pb.GetControlRequest(), timeout=150)]

    riding = asyncio.create_task(ride())
    await rig.until(lambda t: math.dist(xy(t.position), (15, 15)) < 1.5, 60, "first point")
    code, why = await denied(stub.Hover(pb.HoverRequest(), timeout=5))
    assert (code, why.code) == (grpc.StatusCode.PERMISSION_DENIED, "NotADriver")
    await rig.until(lambda t: math.dist(xy(t.position), (-15, 15)) < 1.5, 60, "second point")
    events = await riding
    assert events[-1].state == pb.ControlEvent.STATE_COMPLETE
    assert events[-1].waypoints_reached == 2
    assert pb.ControlEvent.STATE_PASSENGER in {e.state for e in events}
    landed = await rig.until(lambda t: not t.armed, 90, "landing")
    assert math.dist(xy(landed.position), (0, 0)) < 2.0
    assert outcomes(landed) == {VIEWER_MISSION: "complete"}


def setpoint(north: float, east: float = 0.0, down: float = 0.0, hold_s: float = 0.0) -> pb.SetVelocityRequest:
    velocity = types_pb2.Velocity(north_mps=north, east_mps=east, down_mps=down)
    return pb.SetVelocityRequest(velocity=velocity, hold_s=hold_s)


# `make test` shows this with test_velocity_setpoint_expires_after_hold_time and test_velocity_setpoints_do_not_enter_exclusion_zone.
@pytest.mark.slow
async def test_velocity_setpoint_expires_and_is_denied_toward_zone(rig: Rig) -> None:
    rig.write_grant(grant(altitude_limit(5, 15), fence("no-fly", "exclusion", "land", 50, -50, 90, 50)))
    rig.start_service()
    rig.start_vehicle(2.0)
    driver = Driver(rig)
    await driver.up()
    set_velocity = driver.stub.SetVelocity

    await set_velocity(setpoint(3.0, hold_s=2.0), timeout=5)
    moving = await rig.until(lambda t: t.velocity.north_mps > 1.5, 20, "flight with a velocity")
    still = await rig.until(lambda t: abs(t.velocity.north_mps) < 0.2, 15, "end of the setpoint")
    assert still.controller == moving.controller
    assert xy(still.position)[1] < 25

    await driver.goto(30, 0)
    before = xy((await rig.telemetry()).position)
    code, why = await denied(set_velocity(setpoint(0.0, 12.0, hold_s=2.0), timeout=5))
    assert code == grpc.StatusCode.PERMISSION_DENIED or why.action == types_pb2.Decision.ACTION_TAKEOVER
    after = xy((await rig.telemetry()).position)
    assert math.dist(before, after) < 1.0, "the drone flew the denied setpoint"


async def test_check_call_returns_verdict_without_effect(rig: Rig) -> None:
    rig.write_grant(grant(altitude_limit(5, 15), fence("no-fly", "exclusion", "revoke", -60, -10, -40, 10)))
    rig.write_grant(passenger_grant())
    rig.start_service()
    rig.start_vehicle(3.0)
    driver = Driver(rig)
    await driver.up()

    async def check(stub: Any = driver.stub, **call: Any) -> pb.CheckCallResponse:
        return await stub.CheckCall(pb.CheckCallRequest(**call), timeout=5)

    high = await check(goto=pb.GotoRequest(target=place(0, 40, 30)))
    assert high.decision.action == types_pb2.Decision.ACTION_CORRECT
    assert high.goto.target.altitude_m == pytest.approx(14.8)
    into = await check(goto=pb.GotoRequest(target=place(-50, 0)))
    assert (into.decision.action, into.takeover) == (types_pb2.Decision.ACTION_TAKEOVER, "revoke")
    assert (await check(set_speed=pb.SetSpeedRequest(speed_mps=30))).set_speed.speed_mps == pytest.approx(11.4)
    passenger = await check(rig.stub(PASSENGER), hover=pb.HoverRequest())
    assert passenger.decision.code == "NotADriver"
    for bad in (
        {"takeoff": pb.TakeoffRequest(altitude_m=math.nan)},
        {"goto": pb.GotoRequest(target=types_pb2.Position(latitude_deg=95.0))},
        {"goto": pb.GotoRequest(target=place(0, 10), yaw_deg=math.inf)},
        {"goto": pb.GotoRequest(target=place(0, 10), speed_mps=-1.0)},
        {"set_speed": pb.SetSpeedRequest(speed_mps=math.inf)},
        {"set_velocity": setpoint(math.nan)},
        {"set_velocity": setpoint(1.0, hold_s=60.0)},
    ):
        assert (await check(**bad)).decision.code == "InvalidArgument", bad
    for bad in ({}, {"goto": pb.GotoRequest()}, {"set_velocity": pb.SetVelocityRequest()}):
        code, why = await denied(check(**bad))
        assert (code, why.code) == (grpc.StatusCode.INVALID_ARGUMENT, "InvalidArgument")
    state = await rig.telemetry()
    assert state.controller.startswith("spiffe://"), "a dry run took control from the driver"
    assert math.dist(xy(state.position), (0, 0)) < 2.0
    # A thread writes the audit log, so entries appear with a delay.
    await rig.until(
        lambda _: {e["action"] for e in rig.entries("check")} >= {"correct", "takeover", "deny"}, 20, "the audit log"
    )
    assert not rig.entries("takeover")


async def parameter(autopilot: MavlinkAutopilot, name: str) -> float:
    return (await autopilot.vehicle_parameters.read([(name,)]))[name]


async def test_vehicle_fence_returns_drone_without_service(rig: Rig) -> None:
    rig.write_grant(grant(corridor=[area(-20, -20, 20, 20)], operationArea=[area(-50, -50, 50, 50)]))
    rig.start_service()
    rig.start_vehicle(2.0)
    driver = Driver(rig)
    await driver.up()
    pilot = MavlinkAutopilot(rig.link, ARDUCOPTER)  # sends heartbeats in place of the killed service
    task = asyncio.create_task(pilot.run())
    async with asyncio.timeout(10):
        while not pilot.connected:
            await pilot.update(0.5)
    assert len(await download(pilot)) == 4
    assert await parameter(pilot, "FENCE_ENABLE") == 1.0
    assert await parameter(pilot, "FENCE_ALT_MAX") == 65.0
    rig.kill("service")
    lat, lon = FRAME.latlon(0, 45)
    await pilot.set_rates(flying=True)
    await pilot.go_to(lat, lon, 10.0, None)
    async with asyncio.timeout(60):
        while pilot.vehicle.mode != ARDUCOPTER.return_retracing:
            await pilot.update(0.2)
            if pilot.vehicle.lat is not None and FRAME.xy(pilot.vehicle.lat, pilot.vehicle.lon or 0)[1] > 30:
                pilot.fly(8.0, 0.0, 0.0)
    north = FRAME.xy(pilot.vehicle.lat or 0, pilot.vehicle.lon or 0)[1]
    assert 55 < north < 75, "the autopilot did not stop at its fence, about 10 m outside the operation area"
    assert pilot.vehicle.failsafe_text == "Polygon fence breached"
    task.cancel()


# `make test` shows this with test_fence_is_lowered_after_mission_ends and
# test_service_stopped_right_after_landing_restores_owner_fence_and_parameters.
@pytest.mark.slow
async def test_owner_fence_is_restored_after_mission(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle(3.0, "--param", "FENCE_ALT_MAX=77")
    driver = Driver(rig)
    await driver.up(4.0)
    await driver.stub.ReturnControl(pb.ReturnControlRequest(), timeout=5)
    await rig.until(lambda t: not t.armed, 90, "landing")
    owner = MavlinkAutopilot(rig.link, ARDUCOPTER)
    task = asyncio.create_task(owner.run())
    async with asyncio.timeout(20):
        while not owner.connected or await parameter(owner, "FENCE_ALT_MAX") != 77.0:
            await owner.update(0.2)
    assert await parameter(owner, "FENCE_ENABLE") == 0.0
    assert await download(owner) == ()
    task.cancel()


async def test_arming_is_refused_if_owner_fence_cannot_be_saved(rig: Rig) -> None:
    (rig.directory / "state" / "fence.json").mkdir(parents=True)  # the directory prevents a file with this name
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle(3.0)
    driver = Driver(rig)
    await driver.take()
    code, why = await denied(driver.arm())
    assert (code, why.code) == (grpc.StatusCode.FAILED_PRECONDITION, "FenceNotRaised")
    assert "own fence cannot be raised" in why.reason
    assert not (await rig.telemetry()).armed


@pytest.mark.parametrize("kind", ["serial", "udpin", "udpout"])
async def test_mavlink_connection_reaches_autopilot(rig: Rig, kind: str) -> None:
    port = free_port()
    pty = rig.directory / "pty"
    ours, theirs = {
        "serial": (f"serial:{pty}:115200", f"pty:{pty}"),
        "udpin": (f"udpin:127.0.0.1:{port}", f"udpout:127.0.0.1:{port}"),
        "udpout": (f"udpout:127.0.0.1:{port}", f"udpin:127.0.0.1:{port}"),
    }[kind]
    rig.write_grant(grant())
    rig.start_service(link=ours)  # before the vehicle, so the link does not exist yet
    rig.start_vehicle(3.0, "--listen", theirs)
    driver = Driver(rig)
    await driver.take(60)
    await driver.arm()
    assert (await rig.until(lambda t: t.armed and t.HasField("attitude"), 20)).autopilot_connected
    await driver.stub.Disarm(pb.DisarmRequest(), timeout=10)
    rig.kill("vehicle")
    await rig.until(lambda t: not t.autopilot_connected, 20, "loss of the vehicle")
    rig.start_vehicle(3.0, "--listen", theirs)
    await rig.until(lambda t: t.autopilot_connected and t.ready, 60, "the vehicle again")
