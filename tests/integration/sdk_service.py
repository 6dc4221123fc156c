"""Fake mobility and camera services on gRPC servers with mutual TLS, for tests of the SDK."""

from __future__ import annotations

import asyncio
import datetime as dt
from pathlib import Path

import grpc
import grpc.aio
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc, mobility_pb2, mobility_pb2_grpc, types_pb2
from google.protobuf import any_pb2
from google.rpc import code_pb2, status_pb2
from grpc_status import rpc_status

NAVIGATOR = "spiffe://fractus.dev/ns/default/app/traffic/component/Navigator/instance/traffic-navigator"
Event = mobility_pb2.ControlEvent


class Authority:
    """A certificate authority with a new key."""

    def __init__(self) -> None:
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "fractus test")])
        self.certificate = (
            self._builder(self.name, self.key.public_key())
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .sign(self.key, hashes.SHA256())
        )

    def issue(self, folder: Path, names: list[x509.GeneralName]) -> Path:
        """Write tls.crt, tls.key and ca.crt to a folder. Each file is replaced atomically."""
        folder.mkdir(parents=True, exist_ok=True)
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = (
            self._builder(x509.Name([]), key.public_key())
            .add_extension(x509.SubjectAlternativeName(names), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]), False
            )
            .sign(self.key, hashes.SHA256())
        )
        pem = serialization.Encoding.PEM
        files = {
            "tls.key": key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()),
            "tls.crt": certificate.public_bytes(pem),
            "ca.crt": self.certificate.public_bytes(pem),
        }
        for name, content in files.items():
            fresh = folder / f".{name}"
            fresh.write_bytes(content)
            fresh.replace(folder / name)
        return folder

    def _builder(self, subject: x509.Name, key: ec.EllipticCurvePublicKey) -> x509.CertificateBuilder:
        now = dt.datetime.now(dt.UTC)
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self.name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - dt.timedelta(minutes=1))
            .not_valid_after(now + dt.timedelta(hours=1))
        )


EXPIRED = Event()
"""Item for the queue of a control stream. The stream then ends, because the client's certificate has expired."""


class Drone(mobility_pb2_grpc.MobilityServiceServicer):
    """Fake mobility service without physics. A motion is complete after three messages, or when `release` is set.

    Altitudes above 60 m are corrected. Targets north of 40.01 degrees are refused.
    """

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.identities: list[str] = []
        self.certificates: set[bytes] = set()
        self.targets: list[types_pb2.Position] = []
        self.deadlines: list[float | None] = []
        self.control: asyncio.Queue[Event] = asyncio.Queue()
        self.expired = asyncio.Event()
        self.stream_open = asyncio.Event()
        self.stream_closed = asyncio.Event()
        self.moving = asyncio.Event()
        self.hovering = asyncio.Event()
        self.release: asyncio.Event | None = None
        self.refuse_control: tuple[grpc.StatusCode, str] | None = None
        self.waypoints_reached = 0
        self.interruptions = 0

    def _record(self, method: str, context: grpc.aio.ServicerContext) -> None:
        self.calls.append(method)
        auth = context.auth_context()
        self.identities.append(auth["x509_subject_alternative_name"][0].decode())
        self.certificates.add(auth["x509_pem_cert"][0])
        self.deadlines.append(context.time_remaining())

    async def GetControl(self, request, context):  # noqa: N802
        self._record("GetControl", context)
        if self.refuse_control:
            await context.abort(*self.refuse_control)
        self.stream_closed.clear()
        try:
            yield Event(state=Event.STATE_WAITING, reason="the autopilot is not ready to arm: it has no home yet")
            path = [
                types_pb2.Position(latitude_deg=40.0, longitude_deg=22.0 + i / 1000, altitude_m=20) for i in range(3)
            ]
            task = types_pb2.ControlPoint(navigation="pathBased", path=path)
            yield Event(state=Event.STATE_GRANTED, waypoints_reached=self.waypoints_reached, task=task)
            self.stream_open.set()
            while True:
                event = await self.control.get()
                if event is EXPIRED:
                    await _expired(context)
                yield event
                if event.state in {Event.STATE_LOST, Event.STATE_COMPLETE}:
                    return
        finally:
            self.stream_open.clear()
            self.stream_closed.set()

    async def SubscribeTelemetry(self, request, context):  # noqa: N802
        self._record("SubscribeTelemetry", context)
        yield mobility_pb2.Telemetry(battery_remaining=0.5)
        await self.expired.wait()
        await _expired(context)

    async def ReturnControl(self, request, context):  # noqa: N802
        self._record("ReturnControl", context)
        self.control.put_nowait(Event(state=Event.STATE_COMPLETE))
        return mobility_pb2.ReturnControlResponse(mission_complete=True)

    async def ReportProgress(self, request, context):  # noqa: N802
        self._record("ReportProgress", context)
        self.waypoints_reached = request.waypoints
        return mobility_pb2.ReportProgressResponse()

    async def Arm(self, request, context):  # noqa: N802
        self._record("Arm", context)
        return mobility_pb2.ArmResponse(decision=types_pb2.Decision(action=types_pb2.Decision.ACTION_ALLOW))

    async def SetSpeed(self, request, context):  # noqa: N802
        self._record("SetSpeed", context)
        speed = min(request.speed_mps, 10.0)
        return mobility_pb2.SetSpeedResponse(decision=_decision(speed != request.speed_mps), speed_mps=speed)

    async def GetPosition(self, request, context):  # noqa: N802
        self._record("GetPosition", context)
        return mobility_pb2.GetPositionResponse(
            position=types_pb2.Position(latitude_deg=40.0, longitude_deg=22.0, altitude_m=5.0),
            velocity=types_pb2.Velocity(north_mps=1.0),
        )

    async def Goto(self, request, context):  # noqa: N802
        self._record("Goto", context)
        if request.target.latitude_deg > 40.01:
            await _refuse(context)
        if self.interruptions:
            self.interruptions -= 1
            await context.abort(grpc.StatusCode.ABORTED, "a zone appeared ahead")
        target = types_pb2.Position()
        target.CopyFrom(request.target)
        target.altitude_m = min(target.altitude_m, 60.0)
        self.targets.append(target)
        try:
            yield mobility_pb2.MotionProgress(
                decision=_decision(target.altitude_m != request.target.altitude_m), target=target, distance_m=2.0
            )
            self.moving.set()
            if self.release is not None:
                await self.release.wait()
            yield mobility_pb2.MotionProgress(distance_m=1.0)
            yield mobility_pb2.MotionProgress(position=target, complete=True)
        except asyncio.CancelledError:
            self.hovering.set()
            raise


class Pictures(camera_pb2_grpc.CameraServiceServicer):
    """Fake camera service. Each picture has 600 kB.

    Attributes:
        cut: If True, the transfer of a picture ends too early.
        stored: Names of the pictures that were not deleted.
    """

    picture = bytes(range(256)) * 2400
    cut = False

    def __init__(self) -> None:
        self.stored: list[str] = []

    async def CaptureImage(self, request, context):  # noqa: N802
        self.stored.append("1.jpg")
        info = camera_pb2.ImageInfo(name="1.jpg", width=request.width or 640, size_bytes=len(self.picture))
        return camera_pb2.CaptureImageResponse(decision=_decision(False), image=info)

    async def RetrieveImage(self, request, context):  # noqa: N802
        if request.name != "1.jpg":
            await context.abort(grpc.StatusCode.NOT_FOUND, f"there is no picture {request.name}")
        size = len(self.picture)
        chunk = 256 * 1024
        for start in range(0, size - (chunk if self.cut else 0), chunk):
            yield camera_pb2.ImageChunk(
                image=camera_pb2.ImageInfo(size_bytes=size), data=self.picture[start : start + chunk]
            )

    async def DeleteImage(self, request, context):  # noqa: N802
        self.stored.remove(request.name)
        return camera_pb2.DeleteImageResponse(decision=_decision(False))


class Server:
    """A gRPC server that can be stopped and started again on the same port, like a service that restarts."""

    def __init__(self, drone: Drone, pictures: Pictures, tls: Path) -> None:
        self._drone = drone
        self._pictures = pictures
        self._tls = tls
        self._server: grpc.aio.Server | None = None
        self.port = 0

    async def start(self) -> None:
        ca, key, chain = ((self._tls / name).read_bytes() for name in ("ca.crt", "tls.key", "tls.crt"))
        self._server = grpc.aio.server()
        mobility_pb2_grpc.add_MobilityServiceServicer_to_server(self._drone, self._server)
        camera_pb2_grpc.add_CameraServiceServicer_to_server(self._pictures, self._server)
        credentials = grpc.ssl_server_credentials([(key, chain)], ca, require_client_auth=True)
        self.port = self._server.add_secure_port(f"127.0.0.1:{self.port}", credentials)
        await self._server.start()

    async def stop(self) -> None:
        assert self._server is not None
        await self._server.stop(grace=None)


def _decision(corrected: bool) -> types_pb2.Decision:
    if not corrected:
        return types_pb2.Decision(action=types_pb2.Decision.ACTION_ALLOW)
    return types_pb2.Decision(
        action=types_pb2.Decision.ACTION_CORRECT, code="AboveLimit", reason="above the limit", policies=["limit"]
    )


async def _expired(context: grpc.aio.ServicerContext) -> None:
    await context.abort(grpc.StatusCode.UNAUTHENTICATED, "the certificate is no longer valid")


async def _refuse(context: grpc.aio.ServicerContext) -> None:
    detail = any_pb2.Any()
    detail.Pack(
        types_pb2.Decision(
            action=types_pb2.Decision.ACTION_DENY,
            code="InsideExclusionZone",
            reason="the target is inside the exclusion zone hospital",
            policies=["no-fly-hospital"],
        )
    )
    status = status_pb2.Status(code=code_pb2.PERMISSION_DENIED, message="denied", details=[detail])
    await context.abort_with_status(rpc_status.to_status(status))
