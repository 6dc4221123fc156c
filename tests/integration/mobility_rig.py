"""Simulated vehicle, mobility service, camera service and certificates of a drone, for tests that fly."""

from __future__ import annotations

import asyncio
import datetime
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import grpc
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from fractus_cluster.ports import free_port
from fractus_core.api.names import OPERATOR_IDENTITY, component_identity, node_identity, node_server_name
from fractus_core.geo import LocalFrame
from fractus_core.policy.grant_signatures import DOCUMENT_SIGNING, sign
from fractus_proto.v1 import mobility_pb2 as pb
from fractus_proto.v1 import mobility_pb2_grpc, types_pb2
from grpc_status import rpc_status

HOME = (39.3600, 22.9500, 10.0)
FRAME = LocalFrame(HOME[0], HOME[1])
NODE = "drone-1"
DRIVER = component_identity("default", "app", "Navigator", "app-navigator")
PASSENGER = component_identity("default", "app", "AerialViewer", "app-aerial-viewer")


def area(x0: float, y0: float, x1: float, y1: float) -> dict[str, Any]:
    """Return a rectangle from offsets in metres east and north of home."""
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    return {"polygon": {"exterior": [dict(zip(("lat", "lon"), FRAME.latlon(x, y), strict=True)) for x, y in corners]}}


def fence(name: str, kind: str, action: str, *box: float, **band: float) -> dict[str, Any]:
    zone: dict[str, Any] = {"name": f"{name}-zone", "area": area(*box)}
    if band:
        zone["altitude"] = band
    spec = {"type": "GeofenceControl", "kind": kind, "action": action, "selector": {"zones": [f"{name}-zone"]}}
    return {"name": name, "spec": spec, "zones": [zone]}


def altitude_limit(lower: float, upper: float) -> dict[str, Any]:
    spec = {"type": "LimitControl", "kind": "altitude", "lowerLimit": lower, "upperLimit": upper, "action": "enforce"}
    return {"name": "altitudes", "spec": spec}


NAVIGATOR_MISSION = (
    "spiffe://fractus.dev/ns/default/app/app/component/Navigator/instance/app-navigator#uid-app-navigator"
)
VIEWER_MISSION = (
    "spiffe://fractus.dev/ns/default/app/app/component/AerialViewer/instance/app-aerial-viewer#uid-app-aerial-viewer"
)

ALL = [
    "Arm", "Disarm", "Takeoff", "Land", "SetSpeed", "GetSpeed", "SetVelocity", "Goto", "Hover", "GetPosition",
    "ReturnToLaunch", "PointGimbal",
]  # fmt: skip


def grant(*policies: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return a driver's Grant with policies. The operation area extends 100 m from home in each direction."""
    path = [dict(zip(("lat", "lon", "alt"), (*FRAME.latlon(x, y), 10.0), strict=True)) for x, y in ((0, 40), (40, 40))]
    spec = {
        "node": NODE,
        "application": {"namespace": "default", "name": "app", "uid": "u1"},
        "component": "Navigator",
        "instance": "app-navigator",
        "class": "driver",
        "control": "full",
        "controlPoints": [{"navigation": "pathBased", "path": path}],
        "services": [{"service": "mobility", "methods": ALL}],
        "operationArea": [area(-100, -100, 100, 100)],
        "home": {"lat": HOME[0], "lon": HOME[1], "alt": HOME[2], "altitudeReference": "amsl"},
        "limits": {"maxAltitude": 60, "maxSpeed": 12},
        "policies": list(policies),
    }
    spec.update(changes)
    metadata = {"name": spec["instance"], "uid": f"uid-{spec['instance']}"}
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": "Grant", "metadata": metadata, "spec": spec}


def passenger_grant(*policies: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return grant(
        *policies,
        **{
            "component": "AerialViewer",
            "instance": "app-aerial-viewer",
            "class": "passenger",
            "control": None,
            "controlPoints": [],
            **changes,
        },
    )


def outcomes(telemetry: pb.Telemetry) -> dict[str, str]:
    """Return the outcome of each mission as text."""
    kinds = {key: pb.MissionOutcome.Kind.Name(ended.kind) for key, ended in telemetry.missions.items()}
    words = {key: kind.removeprefix("KIND_").lower() for key, kind in kinds.items()}
    reasons = {key: ended.reason for key, ended in telemetry.missions.items()}
    return {key: f"{word}: {reasons[key]}" if reasons[key] else word for key, word in words.items()}


class Authority:
    """A certificate authority."""

    def __init__(self, directory: Path, name: str = "ca") -> None:
        self._directory = directory
        self._key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        now = datetime.datetime.now(datetime.UTC)
        self.certificate = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(subject)
            .public_key(self._key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
            .sign(self._key, hashes.SHA256())
        )
        self.pem = self.certificate.public_bytes(serialization.Encoding.PEM)
        self._signer: tuple[ec.EllipticCurvePrivateKey, x509.Certificate] | None = None
        self._issued = now

    def issue(
        self, identity: str, *, dns: str | None = None, seconds: float = 3600.0, begun: float = -60.0
    ) -> tuple[bytes, bytes]:
        """Return key and certificate in PEM."""
        key = ec.generate_private_key(ec.SECP256R1())
        now = datetime.datetime.now(datetime.UTC)
        names: list[x509.GeneralName] = [x509.UniformResourceIdentifier(identity)]
        if dns:
            names.append(x509.DNSName(dns))
        certificate = (
            x509.CertificateBuilder()
            .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "test")]))
            .issuer_name(self.certificate.subject)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now + datetime.timedelta(seconds=begun))
            .not_valid_after(now + datetime.timedelta(seconds=seconds))
            .add_extension(x509.SubjectAlternativeName(names), critical=False)
            .sign(self._key, hashes.SHA256())
        )
        pem = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        return pem, certificate.public_bytes(serialization.Encoding.PEM)

    def sign(self, body: dict[str, Any]) -> dict[str, Any]:
        """Sign a Grant like the operator, with a later time of issue than all Grants before."""
        if self._signer is None:
            self._signer = issue_signer(self.certificate, self._key)
        now = datetime.datetime.now(datetime.UTC)
        self._issued = max(now, self._issued + datetime.timedelta(microseconds=1))
        named = {**body, "spec": {"mission": body["metadata"]["uid"], **body["spec"]}}
        return sign(named, *self._signer, self._issued)


def issue_signer(
    authority: x509.Certificate, authority_key: ec.EllipticCurvePrivateKey, identity: str = OPERATOR_IDENTITY
) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
    """Return a key and a certificate for signing Grants."""
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.datetime.now(datetime.UTC)
    usage = dict.fromkeys(
        (
            "digital_signature", "key_encipherment", "data_encipherment", "key_agreement", "key_cert_sign", "crl_sign",
            "encipher_only", "decipher_only",
        ),
        False,
    )  # fmt: skip
    certificate = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "signer")]))
        .issuer_name(authority.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.KeyUsage(content_commitment=True, **usage), critical=True)
        .add_extension(x509.ExtendedKeyUsage([DOCUMENT_SIGNING]), critical=False)
        .add_extension(x509.SubjectAlternativeName([x509.UniformResourceIdentifier(identity)]), critical=False)
        .sign(authority_key, hashes.SHA256())
    )
    return key, certificate


class Rig:
    """Processes, certificates, Grants and logs of a drone, in one directory."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.grants = directory / "grants"
        self.tls = directory / "tls"
        self.audit = directory / "audit.jsonl"
        for folder in (self.grants, self.tls):
            folder.mkdir(parents=True)
        self.authority = Authority(directory)
        self.address = f"127.0.0.1:{free_port()}"
        self.link = f"tcp:127.0.0.1:{free_port()}"
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._channels: list[grpc.aio.Channel] = []
        self.write_tls()

    def write_tls(self, **validity: Any) -> None:
        key, certificate = self.authority.issue(node_identity(NODE), dns=node_server_name(NODE), **validity)
        for name, data in (("tls.key", key), ("tls.crt", certificate), ("ca.crt", self.authority.pem)):
            fresh = self.tls / f".{name}"
            fresh.write_bytes(data)
            fresh.replace(self.tls / name)

    def write_grant(self, body: dict[str, Any], signed: bool = True) -> Path:
        path = self.grants / f"{body['spec']['instance']}.json"
        fresh = path.with_suffix(".new")
        fresh.write_text(json.dumps(self.authority.sign(body) if signed else body))
        fresh.replace(path)
        return path

    def start_vehicle(self, speedup: float = 3.0, *more: str, home: tuple[float, float, float] = HOME) -> None:
        """Start the vehicle. It lands three times as fast as with ArduCopter's default, so that tests wait less."""
        place = ",".join(str(v) for v in home)
        self._start(
            "vehicle", "-m", "fractus_vehicle", "--listen", self.link, "--home", place, "--speedup", str(speedup),
            "--ready-after", "2", "--throttle", "1500", "--param", "LAND_SPEED=150", *more,
        )  # fmt: skip

    def start_service(self, *more: str, link: str = "", name: str = "service", knows_vehicle: bool = True) -> None:
        """Start the mobility service.

        Args:
            more: Additional arguments.
            link: URL of the autopilot. The default is the URL of the rig's vehicle.
            name: Name of the process and of its log.
            knows_vehicle: True if the service has identified its vehicle in an earlier run. Otherwise it observes the
                vehicle for three seconds before it accepts the vehicle.
        """
        known = self.directory / "state" / "vehicle.json"
        if knows_vehicle and not known.exists():
            known.parent.mkdir(exist_ok=True)
            known.write_text(json.dumps({"link": link or self.link, "system": 1, "component": 1}))
        self._start(
            name, "-m", "fractus_services.mobility", "serve", "--grants", str(self.grants), "--tls", str(self.tls),
            "--state", str(self.directory / "state"), "--audit", str(self.audit), "--node", NODE, "--autopilot", link or self.link,
            "--listen", self.address, "--description", str(self.directory / "none.yaml"), "--driver-grace", "3", *more,
        )  # fmt: skip

    def start(self, name: str, *arguments: str) -> None:
        """Start another Python program."""
        self._start(name, *arguments)

    def _start(self, name: str, *arguments: str) -> None:
        with (self.directory / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                [sys.executable, *arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "MALLOC_ARENA_MAX": "2"},
            )

    def start_camera(self, *more: str, description: str = "", name: str = "camera") -> str:
        """Start the camera service, and return its address."""
        address = f"127.0.0.1:{free_port()}"
        path = self.directory / "node.yaml"
        if description:
            path.write_text(description)
        self._start(
            name, "-m", "fractus_services.camera", "serve", "--grants", str(self.grants), "--tls", str(self.tls),
            "--state", str(self.directory / "pictures"), "--audit", str(self.directory / "camera.jsonl"), "--node", NODE,
            "--description", str(path), "--mobility", self.address, "--listen", address, *more,
        )  # fmt: skip
        return address

    def start_driver(self) -> None:
        """Start a driver process that takes off and hovers."""
        key, certificate = self.authority.issue(DRIVER)
        for name, data in (("key", key), ("crt", certificate), ("ca", self.authority.pem)):
            (self.directory / f"driver.{name}").write_bytes(data)
        self._start("driver", __file__, self.address, str(self.directory / "driver"))

    def send_signal(self, name: str, number: signal.Signals) -> None:
        self._processes[name].send_signal(number)

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        process = self._processes[name]
        process.send_signal(number)
        process.wait(10)

    async def ended(self, name: str, timeout_s: float = 20.0) -> int:
        """Wait for the end of a process, and return its exit code."""
        return await asyncio.to_thread(self._processes[name].wait, timeout_s)

    async def until_logged(self, name: str, text: str, timeout_s: float = 20.0) -> None:
        """Wait until a process logs a text."""
        async with asyncio.timeout(timeout_s):
            while text not in self.log(name):
                assert self._processes[name].poll() is None, self.log(name)
                await asyncio.sleep(0.05)

    def pid(self, name: str) -> int:
        return self._processes[name].pid

    def channel(
        self,
        identity: str,
        authority: Authority | None = None,
        address: str = "",
        options: tuple[tuple[str, Any], ...] = (),
        **validity: Any,
    ) -> grpc.aio.Channel:
        key, certificate = (authority or self.authority).issue(identity, **validity)
        credentials = grpc.ssl_channel_credentials(self.authority.pem, key, certificate)
        channel = grpc.aio.secure_channel(
            address or self.address,
            credentials,
            options=[
                ("grpc.ssl_target_name_override", node_server_name(NODE)),
                ("grpc.initial_reconnect_backoff_ms", 100),
                ("grpc.max_reconnect_backoff_ms", 300),
                ("grpc.use_local_subchannel_pool", 1),
                *options,
            ],
        )
        self._channels.append(channel)
        return channel

    def stub(self, identity: str = DRIVER, **options: Any) -> mobility_pb2_grpc.MobilityServiceStub:
        return mobility_pb2_grpc.MobilityServiceStub(self.channel(identity, **options))

    async def close(self) -> None:
        for channel in self._channels:
            await channel.close()
        for process in self._processes.values():
            if process.poll() is None:
                process.kill()
                process.wait(10)

    def entries(self, kind: str | None = None) -> list[dict[str, Any]]:
        lines = self.audit.read_text().splitlines() if self.audit.exists() else []
        entries = [json.loads(line) for line in lines if line.endswith("}")]
        return [entry for entry in entries if kind is None or entry["kind"] == kind]

    async def telemetry(self) -> pb.Telemetry:
        async for message in self.stub(node_identity(NODE)).SubscribeTelemetry(
            pb.SubscribeTelemetryRequest(), wait_for_ready=True, timeout=20
        ):
            return message
        raise AssertionError("the service sent no telemetry")

    async def until(
        self, condition: Callable[[pb.Telemetry], bool], timeout_s: float = 30.0, description: str = "state"
    ) -> pb.Telemetry:
        """Wait for a state of the drone, also across restarts of the service, and return its telemetry."""
        deadline = time.monotonic() + timeout_s
        last: Any = None
        stub = self.stub(node_identity(NODE))
        while time.monotonic() < deadline:
            try:
                async for last in stub.SubscribeTelemetry(
                    pb.SubscribeTelemetryRequest(interval_s=0.05),
                    wait_for_ready=True,
                    timeout=max(deadline - time.monotonic(), 0.1),
                ):
                    if condition(last):
                        return last
            except grpc.aio.AioRpcError:
                await asyncio.sleep(0.05)
        raise AssertionError(f"{description} was not reached in {timeout_s} s; last: {last}\n{self.log('service')}")

    def log(self, name: str) -> str:
        path = self.directory / f"{name}.log"
        return path.read_text()[-4000:] if path.exists() else ""


class Driver:
    """Control stream and calls of a driver."""

    def __init__(self, rig: Rig, identity: str = DRIVER) -> None:
        self.rig = rig
        self.channel = rig.channel(identity)
        self.stub = mobility_pb2_grpc.MobilityServiceStub(self.channel)
        self.events: list[pb.ControlEvent] = []
        self._stream: Any = None

    async def take(self, timeout_s: float = 30.0) -> pb.ControlEvent:
        self._stream = self.stub.GetControl(pb.GetControlRequest(), wait_for_ready=True)
        async with asyncio.timeout(timeout_s):
            return await self.next(pb.ControlEvent.STATE_GRANTED, timeout_s)

    async def next(self, state: int, timeout_s: float = 30.0) -> pb.ControlEvent:
        async with asyncio.timeout(timeout_s):
            while True:
                event = await self._stream.read()
                assert event is not grpc.aio.EOF, f"stream ended; events {self.events}"
                self.events.append(event)
                if event.state == state:
                    return event

    def drop(self) -> None:
        self._stream.cancel()

    async def arm(self) -> Any:
        return await self.stub.Arm(pb.ArmRequest(), timeout=10)

    async def take_off(self, altitude_m: float = 10.0) -> pb.MotionProgress:
        return await flown(self.stub.Takeoff(pb.TakeoffRequest(altitude_m=altitude_m), timeout=60))

    async def up(self, altitude_m: float = 10.0) -> pb.MotionProgress:
        await self.take()
        await self.arm()
        return await self.take_off(altitude_m)

    def start_goto(self, x: float, y: float, alt: float = 10.0, **more: Any) -> Any:
        """Call Goto, and return the call without waiting for the flight."""
        return self.stub.Goto(pb.GotoRequest(target=place(x, y, alt), **more), timeout=90)

    async def goto(self, x: float, y: float, alt: float = 10.0) -> pb.MotionProgress:
        return await flown(self.start_goto(x, y, alt))


def place(x: float, y: float, alt: float = 10.0) -> types_pb2.Position:
    lat, lon = FRAME.latlon(x, y)
    return types_pb2.Position(latitude_deg=lat, longitude_deg=lon, altitude_m=alt)


async def flown(call: Any) -> pb.MotionProgress:
    """Wait until a motion is complete. Return its first message, with the position of the last message."""
    first: Any = None
    last: Any = None
    async for last in call:
        first = first or last
    assert last is not None and last.complete
    first.position.CopyFrom(last.position)
    return first


async def denied(call: Awaitable[Any]) -> tuple[grpc.StatusCode, types_pb2.Decision]:
    """Return status and decision of a call that must fail."""
    try:
        reply = await call
    except grpc.aio.AioRpcError as error:
        status = rpc_status.from_call(error)
        decision = types_pb2.Decision()
        if status is not None:
            for detail in status.details:
                if detail.Is(types_pb2.Decision.DESCRIPTOR):
                    detail.Unpack(decision)
        return error.code(), decision
    raise AssertionError(f"the call was not refused: {reply}")


def xy(position: types_pb2.Position) -> tuple[float, float]:
    return FRAME.xy(position.latitude_deg, position.longitude_deg)


def _drive(address: str, files: str) -> None:
    """Run a driver that takes off and then hovers indefinitely."""
    ca, key, certificate = (Path(f"{files}.{name}").read_bytes() for name in ("ca", "key", "crt"))
    credentials = grpc.ssl_channel_credentials(ca, key, certificate)
    options = [("grpc.ssl_target_name_override", node_server_name(NODE))]
    with grpc.secure_channel(address, credentials, options) as channel:
        stub = mobility_pb2_grpc.MobilityServiceStub(channel)
        events = stub.GetControl(pb.GetControlRequest())
        for event in events:
            if event.state == pb.ControlEvent.STATE_GRANTED:
                stub.Arm(pb.ArmRequest(), timeout=10)
                list(stub.Takeoff(pb.TakeoffRequest(altitude_m=10)))


if __name__ == "__main__":
    _drive(sys.argv[1], sys.argv[2])
