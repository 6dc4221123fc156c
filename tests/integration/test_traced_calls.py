"""Traces from the call of the SDK to the acknowledgement of the autopilot, over gRPC, with and without a collector."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import fractus.tracing
import grpc
import pytest
from collector import Collector, ReceivedSpan, collecting
from fractus.drone import Mobility
from fractus.environment import Endpoint
from fractus.errors import InvalidRequest, PolicyDenied
from fractus.pictures import Camera
from fractus_cluster.ports import free_port
from fractus_core.api.names import node_server_name
from fractus_proto.v1 import mobility_pb2 as pb
from mobility_rig import DRIVER, FRAME, HOME, NODE, Rig, altitude_limit, area, fence, grant
from opentelemetry.proto.trace.v1.trace_pb2 import Span, Status

pytestmark = pytest.mark.timeout(240)
CLIENT = Span.SPAN_KIND_CLIENT
SERVER = Span.SPAN_KIND_SERVER
INTERNAL = Span.SPAN_KIND_INTERNAL
MOBILITY = "fractus.v1.MobilityService"
CAMERA = "fractus.v1.CameraService"
EDGE = f"""
apiVersion: fractus.dev/v1alpha1
kind: EdgeNode
metadata: {{name: {NODE}}}
spec:
  location: {{lat: {HOME[0]}, lon: {HOME[1]}, alt: {HOME[2]}, altitudeReference: amsl}}
  services:
    camera:
      resolution: 640x480
      horizontalFieldOfView: 60
      lens: {{model: pinhole}}
      mount: {{pitch: -90, height: 4}}
      methods: [CaptureImage, RetrieveImage]
"""


@pytest.fixture
def sdk(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Reset the SDK's tracing, so that it reads the environment of this test. Close its exporters after the test."""
    closers: list[Callable[[], None]] = []
    monkeypatch.setattr(fractus.tracing, "atexit", SimpleNamespace(register=closers.append))
    fractus.tracing._exporting.cache_clear()
    yield
    for close in closers:
        close()
    fractus.tracing._exporting.cache_clear()


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch, sdk: None) -> Iterator[Collector]:
    with collecting() as collector:
        for name, value in collector.environment.items():
            monkeypatch.setenv(name, value)
        yield collector


def endpoint(rig: Rig, address: str = "") -> Endpoint:
    folder = rig.directory / "tls-driver"
    folder.mkdir(exist_ok=True)
    key, certificate = rig.authority.issue(DRIVER)
    for name, data in (("tls.key", key), ("tls.crt", certificate), ("ca.crt", rig.authority.pem)):
        (folder / name).write_bytes(data)
    return Endpoint(address or rig.address, node_server_name(NODE), folder)


def parts(collector: Collector, call: ReceivedSpan, *names: str) -> dict[str, list[ReceivedSpan]]:
    """Wait for child spans with these names, and return the child spans of a call by name."""

    def children_by_name(spans: list[ReceivedSpan]) -> dict[str, list[ReceivedSpan]]:
        by_name: dict[str, list[ReceivedSpan]] = {}
        for span in spans:
            if span.span.parent_span_id == call.span.span_id:
                by_name.setdefault(span.name, []).append(span)
        return by_name if set(names) <= set(by_name) else {}

    return dict(collector.wait(children_by_name))


def served(collector: Collector, count: int) -> list[ReceivedSpan]:
    """Wait for this number of server spans, and return them."""

    def server_spans(spans: list[ReceivedSpan]) -> list[ReceivedSpan]:
        calls = [span for span in spans if span.span.kind == SERVER]
        return calls if len(calls) == count else []

    return list(collector.wait(server_spans))


async def test_corrected_goto_is_one_trace_from_the_sdk_to_the_autopilot(rig: Rig, collector: Collector) -> None:
    rig.write_grant(grant(altitude_limit(5, 7), fence("no-fly", "exclusion", "ignore", -60, -10, -40, 10)))
    rig.start_service()
    rig.start_vehicle(1.0)
    async with Mobility(endpoint(rig)) as drone, drone.control():
        await drone.arm()
        await drone.takeoff(6)
        goto = await drone.goto(*FRAME.latlon(0, 8), 20)
        assert goto.corrected
        with pytest.raises(PolicyDenied):
            await drone.goto(*FRAME.latlon(-50, 0), 7)
        await drone.set_velocity(0.5, 0.0, 0.0)

    call = collector.find(f"{MOBILITY}/Goto", SERVER, fractus__verdict__action="correct")
    client = collector.wait(lambda spans: [s for s in spans if s.span.span_id == call.span.parent_span_id])[0]
    assert (client.name, client.span.kind, client.span.parent_span_id) == (call.name, CLIENT, b"")
    method = {"rpc.system": "grpc", "rpc.service": MOBILITY, "rpc.method": "Goto"}
    cancelled = {"rpc.grpc.status_code": 1}  # the SDK cancels the stream of a completed motion
    assert client.attributes == method | cancelled
    assert client.span.status.code == Status.STATUS_CODE_UNSET
    code = goto.decision.code
    policies = list(goto.decision.policies)
    assert call.attributes | cancelled == client.attributes | {
        "fractus.caller": DRIVER, "fractus.verdict.action": "correct", "fractus.verdict.code": code,
        "fractus.verdict.policies": policies,
    }  # fmt: skip
    assert (call.service, call.node) == ("fractus-mobility", NODE)
    children = parts(collector, call, "policy.judge", "autopilot.DO_REPOSITION")
    judged = children["policy.judge"][0]
    flown = children["autopilot.DO_REPOSITION"][0]
    assert {s.span.trace_id for s in (client, call, judged, flown)} == {client.span.trace_id}
    assert judged.attributes["fractus.verdict.code"] == code
    assert judged.span.end_time_unix_nano <= flown.span.start_time_unix_nano
    assert flown.span.end_time_unix_nano <= call.span.end_time_unix_nano

    refused = collector.find(f"{MOBILITY}/Goto", SERVER, fractus__verdict__action="deny")
    assert refused.attributes["fractus.verdict.code"] == "InsideExclusionZone"
    assert refused.attributes["fractus.verdict.policies"] == ["no-fly"]
    assert refused.attributes["rpc.grpc.status_code"] == 7
    assert refused.span.status.code == Status.STATUS_CODE_UNSET, "a refusal is recorded as an error of the server"
    failed = collector.find(f"{MOBILITY}/Goto", CLIENT, rpc__grpc__status_code=7)
    assert failed.span.status.code == Status.STATUS_CODE_ERROR

    steered = collector.find(f"{MOBILITY}/SetVelocity", SERVER)
    assert parts(collector, steered, "autopilot.SET_POSITION_TARGET_LOCAL_NED")
    control_stream = collector.find(f"{MOBILITY}/GetControl", SERVER)
    assert control_stream.attributes["rpc.grpc.status_code"] in {0, 1}
    armed = collector.find(f"{MOBILITY}/Arm", SERVER)
    assert parts(collector, armed, "autopilot.COMPONENT_ARM_DISARM")
    assert not [s for s in collector.spans if s.name.endswith("ConfirmAlive")], (
        "answers to liveness requests have spans"
    )
    lat, lon = (f"{value:.3f}" for value in FRAME.latlon(0, 8))
    content = "".join(str(s.span) for s in collector.spans)
    assert lat not in content and lon not in content, "a span contains a position"


async def test_image_capture_is_traced_with_its_filters(rig: Rig, collector: Collector) -> None:
    privacy = {"type": "PrivacyControl", "kind": "camera", "action": "blurMedian", "selector": {"zones": ["private"]}}
    policy = {"name": "privacy", "spec": privacy, "zones": [{"name": "private", "area": area(-20, -20, 20, 20)}]}
    services = [{"service": "camera", "methods": ["CaptureImage", "RetrieveImage", "ListImages"]}]
    rig.write_grant(grant(policy, services=services, operationArea=[], **{"class": None}))
    address = rig.start_camera(description=EDGE)
    await rig.until_logged("camera", "serving", 60)
    async with Camera(endpoint(rig, address)) as camera:
        taken = await camera.capture()
        await camera.retrieve(taken.name)
    call = collector.find(f"{CAMERA}/CaptureImage", SERVER)
    assert (call.service, call.attributes["fractus.verdict.policies"]) == ("fractus-camera", ["privacy"])
    children = parts(collector, call, "policy.judge", "camera.capture", "camera.filters")
    assert children["camera.filters"][0].attributes["fractus.filters"] == ["blurMedian"]
    retrieved = collector.find(f"{CAMERA}/RetrieveImage", SERVER)
    client = collector.find(f"{CAMERA}/RetrieveImage", CLIENT)
    assert retrieved.span.parent_span_id == client.span.span_id


HOSTILE: tuple[tuple[tuple[str, str], ...], ...] = (
    (("traceparent", "nonsense"),),
    (("traceparent", f"00-{'0' * 32}-00f067aa0ba902b7-01"),),
    (("traceparent", "ff-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"),),
    (("traceparent", "00-4BF92F3577B34DA6A3CE929D0E0E4736-00f067aa0ba902b7-01"),),
    (("traceparent", f"00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01{'-x' * 1000}"),),
    (("tracestate", f"a={'b' * 3000}"), ("baggage", f"secret={'c' * 3000}")),
)


async def test_malformed_and_unknown_headers_are_ignored(rig: Rig, collector: Collector) -> None:
    rig.write_grant(grant())
    rig.start_service(link="udpin:127.0.0.1:0")
    stub = rig.stub()
    for headers in HOSTILE:
        with pytest.raises(grpc.aio.AioRpcError, match="position is not known yet"):
            await stub.GetPosition(pb.GetPositionRequest(), timeout=60, wait_for_ready=True, metadata=headers)
    for call in served(collector, len(HOSTILE)):
        assert (call.span.parent_span_id, call.span.trace_state) == (b"", "")
        assert call.attributes["rpc.grpc.status_code"] == 14
        assert call.span.status.code == Status.STATUS_CODE_ERROR
        assert "secret" not in str(call.span)


async def test_traceparent_continues_the_trace_of_the_caller(rig: Rig, collector: Collector) -> None:
    rig.write_grant(grant())
    rig.start_service(link="udpin:127.0.0.1:0")
    parent = ("traceparent", "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01")
    with pytest.raises(grpc.aio.AioRpcError, match="position is not known yet"):
        await rig.stub().GetPosition(pb.GetPositionRequest(), timeout=60, wait_for_ready=True, metadata=(parent,))
    (call,) = served(collector, 1)
    assert call.span.parent_span_id.hex() == "00f067aa0ba902b7"
    assert call.span.trace_id.hex() == "4bf92f3577b34da6a3ce929d0e0e4736"


async def test_flight_continues_while_the_collector_is_unreachable(
    rig: Rig, sdk: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{free_port()}")
    monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "20")
    monkeypatch.setenv("OTEL_BSP_MAX_QUEUE_SIZE", "8")
    monkeypatch.setenv("OTEL_BSP_MAX_EXPORT_BATCH_SIZE", "4")
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "1")
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle()
    async with Mobility(endpoint(rig)) as drone, drone.control():
        await drone.arm()
        await drone.takeoff(6)
        for _ in range(50):
            await drone.position()
            await asyncio.sleep(0.02)  # keeps the rate below the limit of the caller
        with pytest.raises(InvalidRequest):
            await drone.goto(float("nan"), 0.0, 6)


async def test_service_without_a_collector_does_not_import_the_opentelemetry_sdk(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")
    rig.write_grant(grant())
    rig.start_service(link="udpin:127.0.0.1:0")
    with pytest.raises(grpc.aio.AioRpcError, match="position is not known yet"):
        await rig.stub().GetPosition(pb.GetPositionRequest(), timeout=60, wait_for_ready=True)
    imported = (rig.directory / "service.log").read_text()
    assert "| " in imported and "fractus_runtime.tracing" in imported
    assert "opentelemetry.sdk" not in imported
    assert "opentelemetry.exporter" not in imported
