"""The gateway beside the complete mobility service on the simulated vehicle, in virtual time.

The program's connection is a Unix socket without TLS. Everything behind TLS is the real code.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from closed_loop import Account, Drone, Sky
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from fractus_core.api.grants import GrantSpec
from fractus_runtime.mavlink_codec import Endpoint, Message, Parser, message
from fractus_services.auth import Callers
from fractus_services.gateway.decisions import DECISIONS
from fractus_services.gateway.gateway_server import Gateway, GatewayOptions, open_recorder
from fractus_services.mobility.rpc.gateway_socket import GatewaySocket
from fractus_services.mobility.rpc.handlers import MobilityHandlers
from mobility_world import ALL, FRAME, spec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
GUIDED = mavlink.COPTER_MODE_GUIDED


def mavlink_spec(*policies: dict[str, Any], interfaces: tuple[str, ...] = ("mavlink",), **changes: Any) -> GrantSpec:
    """Return a driver's grant for calls over MAVLink."""
    services = [{"service": "mobility", "methods": list(ALL), "interfaces": list(interfaces)}]
    return spec(*policies, **{"services": services, **changes})


def certificate(identity: str) -> bytes:
    """Return a certificate of an instance in PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "test")])
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.UniformResourceIdentifier(identity)]), critical=False)
        .sign(key, hashes.SHA256())
        .public_bytes(serialization.Encoding.PEM)
    )


def item(command: int, *params: float, altitude_m: float = 0.0, frame: int = 3) -> dict[str, Any]:
    """Return the fields of a mission item without a place."""
    values = {f"param{at}": value for at, value in enumerate(params, 1)}
    return {"command": command, "frame": frame, "z": altitude_m, "autocontinue": 1, **values}


def waypoint(x: float, y: float, altitude_m: float = 10.0, *, frame: int = 3, command: int = 16) -> dict[str, Any]:
    """Return the fields of a mission item at a place, in metres east and north of home."""
    lat, lon = FRAME.latlon(x, y)
    return {**item(command, altitude_m=altitude_m, frame=frame), "x": round(lat * 1e7), "y": round(lon * 1e7)}


class Program:
    """A MAVLink program with its connection to the gateway."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer
        self.endpoint = Endpoint(255, 190)
        self.received: list[Message] = []
        self.latest: dict[str, Message] = {}
        self.beats = True
        """True while the program sends heartbeats."""
        self._parser = Parser()
        self._tasks = [asyncio.ensure_future(self._read()), asyncio.ensure_future(self._beat())]

    async def _read(self) -> None:
        while data := await self.reader.read(4096):
            for received in self._parser.feed(data):
                self.received.append(received)
                self.latest[received.name] = received

    async def _beat(self) -> None:
        while True:
            if self.beats:
                self.send("HEARTBEAT", type=6, autopilot=8)
            await asyncio.sleep(1.0)

    def send(self, name: str, **values: Any) -> None:
        """Send a message to the vehicle."""
        address = {"target_system": 1, "target_component": 1}
        known = message(name).values
        self.writer.write(self.endpoint.encode(name, {k: v for k, v in address.items() if k in known} | values))

    async def until(self, condition: Callable[[], object], timeout_s: float = 60.0) -> None:
        """Wait for a condition."""
        try:
            async with asyncio.timeout(timeout_s):
                while not condition():  # noqa: ASYNC110 - the program has no notification
                    await asyncio.sleep(0.05)
        except TimeoutError:
            raise AssertionError(f"timeout; texts: {self.texts}") from None

    async def command(self, number: int, *params: float, timeout_s: float = 60.0) -> int:
        """Send a COMMAND_LONG, and return its final result."""
        begun = len(self.received)
        self.send("COMMAND_LONG", command=number, **{f"param{at}": value for at, value in enumerate(params, 1)})

        def results() -> list[int]:
            acks = [m for m in self.received[begun:] if m.name == "COMMAND_ACK" and m.integer("command") == number]
            return [m.integer("result") for m in acks if m.integer("result") != mavlink.MAV_RESULT_IN_PROGRESS]

        await self.until(results, timeout_s)
        return results()[0]

    def target(self, x: float, y: float, altitude_m: float = 10.0) -> None:
        """Send a position target in metres east and north of home."""
        lat, lon = FRAME.latlon(x, y)
        self.send(
            "SET_POSITION_TARGET_GLOBAL_INT", coordinate_frame=6, type_mask=0b110111111000,
            lat_int=round(lat * 1e7), lon_int=round(lon * 1e7), alt=altitude_m,
        )  # fmt: skip

    async def up(self, altitude_m: float = 10.0) -> None:
        """Arm and take off."""
        await self.until(lambda: self.mode == GUIDED)
        assert await self.command(400, 1) == ACCEPTED, self.texts
        assert await self.command(22, 0, 0, 0, 0, 0, 0, altitude_m) == ACCEPTED, self.texts
        assert await self.command(511, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 100_000) == ACCEPTED
        await self.until(lambda: self.place[2] > altitude_m - 0.7)

    async def upload(self, *items: dict[str, Any], kind: int = 0, timeout_s: float = 60.0) -> int:
        """Upload a list, and return the MAV_MISSION_RESULT. A mission gets home as item 0."""
        rows = list(items) if kind else [waypoint(0, 0, 0, frame=0), *items]
        begun = len(self.received)
        self.send("MISSION_COUNT", count=len(rows), mission_type=kind)
        sent = 0

        def acknowledged() -> list[int]:
            nonlocal sent
            news = [m for m in self.received[begun:] if m.name in {"MISSION_REQUEST", "MISSION_ACK"}]
            for request in [m for m in news if m.name == "MISSION_REQUEST"][sent:]:
                sent += 1
                number = request.integer("seq")
                self.send("MISSION_ITEM_INT", seq=number, mission_type=kind, **rows[number])
            return [m.integer("type") for m in news if m.name == "MISSION_ACK"]

        await self.until(acknowledged, timeout_s)
        return acknowledged()[0]

    async def download(self, kind: int = 0) -> list[Message]:
        """Return the stored items of a list."""
        begun = len(self.received)

        def arrived(name: str) -> list[Message]:
            return [m for m in self.received[begun:] if m.name == name]

        self.send("MISSION_REQUEST_LIST", mission_type=kind)
        await self.until(lambda: arrived("MISSION_COUNT"))
        count = arrived("MISSION_COUNT")[0].integer("count")
        for number in range(count):
            self.send("MISSION_REQUEST_INT", seq=number, mission_type=kind)
            await self.until(lambda number=number: len(arrived("MISSION_ITEM_INT")) > number)  # type: ignore[misc]
        return arrived("MISSION_ITEM_INT")

    @property
    def reached(self) -> list[int]:
        """Numbers of the completed mission items."""
        return [m.integer("seq") for m in self.received if m.name == "MISSION_ITEM_REACHED"]

    @property
    def mode(self) -> int:
        return self.latest["HEARTBEAT"].integer("custom_mode") if "HEARTBEAT" in self.latest else -1

    @property
    def armed(self) -> bool:
        return bool(self.latest["HEARTBEAT"].integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def place(self) -> tuple[float, float, float]:
        """Metres east, north and above home."""
        position = self.latest.get("GLOBAL_POSITION_INT")
        if position is None:
            return 0.0, 0.0, 0.0
        x, y = FRAME.xy(position.integer("lat") / 1e7, position.integer("lon") / 1e7)
        return x, y, position.integer("relative_alt") / 1e3

    @property
    def texts(self) -> str:
        return "".join(m.text("text") for m in self.received if m.name == "STATUSTEXT")

    async def close(self) -> None:
        """End the program."""
        for task in self._tasks:
            task.cancel()
        self.writer.close()
        await asyncio.gather(*self._tasks, return_exceptions=True)


class GatewayWorld:
    """Drone, mobility service, gateway and programs."""

    def __init__(self, sky: Sky, directory: Path) -> None:
        self.sky = sky
        self.drone = Drone(directory, Account(0))
        self.refused: list[dict[str, Any]] = []
        drone = self.drone
        handlers = MobilityHandlers(
            drone.service, drone.control, drone.streams, grants=drone.grants, node="drone-1",  # type: ignore[arg-type]
            clock=time.time, interface="mavlink",  # type: ignore[arg-type]
        )  # fmt: skip
        audit = SimpleNamespace(
            append=lambda _kind, content: self.refused.append(content),
            head=SimpleNamespace(sequence=0, hash="0" * 64), waiting=0, failure=None,
        )  # fmt: skip
        path = directory / "gateway.sock"
        self.socket = GatewaySocket(path, handlers, drone.autopilot, DECISIONS.delivered)
        self.recordings = directory / "recordings"
        options = GatewayOptions(
            tls=directory, mobility=path, listen="", state=directory, audit=directory, lock_timeout=0.0,
            recordings=self.recordings, recordings_mb=10,
        )  # fmt: skip
        record = partial(open_recorder, options)
        missions = directory / "missions"
        callers = Callers(time.time)
        self.gateway = Gateway(path, callers, audit, record, missions=missions, expiry=time.time)  # type: ignore[arg-type]
        self._programs = directory / "programs.sock"
        self._certificates: dict[str, bytes] = {}
        self._count = 0

    async def program(self, identity: str) -> Program:
        """Connect a program of an instance."""
        pem = self._certificates.setdefault(identity, certificate(identity))
        self._count += 1
        path = self._programs.with_suffix(f".{self._count}")

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await self.gateway.serve_instance(identity, pem, reader, writer)

        server = await asyncio.start_unix_server(serve, path)
        program = Program(*await asyncio.open_unix_connection(path))
        await asyncio.sleep(0.1)
        server.close()
        return program

    def tap(self) -> set[tuple[int, int]]:
        """Return a set that collects the senders (system and component id) of all frames that the vehicle receives from now on."""
        senders: set[tuple[int, int]] = set()
        parser = Parser()
        receive = self.sky.craft.receive

        def tapped(channel: Any, data: bytes) -> None:
            senders.update((m.sysid, m.compid) for m in parser.feed(data))
            receive(channel, data)

        self.sky.craft.receive = tapped  # type: ignore[method-assign]
        return senders


@contextlib.asynccontextmanager
async def flying(sky: Sky, directory: Path) -> AsyncIterator[GatewayWorld]:
    """Run a world until the end of the block."""
    world = GatewayWorld(sky, directory)
    tasks = [asyncio.ensure_future(sky.run_vehicle()), asyncio.ensure_future(world.socket.run())]
    try:
        yield world
    finally:
        await world.gateway.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await world.drone.close()


Flight = Callable[[GatewayWorld], Awaitable[None]]
