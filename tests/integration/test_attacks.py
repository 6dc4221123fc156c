"""Attacks on the services of a drone, with real gRPC and certificates. Each is refused safely and with a reason."""

from __future__ import annotations

import asyncio
import json
import resource
import socket
import ssl
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import grpc
import pytest
from cryptography.hazmat.primitives import serialization
from fractus_core.api.names import OPERATOR_IDENTITY, component_identity, node_identity, node_server_name
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc, mobility_pb2_grpc, types_pb2
from fractus_proto.v1 import mobility_pb2 as pb
from fractus_runtime.audit_chain import verify
from fractus_services.grpc_server import CALL_BURST, CALLS_PER_S, MAX_OPEN_CALLS
from google.rpc import error_details_pb2
from grpc_status import rpc_status
from mobility_rig import (
    DRIVER,
    NODE,
    PASSENGER,
    Authority,
    Driver,
    Rig,
    altitude_limit,
    denied,
    flown,
    grant,
    issue_signer,
    passenger_grant,
)

Status = grpc.StatusCode
ASK = pb.GetSpeedRequest()
LOST = pb.ControlEvent.STATE_LOST
FLOOD_PER_S = 500.0


async def served(rig: Rig, identity: str = DRIVER) -> mobility_pb2_grpc.MobilityServiceStub:
    """Return a stub for an identity, after its first call was accepted."""
    stub = rig.stub(identity)
    await stub.GetSpeed(ASK, timeout=20, wait_for_ready=True)
    return stub


async def flying(rig: Rig, *policies: dict[str, Any]) -> Driver:
    rig.write_grant(grant(*policies))
    rig.start_service()
    rig.start_vehicle()
    driver = Driver(rig)
    await driver.up()
    return driver


async def until(condition: Callable[[], object], description: str, timeout_s: float = 15.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, description
        await asyncio.sleep(0.05)


# Certificates


async def test_attack_with_foreign_certificate_is_refused(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    stub = await served(rig)

    async def call(identity: str, **options: Any) -> tuple[grpc.StatusCode, str]:
        code, why = await denied(rig.stub(identity, **options).GetSpeed(ASK, timeout=5))
        return code, why.code

    stranger = Authority(rig.directory, "ca")
    assert (await call(DRIVER, authority=stranger))[0] == Status.UNAVAILABLE, (
        "issued by another authority of the same name"
    )
    assert (await call(DRIVER, seconds=-10.0, begun=-3600.0))[0] == Status.UNAVAILABLE, "expired"
    assert (await call(DRIVER, begun=1800.0))[0] == Status.UNAVAILABLE, "not valid yet"
    no_grant = (Status.PERMISSION_DENIED, "NoGrant")
    assert await call(DRIVER.replace("/ns/default/", "/ns/tenant-b/")) == no_grant
    assert await call(DRIVER.replace("/app/app/", "/app/other/")) == no_grant
    assert await call(DRIVER.replace("instance/app-navigator", "instance/app-navigator-2")) == no_grant
    assert await call(DRIVER + "/") == no_grant
    assert await call(DRIVER.upper().replace("SPIFFE://FRACTUS.DEV", "spiffe://fractus.dev")) == no_grant
    assert await call(node_identity("drone-2")) == no_grant
    assert await call(OPERATOR_IDENTITY) == no_grant, "the operator has no Grant"
    assert (await call("https://fractus.dev/operator"))[0] == Status.UNAUTHENTICATED, "no SPIFFE id"
    await stub.GetSpeed(ASK, timeout=5)


async def test_attack_with_grant_signing_certificate_is_refused(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    await served(rig)
    key, certificate = issue_signer(rig.authority.certificate, rig.authority._key, DRIVER)
    pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    credentials = grpc.ssl_channel_credentials(
        rig.authority.pem, pem, certificate.public_bytes(serialization.Encoding.PEM)
    )
    options = [("grpc.ssl_target_name_override", node_server_name(NODE))]
    async with grpc.aio.secure_channel(rig.address, credentials, options) as channel:
        with pytest.raises(grpc.aio.AioRpcError) as refusal:
            await mobility_pb2_grpc.MobilityServiceStub(channel).GetSpeed(ASK, timeout=5)
    assert refusal.value.code() == Status.UNAVAILABLE


async def test_attack_with_certificate_of_removed_instance_is_refused(rig: Rig) -> None:
    path = rig.write_grant(grant())
    stale = path.read_bytes()
    rig.start_service()
    stub = await served(rig)
    path.unlink()
    await until(lambda: [e for e in rig.entries("grant") if e["change"] == "removed"], "the grant's end")
    code, why = await denied(stub.GetSpeed(ASK, timeout=5))
    assert (code, why.code) == (Status.PERMISSION_DENIED, "NoGrant"), "a call on the open connection was accepted"
    path.write_bytes(stale)
    await until(lambda: [e for e in rig.entries("grant") if e["change"] == "refused"], "the replay's refusal")
    assert "was revoked here" in rig.entries("grant")[-1]["reason"]
    code, why = await denied(rig.stub(DRIVER).GetSpeed(ASK, timeout=5))
    assert (code, why.code) == (Status.PERMISSION_DENIED, "NoGrant")
    rig.kill("service")
    rig.start_service()
    code, why = await denied(rig.stub(DRIVER).GetSpeed(ASK, timeout=20, wait_for_ready=True))
    assert (code, why.code) == (Status.PERMISSION_DENIED, "NoGrant"), "the restarted service accepted the revoked Grant"
    rig.write_grant(grant())
    await until(lambda: rig.entries("grant")[-1]["change"] == "added", "the new grant")
    await stub.GetSpeed(ASK, timeout=20, wait_for_ready=True)


CLOCK = """
import time, pathlib
_real, _file = time.time, pathlib.Path({file!r})
def _shifted():
    try:
        return _real() + float(_file.read_text() or 0)
    except (OSError, ValueError):
        return _real()
time.time = _shifted
"""


async def test_attack_with_unsigned_grant_is_refused(rig: Rig) -> None:
    rig.write_grant(grant(), signed=False)
    rig.start_service()
    code, why = await denied(rig.stub(DRIVER).GetSpeed(ASK, timeout=20, wait_for_ready=True))
    assert (code, why.code) == (Status.PERMISSION_DENIED, "NoGrant")
    await until(lambda: rig.entries("grant"), "the refusal in the audit log")
    assert "the Grant is not signed" in rig.entries("grant")[-1]["reason"]
    rig.write_grant(grant())
    await until(lambda: rig.entries("grant")[-1]["change"] == "added", "the grant")


async def test_attack_with_malformed_calls_is_limited_and_fills_no_disk(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    await served(rig)
    log = rig.directory / "service.log"
    begun = log.stat().st_size
    channel = rig.channel(DRIVER)
    codes = Counter[Status]()
    await mobility_pb2_grpc.MobilityServiceStub(channel).GetSpeed(ASK, timeout=5, wait_for_ready=True)
    for method, kind in (("SetSpeed", channel.unary_unary), ("Goto", channel.unary_stream)):
        for _ in range(300):
            call: Any = kind(f"/fractus.v1.MobilityService/{method}")(b"\xff" * 8, timeout=5)
            codes[await call.code()] += 1
    assert codes[Status.INVALID_ARGUMENT] <= CALL_BURST + CALLS_PER_S * 10
    assert codes.keys() == {Status.INVALID_ARGUMENT, Status.RESOURCE_EXHAUSTED}
    host, port = rig.address.split(":")
    stranger = ssl.create_default_context()
    stranger.check_hostname = False
    stranger.verify_mode = ssl.CERT_NONE
    stranger.set_alpn_protocols(["h2"])
    for _ in range(200):
        for context in (stranger, None):
            with suppress(OSError):
                reader, writer = await asyncio.open_connection(host, int(port), ssl=context)
                writer.write(b"GET / HTTP/1.1\r\n\r\n")
                await reader.read()
                writer.close()
    assert log.stat().st_size - begun < 20_000, log.read_text()[-2000:]
    assert "Traceback" not in log.read_text()


async def test_clock_step_neither_refuses_callers_nor_accepts_expired_certificates(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    shift = rig.directory / "shift"
    shift.write_text("0")
    (rig.directory / "sitecustomize.py").write_text(CLOCK.format(file=str(shift)))
    monkeypatch.setenv("PYTHONPATH", str(rig.directory))
    rig.write_grant(grant())
    rig.start_service()
    await served(rig)
    stub = rig.stub(DRIVER, seconds=600.0)
    short = rig.stub(DRIVER, seconds=5.0)
    await short.GetSpeed(ASK, timeout=5)
    for step_s in (0, 400 * 86_400, 0, -3600, -400 * 86_400):
        shift.write_text(str(step_s))
        await stub.GetSpeed(ASK, timeout=5)
        if step_s > 0:
            code, why = await denied(rig.stub(DRIVER).GetSpeed(ASK, timeout=5))
            assert (code, why.code) == (Status.UNAUTHENTICATED, "NotAuthenticated"), (
                "a caller without a connection before the step was accepted"
            )
            assert "expired" in why.reason
    await until(lambda: len(rig.entries("clock")) >= 3, "the steps in the audit log")
    assert [round(entry["step_s"] / 86_400, 2) for entry in rig.entries("clock")][:3] == [400.0, 0.0, -0.04]

    async def watched() -> None:
        async for _ in short.SubscribeTelemetry(pb.SubscribeTelemetryRequest(), timeout=20):
            pass

    for call in (watched, lambda: short.GetSpeed(ASK, timeout=5)):
        code, why = await denied(call())
        assert (code, why.code) == (Status.UNAUTHENTICATED, "NotAuthenticated"), (
            "the certificate has expired by the monotonic clock"
        )
    code, why = await denied(short.Hover(pb.HoverRequest(), timeout=5))
    assert (code, why.code) == (Status.FAILED_PRECONDITION, "NotInControl"), (
        "Hover was refused because of the expired certificate"
    )
    # The validity of a Grant does not depend on the clock of the node.
    rig.write_grant(grant(altitude_limit(5, 15)))
    await until(lambda: [e for e in rig.entries("grant") if e["change"] == "changed"], "the new grant")


# Methods


async def test_attack_with_methods_outside_grant_is_refused(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.write_grant(passenger_grant(services=[{"service": "camera", "methods": ["ListImages"]}]))
    rig.start_service()
    camera = rig.start_camera()
    await served(rig)
    stub = rig.stub(PASSENGER)
    unary: list[Awaitable[Any]] = [
        stub.Arm(pb.ArmRequest(), timeout=5), stub.Disarm(pb.DisarmRequest(), timeout=5),
        stub.Hover(pb.HoverRequest(), timeout=5), stub.SetSpeed(pb.SetSpeedRequest(speed_mps=1), timeout=5),
        stub.GetSpeed(ASK, timeout=5), stub.GetPosition(pb.GetPositionRequest(), timeout=5),
        stub.ReturnControl(pb.ReturnControlRequest(), timeout=5),
    ]  # fmt: skip
    streams = [
        stub.GetControl(pb.GetControlRequest(), timeout=5), stub.Takeoff(pb.TakeoffRequest(altitude_m=5), timeout=5),
        stub.Goto(pb.GotoRequest(target=types_pb2.Position()), timeout=5), stub.Land(pb.LandRequest(), timeout=5),
        stub.ReturnToLaunch(pb.ReturnToLaunchRequest(), timeout=5),
        stub.SubscribeTelemetry(pb.SubscribeTelemetryRequest(), timeout=5),
    ]  # fmt: skip
    for call in [*unary, *(stream.read() for stream in streams)]:
        code, why = await denied(call)
        assert code == Status.PERMISSION_DENIED
        assert why.code in {"MethodNotGranted", "NotADriver"}
        assert why.action == types_pb2.Decision.ACTION_DENY
        assert why.reason

    pictures = camera_pb2_grpc.CameraServiceStub(rig.channel(PASSENGER, address=camera))
    await pictures.ListImages(camera_pb2.ListImagesRequest(), timeout=20, wait_for_ready=True)
    for call in (
        pictures.CaptureImage(camera_pb2.CaptureImageRequest(), timeout=5),
        pictures.DeleteImage(camera_pb2.DeleteImageRequest(name="x"), timeout=5),
        pictures.RetrieveImage(camera_pb2.RetrieveImageRequest(name="x"), timeout=5).read(),
    ):
        code, why = await denied(call)
        assert (code, why.code) == (Status.PERMISSION_DENIED, "MethodNotGranted")


async def test_attack_with_invalid_call_is_refused(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    stub = await served(rig)
    code, why = await denied(stub.GetSpeed(ASK))
    assert (code, why.code) == (Status.INVALID_ARGUMENT, "DeadlineMissing")
    assert "set a timeout" in why.reason
    channel = rig.channel(DRIVER)
    huge = channel.unary_unary("/fractus.v1.MobilityService/GetSpeed")(b"\x0a" * 100_000, timeout=5)
    with pytest.raises(grpc.aio.AioRpcError) as refusal:
        await huge
    assert refusal.value.code() == Status.RESOURCE_EXHAUSTED
    garbage = channel.unary_unary("/fractus.v1.MobilityService/GetSpeed")(b"\xff\xff\xff", timeout=5)
    with pytest.raises(grpc.aio.AioRpcError) as refusal:
        await garbage
    assert refusal.value.code() in {Status.INTERNAL, Status.UNKNOWN, Status.INVALID_ARGUMENT}
    with pytest.raises(grpc.aio.AioRpcError) as refusal:
        await channel.unary_unary("/fractus.v1.MobilityService/FlyAway")(b"", timeout=5)
    assert refusal.value.code() == Status.UNIMPLEMENTED
    with pytest.raises(grpc.aio.AioRpcError) as refusal:
        await stub.GetSpeed(ASK, timeout=5, metadata=[("x-large", "x" * 60_000)])
    assert refusal.value.code() in {Status.RESOURCE_EXHAUSTED, Status.UNAVAILABLE}
    async with grpc.aio.insecure_channel(rig.address) as plain:
        with pytest.raises(grpc.aio.AioRpcError) as refusal:
            await mobility_pb2_grpc.MobilityServiceStub(plain).GetSpeed(ASK, timeout=5)
    assert refusal.value.code() == Status.UNAVAILABLE
    await stub.GetSpeed(ASK, timeout=5, wait_for_ready=True)


# Floods


async def _flood(address: str, pem: list[bytes], until_s: float) -> None:
    """Start calls at a constant rate regardless of responses, and print the results. Runs in the attacker's process.

    SHED counts calls that gRPC itself refused, because the connection had too many open calls on a busy machine.
    """
    ca, key, certificate = pem
    ended: Counter[str] = Counter()
    hints = 0

    async def one(stub: Any) -> None:
        nonlocal hints
        try:
            await stub.GetSpeed(ASK, timeout=30)
            ended["OK"] += 1
        except grpc.aio.AioRpcError as error:
            shed = error.code() == Status.UNAVAILABLE and "RST_STREAM" in (error.details() or "")
            ended["SHED" if shed else error.code().name] += 1
            status = rpc_status.from_call(error)
            hints += status is not None and any(d.Is(error_details_pb2.RetryInfo.DESCRIPTOR) for d in status.details)

    options = [("grpc.ssl_target_name_override", node_server_name(NODE))]
    credentials = grpc.ssl_channel_credentials(ca, key, certificate)
    async with grpc.aio.secure_channel(address, credentials, options) as channel:
        stub = mobility_pb2_grpc.MobilityServiceStub(channel)
        begin = time.monotonic()
        sent = 0
        calls = set()
        while (now := time.monotonic()) < begin + until_s:
            while sent < (now - begin) * FLOOD_PER_S:
                calls.add(asyncio.create_task(one(stub)))
                sent += 1
            await asyncio.sleep(0.005)
        await asyncio.gather(*calls)
    print(json.dumps({"sent": sent, "ended": ended, "hints": hints, "seconds": time.monotonic() - begin}))


async def test_attack_with_flood_of_calls_does_not_affect_others(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.write_grant(passenger_grant())
    rig.start_service()
    stub = await served(rig)
    key, certificate = rig.authority.issue(PASSENGER)
    for name, data in (("key", key), ("crt", certificate), ("ca", rig.authority.pem)):
        (rig.directory / f"flood.{name}").write_bytes(data)
    attacker = await asyncio.create_subprocess_exec(
        sys.executable, __file__, rig.address, str(rig.directory / "flood"), "3.0", stdout=asyncio.subprocess.PIPE
    )
    latencies_s = []
    while attacker.returncode is None:
        begun = time.monotonic()
        await stub.GetSpeed(ASK, timeout=20)
        latencies_s.append(time.monotonic() - begun)
        await asyncio.sleep(0.05)
    output, _ = await attacker.communicate()
    result = json.loads(output)
    print(f"flood {result}; calls of the other caller {len(latencies_s)}, slowest {max(latencies_s) * 1000:.0f} ms")
    assert result["sent"] > FLOOD_PER_S
    ended = result["ended"]
    assert set(ended) <= {"OK", "RESOURCE_EXHAUSTED", "SHED"}
    assert sum(ended.values()) == result["sent"]
    assert 0 < ended["OK"] <= CALL_BURST + CALLS_PER_S * result["seconds"] + 1, (
        "the service answered more calls than its limit of each caller"
    )
    assert result["hints"] == ended["RESOURCE_EXHAUSTED"] > 0, "a refusal lacks the retry delay"
    assert len(latencies_s) > 10


async def test_attack_with_flood_of_connections_does_not_affect_others(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    stub = await served(rig)
    host, _, port = rig.address.partition(":")
    stranger = Authority(rig.directory, "stranger")
    key, certificate = stranger.issue(DRIVER)
    for name, data in (("key", key), ("crt", certificate)):
        (rig.directory / f"stranger.{name}").write_bytes(data)
    wrong = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    wrong.check_hostname = False
    wrong.verify_mode = ssl.CERT_NONE
    wrong.load_cert_chain(rig.directory / "stranger.crt", rig.directory / "stranger.key")
    silent: list[socket.socket] = []
    try:
        for n in range(300):
            silent.append(socket.create_connection((host, int(port)), timeout=5))
            if n % 10 == 0:
                silent[-1].sendall(b"GET / HTTP/1.1\r\n\r\n" * 50)
                await stub.GetSpeed(ASK, timeout=5)
        for _ in range(50):
            with socket.create_connection((host, int(port)), timeout=5) as raw:
                try:
                    with wrong.wrap_socket(raw, server_hostname=node_server_name(NODE)) as tls:
                        tls.recv(1)
                except OSError:
                    continue
        await stub.GetSpeed(ASK, timeout=5)
        await served(rig)
        await until(lambda: _closed(silent[-1]), "the service to close a connection that sends nothing", 20)
    finally:
        for connection in silent:
            connection.close()


async def test_attack_with_calls_without_request_is_limited(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    stub = await served(rig)

    async def nothing() -> AsyncIterator[bytes]:
        await asyncio.Event().wait()
        yield b""

    stranger = rig.channel(component_identity("default", "none", "Stranger", "none-stranger"))
    ask = stranger.stream_unary("/fractus.v1.MobilityService/GetSpeed")
    ended = await asyncio.wait_for(
        asyncio.gather(*(ask(nothing(), timeout=120) for _ in range(100)), return_exceptions=True), 60
    )
    codes = Counter(error.code() for error in ended if isinstance(error, grpc.aio.AioRpcError))
    assert codes == {Status.RESOURCE_EXHAUSTED: 100 - MAX_OPEN_CALLS, Status.INVALID_ARGUMENT: MAX_OPEN_CALLS}
    await stub.GetSpeed(ASK, timeout=5)


def _closed(connection: socket.socket) -> bool:
    connection.settimeout(0.01)
    try:
        return connection.recv(65536) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


# In flight


async def test_attack_with_older_grant_in_flight_returns_drone(rig: Rig) -> None:
    older = rig.authority.sign(grant())
    driver = await flying(rig, altitude_limit(5, 15))
    path = rig.grants / "app-navigator.json"
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps(older))
    fresh.replace(path)
    await driver.next(LOST, 15)
    await rig.until(lambda t: t.mode == "LAND" and t.controller == "system", 30)
    refused = [e for e in rig.entries("grant") if e["change"] == "refused"]
    assert "not after the Grant of" in refused[-1]["reason"]
    code, why = await denied(flown(driver.start_goto(0, 20)))
    assert (code, why.code) == (Status.PERMISSION_DENIED, "NoGrant")


async def test_full_disk_ends_no_flight_but_prevents_arming(rig: Rig) -> None:
    driver = await flying(rig)
    before = len(rig.entries())
    full = (0, resource.RLIM_INFINITY)
    resource.prlimit(rig.pid("service"), resource.RLIMIT_FSIZE, full)
    await driver.goto(0, 30)
    code, why = await denied(flown(driver.start_goto(0, 150)))
    assert (code, why.code) == (Status.PERMISSION_DENIED, "OutsideOperationArea"), "the full disk changed the verdict"
    await driver.stub.Hover(pb.HoverRequest(), timeout=5)
    await flown(driver.stub.Land(pb.LandRequest(), timeout=60))
    await rig.until(lambda t: not t.armed, 30, "landing")
    code, why = await denied(driver.arm())
    assert code == Status.FAILED_PRECONDITION
    assert why.code in {"AuditUnavailable", "JournalUnavailable"}
    assert why.reason
    resource.prlimit(rig.pid("service"), resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    await until(
        lambda: any(e.get("code") == "OutsideOperationArea" for e in rig.entries("call")),
        "the entry of the denied call in the audit log",
    )
    assert len(rig.entries()) > before
    with rig.audit.open("rb") as log:
        assert not verify(log).problem


if __name__ == "__main__":
    files = [Path(f"{sys.argv[2]}.{name}").read_bytes() for name in ("ca", "key", "crt")]
    asyncio.run(_flood(sys.argv[1], files, float(sys.argv[3])))
