"""A pymavlink program flies through sidecar and gateway over mutual TLS, and the processes start and stop.

`tests/component/test_gateway_flights.py` contains the flights under policies and the failures, in virtual time.
"""

from __future__ import annotations

import asyncio
import math
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from gateway_rig import ACCEPTED, START_S, GatewayRig, acknowledged, connected, in_thread, mavlink_grant, up
from mobility_rig import FRAME, NODE, Rig

CLIENTS = Path(__file__).with_name("vehicle_clients")
CLIENTS_PYTHON = os.environ.get("FRACTUS_CLIENTS_PYTHON", sys.executable)
"""Interpreter that has DroneKit, see test_vehicle_clients.py."""


@pytest.fixture
async def gateway(rig: Rig) -> AsyncIterator[GatewayRig]:
    created = GatewayRig(rig)
    yield created
    await created.close()


def _fly_guided(address: str) -> None:
    client = connected(address)
    up(client)
    lat, lon = FRAME.latlon(0, 20)
    values = (round(lat * 1e7), round(lon * 1e7), 10.0, *[0.0] * 8)
    client.link.mav.set_position_target_global_int_send(0, 1, 1, 6, 0b110111111000, *values)

    def arrived(message: Any) -> bool:
        if message.get_type() != "GLOBAL_POSITION_INT":
            return False
        # A landing that begins before the leg ends would end the mission without a flown leg.
        stopped = math.hypot(message.vx, message.vy) < 10.0  # cm/s
        return stopped and FRAME.xy(message.lat / 1e7, message.lon / 1e7)[1] > 19.0

    client.wait(arrived, 40.0)
    assert acknowledged(client, 21) == ACCEPTED, client.texts
    client.wait(lambda m: m.get_type() == "HEARTBEAT" and not m.base_mode & 128, 60.0)
    client.close()


@pytest.mark.timeout(240)
async def test_pymavlink_program_flies_guided_over_tls(gateway: GatewayRig):
    gateway.start_services()
    gateway.rig.write_grant(mavlink_grant())
    await in_thread(_fly_guided, await gateway.connect())
    state = await gateway.rig.until(lambda t: bool(t.missions), description="end of the mission")
    assert [outcome.kind for outcome in state.missions.values()] == [1], state.missions


@pytest.mark.slow
@pytest.mark.timeout(300)
async def test_dronekit_program_flies_guided(gateway: GatewayRig):
    """Slow: `test_pymavlink_program_flies_guided_over_tls` tests the same with a smaller client."""
    gateway.start_services()
    gateway.rig.write_grant(mavlink_grant())
    program = await asyncio.create_subprocess_exec(
        CLIENTS_PYTHON, str(CLIENTS / "dronekit_guided.py"), await gateway.connect(),
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    output, _ = await program.communicate()
    assert b"DONE" in output, output.decode()[-4000:]


@pytest.mark.timeout(150)
async def test_gateway_and_sidecar_processes_serve_until_stopped(rig: Rig, gateway: GatewayRig):
    directory = rig.directory
    rig.start(
        "gateway", "-m", "fractus_cli", "gateway", "serve", "--tls", str(rig.tls), "--listen", gateway.address,
        "--mobility-socket", str(gateway.socket), "--state", str(directory / "gateway"), "--audit", str(gateway.audit),
    )  # fmt: skip
    rig.start(
        "sidecar", "-m", "fractus_cli", "gateway", "connect", "--gateway", gateway.address, "--node", NODE,
        "--tls", str(gateway.write_identity()), "--tcp", str(gateway.port), "--udp", str(gateway.port + 1),
    )  # fmt: skip
    await rig.until_logged("gateway", "program connected (instance=spiffe://fractus.dev/ns/default/app/app", START_S)
    for name in ("sidecar", "gateway"):
        rig.send_signal(name, signal.SIGTERM)
        assert await rig.ended(name) == 0, rig.log(name)
