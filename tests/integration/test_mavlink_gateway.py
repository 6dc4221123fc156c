"""A pymavlink program flies through sidecar and gateway over mutual TLS, and the processes start and stop.

`tests/component/test_gateway_flights.py` contains the flights under policies and the failures, in virtual time.
"""

from __future__ import annotations

import asyncio
import math
import os
import random
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import gateway_rig
import pytest
from depth import cells
from gateway_rig import ACCEPTED, START_S, GatewayRig, acknowledged, connected, in_thread, mavlink_grant, up
from mobility_rig import FRAME, Rig, xy

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
    gateway.start_processes()
    await rig.until_logged("gateway", "program connected (instance=spiffe://fractus.dev/ns/default/app/app", START_S)
    for name in ("sidecar", "gateway"):
        rig.send_signal(name, signal.SIGTERM)
        assert await rig.ended(name) == 0, rig.log(name)


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize("seed", cells(range(30), quick=[0, 1, 2]))
async def test_drone_stops_and_comes_home_after_a_kill(rig: Rig, gateway: GatewayRig, seed: int):
    """Kill gateway, sidecar or program at a random moment of a flight.

    `test_program_that_dies_in_flight_is_brought_home` and `test_silent_program_loses_control_and_the_drone_returns` are faster forms.
    """
    victim = ("gateway", "sidecar", "program")[seed % 3]
    gateway.start_services()
    rig.write_grant(mavlink_grant())
    await rig.until_logged("service", "gateway: serving", 2 * START_S)
    gateway.start_processes(gateway_rig.__file__)
    await rig.until(lambda t: t.in_air, 120, "takeoff")
    await asyncio.sleep(random.Random(seed).uniform(0.0, 25.0))
    rig.kill(victim)
    hover = await rig.until(lambda t: t.controller == "system", 30, "takeover")
    assert hover.in_air
    landed = await rig.until(lambda t: not t.armed, 150, "landing")
    assert math.hypot(*xy(landed.position)) < 3.0
