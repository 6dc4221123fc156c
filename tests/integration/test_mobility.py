"""The mobility service with a flying vehicle: missions, corrections, refusals."""

from __future__ import annotations

import asyncio
import math
import signal
import time
from pathlib import Path

import grpc
import pytest
from fractus_agent.registration.node_object_file import NodeObjectFile
from fractus_cluster.ports import free_port
from fractus_core.api.model import API_VERSION
from fractus_core.api.names import component_name, node_identity
from fractus_core.api.nodes import Drone
from fractus_proto.v1 import mobility_pb2 as pb
from fractus_proto.v1 import types_pb2
from fractus_runtime.audit_chain import verify
from mobility_rig import (
    ALL,
    DRIVER,
    NAVIGATOR_MISSION,
    NODE,
    PASSENGER,
    Driver,
    Rig,
    altitude_limit,
    denied,
    fence,
    flown,
    grant,
    outcomes,
    passenger_grant,
    xy,
)
from scraping import scraped

Decision = types_pb2.Decision


async def test_mobility_mission_applies_corrections_and_denials(rig: Rig) -> None:
    rig.write_grant(grant(altitude_limit(5, 15), fence("no-fly", "exclusion", "ignore", -60, -10, -40, 10)))
    rig.write_grant(passenger_grant())
    port = free_port()
    # The service starts first, waits for the vehicle, and identifies it.
    rig.start_service("--metrics", f"127.0.0.1:{port}", knows_vehicle=False)
    rig.start_vehicle()
    driver = Driver(rig)
    climbed = await driver.up(3.0)
    assert climbed.decision.action == Decision.ACTION_CORRECT
    assert climbed.decision.code == "AltitudeBelowLimit"
    assert climbed.target.altitude_m == pytest.approx(5.2)

    first = await driver.goto(0, 40, 20.0)
    assert first.decision.action == Decision.ACTION_CORRECT
    assert list(first.decision.policies) == ["altitudes"]
    assert first.target.altitude_m == pytest.approx(14.8)
    assert first.position.altitude_m == pytest.approx(15.0, abs=1.0)
    assert math.dist(xy(first.position), (0, 40)) < 1.5

    code, why = await denied(flown(driver.start_goto(-50, 0)))
    assert (code, why.code) == (grpc.StatusCode.PERMISSION_DENIED, "InsideExclusionZone")
    assert why.action == Decision.ACTION_DENY
    assert list(why.policies) == ["no-fly"]
    code, why = await denied(flown(driver.start_goto(-80, -20)))
    assert why.code == "LegThroughExclusionZone"
    code, why = await denied(flown(driver.start_goto(0, 150)))
    assert (code, why.code) == (grpc.StatusCode.PERMISSION_DENIED, "OutsideOperationArea")
    code, why = await denied(flown(driver.start_goto(0, 20, math.nan)))
    assert code == grpc.StatusCode.INVALID_ARGUMENT
    assert why.code == "InvalidArgument"

    passenger = rig.stub(PASSENGER)
    reported = await passenger.GetPosition(pb.GetPositionRequest(), timeout=5)
    assert math.dist(xy(reported.position), (0, 40)) < 2.0
    code, why = await denied(passenger.Hover(pb.HoverRequest(), timeout=5))
    assert (code, why.code) == (grpc.StatusCode.PERMISSION_DENIED, "NotADriver")

    speed = await driver.stub.SetSpeed(pb.SetSpeedRequest(speed_mps=30), timeout=5)
    assert speed.speed_mps == pytest.approx(11.4)
    assert speed.decision.code == "SpeedAboveLimit"
    await driver.goto(40, 40)
    code, why = await denied(driver.stub.Disarm(pb.DisarmRequest(), timeout=5))
    assert why.code == "InAir"

    samples = await asyncio.to_thread(scraped, port)
    assert (
        samples["fractus_in_air",]
        == samples["fractus_control_authority", "driver"]
        == samples["fractus_companion_alive",]
        == 1
    )
    assert samples["fractus_policy_verdicts_total", "correct", "altitudes"] >= 1
    assert samples["fractus_policy_verdicts_total", "deny", "no-fly"] >= 1
    assert samples["fractus_verdicts_total", "deny", "NotADriver"] == 1
    assert 0 <= samples["fractus_telemetry_age_seconds",] < 10
    assert samples["fractus_audit_sequence",] > 10
    assert samples["fractus_certificate_expiry_timestamp_seconds",] > time.time()

    await _return_and_land(rig, driver)
    _check_audit(rig)
    _check_log(rig)


async def _return_and_land(rig: Rig, driver: Driver) -> None:
    reply = await driver.stub.ReturnControl(pb.ReturnControlRequest(), timeout=5)
    assert reply.mission_complete
    await driver.next(pb.ControlEvent.STATE_COMPLETE)
    landed = await rig.until(lambda t: not t.armed, 90, "landing")
    assert math.dist(xy(landed.position), (0, 0)) < 2.0
    assert outcomes(landed) == {NAVIGATOR_MISSION: "complete"}

    code, why = await denied(_first_event(Driver(rig)))
    assert (code, why.code) == (grpc.StatusCode.FAILED_PRECONDITION, "MissionComplete")


def _check_audit(rig: Rig) -> None:
    rig.kill("service", signal.SIGTERM)
    with rig.audit.open("rb") as log:
        finding = verify(log)
    assert not finding.problem
    assert not finding.torn
    calls = rig.entries("call")
    assert {"correct", "deny", "allow"} <= {c["action"] for c in calls}
    states = rig.entries("state")
    assert len(states) > 10
    assert max(s["alt"] for s in states) < 16.0


def _check_log(rig: Rig) -> None:
    """Check that the log has a line for each decision except plain permissions."""
    log = (rig.directory / "service.log").read_text()
    lines = [line for line in log.splitlines() if " policy: " in line]
    changed = [call for call in rig.entries("call") if call["action"] != "allow"]
    assert [f"action={c['action']} caller={c['caller']} method={c['method']} code={c['code']} " in line
            for c, line in zip(changed, lines, strict=True)] == [True] * len(changed), lines  # fmt: skip
    assert f"control: granted (kind=control controller={component_name(DRIVER)} " in log


async def _first_event(driver: Driver) -> None:
    async for _ in driver.stub.GetControl(pb.GetControlRequest(), timeout=10):
        return


async def test_mobility_authentication_rejects_foreign_and_expired_identities(rig: Rig, tmp_path: Path) -> None:
    from mobility_rig import Authority

    rig.write_grant(grant())
    rig.write_grant(passenger_grant(services=[{"service": "mobility", "methods": ["GetSpeed"]}]))
    rig.start_service()
    rig.start_vehicle()
    await rig.until(lambda t: t.ready and t.HasField("position"), 20)
    ask = pb.GetPositionRequest()
    await rig.stub(DRIVER).GetPosition(ask, timeout=5)

    other = DRIVER.replace("/app/app/", "/app/other/")
    code, why = await denied(rig.stub(other).GetPosition(ask, timeout=5))
    assert (code, why.code) == (grpc.StatusCode.PERMISSION_DENIED, "NoGrant")
    code, why = await denied(rig.stub(PASSENGER).GetPosition(ask, timeout=5))
    assert (code, why.code) == (grpc.StatusCode.PERMISSION_DENIED, "MethodNotGranted")
    code, why = await denied(rig.stub(node_identity("drone-2")).GetPosition(ask, timeout=5))
    assert code == grpc.StatusCode.PERMISSION_DENIED
    code, why = await denied(rig.stub(node_identity(NODE)).GetPosition(ask, timeout=5))
    assert code == grpc.StatusCode.PERMISSION_DENIED, "an identity of the node called GetPosition"
    for channel in (
        rig.stub(DRIVER, seconds=-1.0),  # expired
        rig.stub(DRIVER, authority=Authority(tmp_path, "stranger")),
    ):
        code, _ = await denied(channel.GetPosition(ask, timeout=5))
        assert code == grpc.StatusCode.UNAVAILABLE, "the TLS handshake succeeded"
    plain = grpc.aio.insecure_channel(rig.address)
    code, _ = await denied(plain.unary_unary("/fractus.v1.MobilityService/GetPosition")(b"", timeout=3))
    assert code in {grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED}
    await plain.close()
    code, why = await denied(rig.stub(DRIVER).Arm(pb.ArmRequest(), timeout=5))
    assert (code, why.code) == (grpc.StatusCode.FAILED_PRECONDITION, "NotInControl")


async def test_mobility_connection_is_rejected_after_certificate_expires(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle()
    await rig.until(lambda t: t.ready and t.HasField("position"), 20)
    stub = rig.stub(DRIVER, seconds=4.0)
    await stub.GetPosition(pb.GetPositionRequest(), timeout=5)

    async def stream() -> None:
        async for _ in stub.SubscribeTelemetry(pb.SubscribeTelemetryRequest(), timeout=20):
            pass

    code, why = await denied(stream())
    assert (code, why.code) == (grpc.StatusCode.UNAUTHENTICATED, "NotAuthenticated")
    code, why = await denied(stub.GetPosition(pb.GetPositionRequest(), timeout=5))
    assert code in {grpc.StatusCode.UNAUTHENTICATED, grpc.StatusCode.UNAVAILABLE}


async def test_mobility_uses_renewed_server_certificate(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle()
    await rig.until(lambda t: t.ready and t.HasField("position"), 20)
    from mobility_rig import Authority

    rig.authority = Authority(rig.directory, "next")
    rig.write_tls()
    await rig.stub(DRIVER).GetPosition(pb.GetPositionRequest(), timeout=5)


async def test_mobility_restarts_when_node_description_names_autopilot(rig: Rig) -> None:
    handed = rig.directory / "node.json"
    rig.write_grant(grant())
    rig.start_service("--autopilot", "", "--node-object", str(handed))
    await rig.until_logged("service", "description: missing, using defaults")
    services = {
        "mobility": {"connection": rig.link, "maxAltitude": 80, "maxFlightTime": 15, "maxSpeed": 15, "methods": ALL}
    }
    NodeObjectFile(handed).write(
        Drone.from_body(
            {"apiVersion": API_VERSION, "kind": "Drone", "metadata": {"name": NODE}, "spec": {"services": services}}
        )
    )
    assert await rig.ended("service") == 1
    assert f"names a different autopilot link ({rig.link}); restarting" in rig.log("service")
    rig.start_service("--autopilot", "", "--node-object", str(handed))
    rig.start_vehicle()
    await rig.until(lambda t: t.ready and t.HasField("position"), 20)


async def test_cancelled_goto_stops_drone(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle(2.0)
    driver = Driver(rig)
    await driver.up(5.0)
    going = driver.start_goto(0, 90, 5.0)
    await going.read()
    await rig.until(lambda t: t.velocity.north_mps > 3)
    going.cancel()
    still = await rig.until(lambda t: abs(t.velocity.north_mps) < 0.3, 10)
    assert still.controller == DRIVER
    assert xy(still.position)[1] < 70


async def test_flood_of_calls_is_rejected_without_affecting_driver(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.write_grant(passenger_grant())
    rig.start_service()
    rig.start_vehicle()
    driver = Driver(rig)
    await driver.up()
    flooder = rig.stub(PASSENGER)

    async def flood() -> int:
        refused = 0
        for _ in range(60):
            calls = [flooder.GetPosition(pb.GetPositionRequest(), timeout=5) for _ in range(10)]
            for outcome in await asyncio.gather(*calls, return_exceptions=True):
                if isinstance(outcome, grpc.aio.AioRpcError):
                    assert outcome.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
                    refused += 1
        return refused

    flooding = asyncio.create_task(flood())
    await driver.goto(0, 40)
    assert await flooding > 100
    assert (await rig.telemetry()).controller == DRIVER
