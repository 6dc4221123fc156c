"""The SDK's clients against real gRPC servers with mutual TLS."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from pathlib import Path

import fractus
import grpc
import pytest
from cryptography import x509
from fractus import runner
from fractus.drone import Mobility
from fractus.pictures import Camera
from fractus_proto.v1 import mobility_pb2
from grpc.aio import Metadata
from sdk_service import EXPIRED, NAVIGATOR, Authority, Drone, Event, Pictures, Server

pytestmark = pytest.mark.timeout(180)
WAIT_S = 15.0


@dataclass
class Stage:
    """Fake services of a drone on a gRPC server, and the endpoint for clients."""

    authority: Authority
    drone: Drone
    pictures: Pictures
    server: Server
    endpoint: fractus.Endpoint

    def renew(self) -> None:
        self.authority.issue(self.endpoint.tls_dir, [x509.UniformResourceIdentifier(NAVIGATOR)])

    def client(self, **options: object) -> Mobility:
        return Mobility(self.endpoint, **options)  # type: ignore[arg-type]


@pytest.fixture
async def stage(tmp_path: Path) -> AsyncIterator[Stage]:
    authority = Authority()
    server_tls = authority.issue(tmp_path / "server", [x509.DNSName("drone-1.node.fractus.dev")])
    drone = Drone()
    pictures = Pictures()
    server = Server(drone, pictures, server_tls)
    await server.start()
    endpoint = fractus.Endpoint(f"127.0.0.1:{server.port}", "drone-1.node.fractus.dev", tmp_path / "client")
    stage = Stage(authority, drone, pictures, server, endpoint)
    stage.renew()
    yield stage
    await server.stop()


async def test_driver_flies_and_returns_control(stage: Stage) -> None:
    steps: list[float] = []
    async with stage.client() as drone:
        async with drone.control() as control:
            assert control.control_point == 0
            await drone.arm()
            result = await drone.goto(40.0, 22.0, 20.0, progress=lambda step: steps.append(step.distance_m))
        assert control.mission_complete
    assert result.complete
    assert not result.corrected
    assert result.target.alt == 20.0, "the result lacks the target, which only the first message contains"
    assert steps == [2.0, 1.0, 0.0]
    assert stage.drone.calls == ["GetControl", "Arm", "Goto", "ReturnControl"]
    assert set(stage.drone.identities) == {NAVIGATOR}


async def test_every_unary_call_has_a_deadline(stage: Stage) -> None:
    async with stage.client(timeout_s=3.0) as drone:
        await drone.arm()
        await drone.arm(timeout_s=2.0)
        await drone.position()
    # Arming may wait for an autopilot that is not ready yet.
    assert [deadline_s is not None and 0 < deadline_s < limit_s for deadline_s, limit_s in zip(stage.drone.deadlines, (60.5, 2.5, 3.5), strict=True)] == [
        True, True, True,
    ]  # fmt: skip


async def test_correction_is_in_the_result(stage: Stage) -> None:
    async with stage.client() as drone, drone.control():
        result = await drone.goto(40.0, 22.0, 120.0)
        speed = await drone.set_speed(30.0)
    assert result.corrected
    assert result.target.alt == 60.0
    assert result.decision.policies == ("limit",)
    assert speed.corrected
    assert speed.speed_mps == 10.0


async def test_strict_client_raises_on_correction(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    async with stage.client(strict=True) as drone, drone.control():
        with pytest.raises(fractus.Corrected) as motion:
            await drone.goto(40.0, 22.0, 120.0)
        await asyncio.wait_for(stage.drone.hovering.wait(), WAIT_S)
        with pytest.raises(fractus.Corrected):
            await drone.set_speed(30.0)
    assert motion.value.decision.code == "AboveLimit"


async def test_refusal_contains_code_reason_and_policies(stage: Stage) -> None:
    async with stage.client() as drone, drone.control():
        with pytest.raises(fractus.PolicyDenied) as refusal:
            await drone.goto(40.02, 22.0, 20.0)
        assert (await drone.goto(40.0, 22.0, 20.0)).complete, (
            "the next Goto did not reach its target after a refused Goto"
        )
    assert refusal.value.code == "InsideExclusionZone"
    assert refusal.value.policies == ("no-fly-hospital",)
    assert "exclusion zone hospital (by no-fly-hospital)" in str(refusal.value)


async def test_cancelled_goto_stops_drone(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    async with stage.client() as drone, drone.control():
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await drone.goto(40.0, 22.0, 20.0)
        await asyncio.wait_for(stage.drone.hovering.wait(), WAIT_S)
    assert stage.drone.calls[-1] == "ReturnControl"


async def test_leaving_motion_iteration_stops_the_drone(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    async with stage.client() as drone, drone.control():
        async with contextlib.aclosing(aiter(drone.goto(40.0, 22.0, 20.0))) as steps:
            async for step in steps:
                assert step.distance_m == 2.0
                break
        await asyncio.wait_for(stage.drone.hovering.wait(), WAIT_S)


async def test_control_loss_ends_motion_with_reason(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    async with stage.client() as drone:
        with pytest.raises(fractus.ControlLost, match="the pilot took over"):
            async with drone.control():
                flight = asyncio.ensure_future(stage.drone.moving.wait())
                flight.add_done_callback(
                    lambda _: stage.drone.control.put_nowait(
                        Event(state=Event.STATE_LOST, reason="the pilot took over")
                    )
                )
                await drone.goto(40.0, 22.0, 20.0)
        with pytest.raises(fractus.ControlLost):
            await drone.arm()
    assert "ReturnControl" not in stage.drone.calls


async def test_control_loss_interrupts_other_work_in_the_block(stage: Stage) -> None:
    async with stage.client() as drone:
        with pytest.raises(fractus.ControlLost, match="revoked"):
            async with drone.control():
                stage.drone.control.put_nowait(Event(state=Event.STATE_LOST, reason="revoked"))
                await asyncio.sleep(WAIT_S)
    task = asyncio.current_task()
    assert task is not None
    assert not task.cancelling()


async def test_control_loss_can_be_caught_in_the_block(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    reasons: list[str] = []
    async with stage.client() as drone:
        with pytest.raises(fractus.ControlLost):
            async with drone.control():
                motion = asyncio.ensure_future(stage.drone.moving.wait())
                motion.add_done_callback(
                    lambda _: stage.drone.control.put_nowait(Event(state=Event.STATE_LOST, reason="revoked"))
                )
                try:
                    await drone.goto(40.0, 22.0, 20.0)
                except fractus.ControlLost as loss:
                    reasons.append(str(loss))
    assert reasons == ["revoked"]


async def test_control_progress_reports_reason_of_wait(stage: Stage) -> None:
    reasons: list[str] = []
    async with stage.client() as drone, drone.control(progress=reasons.append):
        assert reasons == ["the autopilot is not ready to arm: it has no home yet"]


async def visit(drone: Mobility, control: fractus.Control) -> None:
    async for waypoint in control.remaining():
        await drone.goto(waypoint.lat, waypoint.lon, waypoint.alt)


async def test_restarted_driver_continues_at_next_waypoint(stage: Stage) -> None:
    stage.drone.waypoints_reached = 1
    async with stage.client() as drone:
        await runner.fly(visit, drone)
    assert [round(target.longitude_deg, 3) for target in stage.drone.targets] == [22.001, 22.002]
    assert stage.drone.waypoints_reached == 3
    assert stage.drone.calls[-1] == "ReturnControl"


async def test_interrupted_program_restarts_a_limited_number_of_times(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "RETRY_S", 0.0)
    stage.drone.interruptions = 2
    async with stage.client() as drone:
        await runner.fly(visit, drone)
    assert len(stage.drone.targets) == 3
    assert stage.drone.calls.count("GetControl") == 1

    stage.drone.interruptions = 1000
    stage.drone.waypoints_reached = 0
    async with stage.client() as drone:
        with pytest.raises(fractus.Interrupted, match="a zone appeared ahead"):
            await runner.fly(visit, drone)


async def test_run_requests_lost_control_again(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "RETRY_S", 0.0)
    stage.drone.release = asyncio.Event()
    async with stage.client() as drone:
        flight = asyncio.create_task(runner.fly(visit, drone))
        await asyncio.wait_for(stage.drone.moving.wait(), WAIT_S)
        stage.drone.control.put_nowait(Event(state=Event.STATE_LOST, reason="a human pilot changed the mode to LOITER"))
        await asyncio.wait_for(stage.drone.hovering.wait(), WAIT_S)
        stage.drone.release.set()
        await asyncio.wait_for(flight, WAIT_S)
    assert stage.drone.calls.count("GetControl") == 2
    assert stage.drone.waypoints_reached == 3


async def test_mission_continues_with_interrupted_waypoint(stage: Stage) -> None:
    stage.drone.waypoints_reached = 1
    progress: list[tuple[int, int]] = []
    async with stage.client() as drone, drone.control():
        refused = await drone.mission().fly(lambda step: progress.append((step.number, step.count)))
    assert refused == {}
    assert sorted(set(progress)) == [(2, 3), (3, 3)]
    assert stage.drone.waypoints_reached == 3


async def test_mission_skips_refused_legs_if_requested(stage: Stage) -> None:
    waypoints = [fractus.Position(lat, 22.0, 20.0) for lat in (40.0, 40.5, 40.001)]
    async with stage.client() as drone, drone.control():
        with pytest.raises(fractus.PolicyDenied):
            await drone.mission(waypoints)
        assert stage.drone.waypoints_reached == 1
        refused = await drone.mission(waypoints, skip_refused=True)
        assert list(refused) == [2]
        assert isinstance(refused[2], fractus.PolicyDenied)
    assert [target.latitude_deg for target in stage.drone.targets] == [40.0, 40.001]


async def test_mission_pauses_and_resumes(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    async with stage.client() as drone, drone.control(), asyncio.timeout(WAIT_S):
        mission = drone.mission()
        flight = asyncio.ensure_future(mission.fly())
        await stage.drone.moving.wait()
        mission.pause()
        await stage.drone.hovering.wait()
        assert mission.paused
        assert not flight.done()
        stage.drone.release.set()
        mission.resume()
        assert await flight == {}
    assert len(stage.drone.targets) == 4, "the mission did not repeat the interrupted leg"


async def test_mission_without_control_is_refused(stage: Stage) -> None:
    async with stage.client() as drone:
        with pytest.raises(fractus.ControlLost, match=r"use `async with drone.control"):
            drone.mission()


async def test_turn_changes_heading_at_current_position(stage: Stage) -> None:
    async with stage.client() as drone, drone.control():
        await drone.turn(90)
    (target,) = stage.drone.targets
    assert (target.latitude_deg, target.longitude_deg, target.altitude_m) == (40.0, 22.0, 5.0)


async def test_camera_every_takes_pictures_repeatedly(stage: Stage) -> None:
    async with Camera(stage.endpoint) as camera, contextlib.aclosing(camera.every(0.0)) as pictures:
        first = await anext(pictures)
        second = await anext(pictures)
        assert not stage.pictures.stored
    assert [(p.info.name, p.data) for p in (first, second)] == [("1.jpg", stage.pictures.picture)] * 2


async def test_picture_that_cannot_be_retrieved_is_deleted(stage: Stage) -> None:
    stage.pictures.cut = True
    async with Camera(stage.endpoint) as camera:
        with pytest.raises(fractus.Unavailable, match="ended after"):
            await camera.take()
    assert not stage.pictures.stored


async def test_exception_in_block_does_not_return_control(stage: Stage) -> None:
    async with stage.client() as drone:
        with pytest.raises(ZeroDivisionError):
            async with drone.control():
                _ = 1 / 0
        await asyncio.wait_for(stage.drone.stream_closed.wait(), WAIT_S)
    assert "ReturnControl" not in stage.drone.calls


async def test_cancellation_from_outside_is_raised_unchanged(stage: Stage) -> None:
    async def fly() -> None:
        async with stage.client() as drone, drone.control():
            await asyncio.sleep(WAIT_S)

    task = asyncio.create_task(fly())
    await asyncio.wait_for(stage.drone.stream_open.wait(), WAIT_S)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_completed_mission_raises_mission_complete(stage: Stage) -> None:
    stage.drone.refuse_control = (grpc.StatusCode.FAILED_PRECONDITION, "the mission is complete")
    async with stage.client() as drone:
        with pytest.raises(fractus.MissionComplete):
            async with drone.control():
                pytest.fail("control was granted after the mission")


async def test_flight_survives_service_restart(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    async with stage.client() as drone, drone.control() as control:
        flight = asyncio.create_task(_fly(drone))
        await asyncio.wait_for(stage.drone.moving.wait(), WAIT_S)
        await stage.server.stop()
        stage.drone.waypoints_reached = 3
        stage.drone.release = None
        await stage.server.start()
        assert (await asyncio.wait_for(flight, WAIT_S)).complete
        assert control.waypoints_reached == 3
    assert stage.drone.calls.count("GetControl") == 2
    assert stage.drone.calls.count("Goto") == 2


async def _fly(drone: Mobility) -> fractus.Progress:
    return await drone.goto(40.0, 22.0, 20.0)


async def test_control_is_lost_if_service_does_not_return(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    async with stage.client(reconnect_timeout_s=0.5) as drone:
        with pytest.raises(fractus.ControlLost, match="no response"):
            async with drone.control():
                flight = asyncio.ensure_future(stage.drone.moving.wait())
                await asyncio.gather(drone.goto(40.0, 22.0, 20.0), _stop(flight, stage.server))
    await stage.server.start()


async def _stop(when: asyncio.Future[bool], server: Server) -> None:
    await when
    await server.stop()


async def test_call_waits_for_restarting_service_up_to_its_limit(stage: Stage) -> None:
    await stage.server.stop()
    async with stage.client(reconnect_timeout_s=0.5) as drone:
        with pytest.raises(fractus.Unavailable, match=stage.endpoint.address):
            await drone.position()
    async with stage.client() as drone:
        call = asyncio.create_task(drone.position())
        await asyncio.wait({call}, timeout=0.3)
        assert not call.done()
        await stage.server.start()
        assert (await asyncio.wait_for(call, WAIT_S)).velocity.north == 1.0


async def test_slow_tls_handshake_succeeds(stage: Stage) -> None:
    """On a busy node, a handshake takes longer than the interval between two attempts of a call."""

    async def forward(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(65536):
                sink.write(data)
                await sink.drain()
        sink.close()

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await asyncio.sleep(1.5)
        server_reader, server_writer = await asyncio.open_connection("127.0.0.1", stage.server.port)
        await asyncio.gather(forward(reader, server_writer), forward(server_reader, writer))

    slow = await asyncio.start_server(relay, "127.0.0.1", 0)
    port = slow.sockets[0].getsockname()[1]
    endpoint = replace(stage.endpoint, address=f"127.0.0.1:{port}")
    async with Mobility(endpoint, reconnect_timeout_s=WAIT_S) as drone:
        assert (await drone.position()).velocity.north == 1.0
    slow.close()


async def test_renewed_certificate_is_used_without_interrupting_flight(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()
    async with stage.client() as drone, drone.control() as control:
        flight = asyncio.create_task(_fly(drone))
        await asyncio.wait_for(stage.drone.moving.wait(), WAIT_S)
        stage.renew()
        await drone.position()
        assert len(stage.drone.certificates) == 2
        assert stage.drone.stream_open.is_set()
        assert control.lost is None
        stage.drone.release.set()
        assert (await asyncio.wait_for(flight, WAIT_S)).complete


async def test_streams_continue_after_certificate_renewal(stage: Stage) -> None:
    async with stage.client() as drone, drone.control() as control:
        samples = drone.telemetry()
        await anext(samples)
        stage.renew()
        stage.drone.stream_open.clear()
        stage.drone.expired.set()
        stage.drone.control.put_nowait(EXPIRED)
        await asyncio.wait_for(anext(samples), WAIT_S)
        await samples.aclose()
        await asyncio.wait_for(stage.drone.stream_open.wait(), WAIT_S)
        assert control.lost is None
    assert stage.drone.calls.count("GetControl") == stage.drone.calls.count("SubscribeTelemetry") == 2
    assert len(stage.drone.certificates) == 2


async def test_calls_ended_by_expired_certificate_are_retried(stage: Stage) -> None:
    async with stage.client() as drone:
        channel = drone._channel
        errors = [grpc.aio.AioRpcError(grpc.StatusCode.UNAUTHENTICATED, Metadata(), Metadata()) for _ in range(2)]
        calls = [channel.stub() for _ in errors]
        for call in calls:
            await call.__aenter__()
        stage.renew()
        for call, error in zip(calls, errors, strict=True):
            assert not await call.__aexit__(type(error), error, None)
        assert all(channel.transient(error) for error in errors)


async def test_stream_ends_if_certificate_is_not_renewed(stage: Stage) -> None:
    async with stage.client() as drone:
        samples = drone.telemetry()
        await anext(samples)
        stage.drone.expired.set()
        with pytest.raises(fractus.FractusError, match="no longer valid"):
            await anext(samples)
    assert stage.drone.calls == ["SubscribeTelemetry"]


async def test_server_certificate_must_match_the_node(stage: Stage) -> None:
    other = replace(stage.endpoint, server_name="drone-2.node.fractus.dev")
    async with Mobility(other, reconnect_timeout_s=0.3) as drone:
        with pytest.raises(fractus.Unavailable):
            await drone.position()
    assert stage.drone.calls == []


@pytest.mark.parametrize(
    ("trusted_files", "remedy"),
    [
        (("ca.crt",), "may not trust the authority of this component's certificate: .* FRACTUS_TLS_DIR"),
        ((), "another authority signed its certificate: correct FRACTUS_TLS_DIR"),
        (("ca.crt", "tls.crt"), "tls.crt and tls.key do not match: correct FRACTUS_TLS_DIR"),
    ],
)
async def test_client_with_foreign_certificate_fails_with_reason(
    stage: Stage, tmp_path: Path, trusted_files: tuple[str, ...], remedy: str
) -> None:
    tls = Authority().issue(tmp_path / "stranger", [x509.UniformResourceIdentifier(NAVIGATOR)])
    for name in trusted_files:
        (tls / name).write_bytes((stage.endpoint.tls_dir / name).read_bytes())
    async with Mobility(replace(stage.endpoint, tls_dir=tls), reconnect_timeout_s=0.3) as drone:
        with pytest.raises(fractus.Unavailable, match=remedy):
            await drone.position()
        with pytest.raises(fractus.Unavailable, match=remedy):
            async with drone.control():
                pass
    assert stage.drone.calls == []


async def test_missing_certificate_file_is_named_in_error(stage: Stage, tmp_path: Path) -> None:
    async with Mobility(replace(stage.endpoint, tls_dir=tmp_path / "nowhere")) as drone:
        with pytest.raises(fractus.NotConfigured, match=r"nowhere/ca\.crt"):
            await drone.position()


async def test_incomplete_picture_transfer_is_an_error(stage: Stage) -> None:
    async with Camera(stage.endpoint, reconnect_timeout_s=0.5) as camera:
        info = await camera.capture(width=800)
        assert info.width == 800
        assert await camera.retrieve(info.name) == stage.pictures.picture
        with pytest.raises(fractus.InvalidRequest, match=r"no picture 2\.jpg"):
            await camera.retrieve("2.jpg")
        stage.pictures.cut = True
        with pytest.raises(fractus.Unavailable, match="524288 of 614400 bytes"):
            await camera.retrieve(info.name)


async def test_sync_client_flies_a_mission(stage: Stage) -> None:
    def fly() -> tuple[fractus.Progress, bool]:
        with fractus.sync.mobility(stage.endpoint) as drone:
            with drone.control() as control:
                drone.arm()
                with pytest.raises(fractus.PolicyDenied):
                    drone.goto(40.02, 22.0, 20.0)
                result = drone.goto(40.0, 22.0, 120.0)
            return result, control.mission_complete

    result, complete = await asyncio.to_thread(fly)
    assert result.corrected
    assert complete


async def test_sync_client_raises_control_lost(stage: Stage) -> None:
    stage.drone.release = asyncio.Event()

    def fly() -> None:
        with fractus.sync.mobility(stage.endpoint) as drone, drone.control():
            drone.goto(40.0, 22.0, 20.0)

    flight = asyncio.create_task(asyncio.to_thread(fly))
    await asyncio.wait_for(stage.drone.moving.wait(), WAIT_S)
    stage.drone.control.put_nowait(mobility_pb2.ControlEvent(state=Event.STATE_LOST, reason="battery low"))
    with pytest.raises(fractus.ControlLost, match="battery low"):
        await asyncio.wait_for(flight, WAIT_S)
