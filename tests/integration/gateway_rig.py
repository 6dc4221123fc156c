"""The MAVLink gateway and its sidecar beside the services of a drone, and clients that connect to the sidecar."""

from __future__ import annotations

import asyncio
import sys
import time
from pathlib import Path
from typing import Any

from fractus_cluster.ports import free_port
from fractus_core.geo import LocalFrame
from fractus_services.gateway import gateway_server, sidecar
from fractus_services.gateway.gateway_server import GatewayOptions
from fractus_services.gateway.sidecar import SidecarOptions
from mobility_rig import ALL, DRIVER, FRAME, HOME, NODE, Rig, grant
from vehicle_process import Client

ACCEPTED = 0
IN_PROGRESS = 5
GUIDED = 4

START_S = 60.0
"""Maximum time until a process has started on a busy machine."""


def mavlink_grant(*policies: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return a driver's Grant that permits MAVLink."""
    services = [{"service": "mobility", "methods": ALL, "interfaces": ["mavlink"]}]
    return grant(*policies, **{"services": services, **changes})


def wide_grant(home: tuple[float, float, float]) -> dict[str, Any]:
    """Return a driver's Grant that permits MAVLink within 1 km of a home."""
    frame = LocalFrame(home[0], home[1])

    def place(x: float, y: float) -> dict[str, float]:
        return dict(zip(("lat", "lon"), frame.latlon(x, y), strict=True))

    corners = [place(x, y) for x, y in ((-1000, -1000), (1000, -1000), (1000, 1000), (-1000, 1000))]
    return mavlink_grant(
        controlPoints=[{"navigation": "pathBased", "path": [{**place(0, 40), "alt": 10.0}]}],
        operationArea=[{"polygon": {"exterior": corners}}],
        home={"lat": home[0], "lon": home[1], "alt": home[2], "altitudeReference": "amsl"},
    )


class GatewayRig:
    """A drone with a gateway. Gateway and sidecar run in this process, because processes start slowly."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.socket = rig.directory / "gateway.sock"
        self.audit = rig.directory / "gateway.jsonl"
        self.address = f"127.0.0.1:{free_port()}"
        self.port = free_port()
        self._stop_gateway = asyncio.Event()
        self._stop_sidecar = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []

    def start_services(self, *more: str, home: tuple[float, float, float] = HOME) -> None:
        """Start vehicle and mobility service.

        Args:
            more: Additional arguments of the vehicle.
            home: Latitude, longitude and altitude of the vehicle.
        """
        self.rig.start_vehicle(1.0, *more, home=home)
        self.rig.start_service("--gateway-socket", str(self.socket))

    def start_processes(self, *more: str) -> None:
        """Start gateway and sidecar as processes, which a test may kill.

        Args:
            more: Arguments of a program that starts too, and gets the address of the sidecar.
        """
        rig = self.rig
        rig.start(
            "gateway", "-m", "fractus_cli", "gateway", "serve", "--tls", str(rig.tls), "--listen", self.address,
            "--mobility-socket", str(self.socket), "--state", str(rig.directory / "gateway"), "--audit", str(self.audit),
        )  # fmt: skip
        rig.start(
            "sidecar", "-m", "fractus_cli", "gateway", "connect", "--gateway", self.address, "--node", NODE,
            "--tls", str(self.write_identity()), "--tcp", str(self.port), "--udp", str(self.port + 1),
        )  # fmt: skip
        if more:
            rig.start("program", *more, f"tcp:127.0.0.1:{self.port}")

    def write_identity(self, identity: str = DRIVER) -> Path:
        """Write the certificate of an instance, and return its directory."""
        directory = self.rig.directory / "instance-tls"
        directory.mkdir(exist_ok=True)
        key, certificate = self.rig.authority.issue(identity)
        for file, data in (("tls.key", key), ("tls.crt", certificate), ("ca.crt", self.rig.authority.pem)):
            (directory / file).write_bytes(data)
        return directory

    async def connect(self) -> str:
        """Wait for the mobility service, start gateway and sidecar, and return the address for a program."""
        gateway = GatewayOptions(
            tls=self.rig.tls,
            mobility=self.socket,
            listen=self.address,
            state=self.rig.directory / "gateway",
            audit=self.audit,
            lock_timeout=1.0,
        )
        program = SidecarOptions(
            gateway=self.address, node=NODE, tls=self.write_identity(), tcp=self.port, udp=(free_port(),)
        )
        await self.rig.until_logged("service", "gateway: serving", START_S)
        self._tasks = [
            asyncio.create_task(gateway_server.run(gateway, self._stop_gateway)),
            asyncio.create_task(sidecar.run(program, self._stop_sidecar)),
        ]
        return f"tcp:127.0.0.1:{self.port}"

    async def close(self) -> None:
        """Stop gateway and sidecar."""
        self._stop_sidecar.set()
        self._stop_gateway.set()
        await asyncio.gather(*self._tasks)


def connected(address: str, timeout_s: float = 30.0) -> Client:
    """Connect a client, and wait until it receives heartbeats."""
    end = time.monotonic() + timeout_s
    while True:
        try:
            client = Client(address)
            client.wait_for("HEARTBEAT", 5.0)
        except (OSError, TimeoutError):
            if time.monotonic() > end:
                raise
            time.sleep(0.2)
        else:
            return client


def guided(client: Client, timeout_s: float = 40.0) -> None:
    """Wait until the program has control."""
    client.wait(lambda m: m.get_type() == "HEARTBEAT" and m.custom_mode == GUIDED, timeout_s)


def acknowledged(client: Client, number: int, *params: float, timeout_s: float = 30.0) -> int:
    """Send a COMMAND_LONG, and return its final result."""
    values = [*params, *[0.0] * (7 - len(params))]
    client.link.mav.command_long_send(1, 1, number, 0, *values)
    final = client.wait(
        lambda m: m.get_type() == "COMMAND_ACK" and m.command == number and m.result != IN_PROGRESS, timeout_s
    )
    return int(final.result)


def up(client: Client, altitude_m: float = 10.0) -> None:
    """Arm and take off."""
    guided(client)
    assert acknowledged(client, 400, 1) == ACCEPTED, client.texts
    assert acknowledged(client, 22, 0, 0, 0, 0, 0, 0, altitude_m) == ACCEPTED, client.texts
    client.interval(33, 10)
    client.wait(lambda m: m.get_type() == "GLOBAL_POSITION_INT" and m.relative_alt > 930 * altitude_m, 30.0)


async def in_thread(function: Any, *arguments: Any) -> Any:
    """Run a blocking client in a thread."""
    return await asyncio.to_thread(function, *arguments)


def patrol(address: str) -> None:
    """Take off, and fly between two targets until the process is killed."""
    client = connected(address, START_S)
    up(client)
    side_m = 30.0
    while True:
        lat, lon = FRAME.latlon(0, side_m)
        side_m = -side_m
        values = (round(lat * 1e7), round(lon * 1e7), 10.0, *[0.0] * 8)
        client.link.mav.set_position_target_global_int_send(0, 1, 1, 6, 0b110111111000, *values)
        end = time.monotonic() + 6.0
        while time.monotonic() < end:
            client.link.mav.heartbeat_send(6, 8, 0, 0, 0)
            client.link.recv_match(blocking=True, timeout=0.5)


if __name__ == "__main__":
    patrol(sys.argv[1])
