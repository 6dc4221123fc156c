"""The client scripts of test_vehicle_clients.py fly unchanged through the gateway under a wide Grant, and so does a plan.

`tests/component/test_gateway_missions.py` is the faster form: missions and their refusals in virtual time.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from gateway_rig import ACCEPTED, GatewayRig, acknowledged, connected, guided, in_thread, wide_grant
from mobility_rig import Rig
from test_vehicle_clients import PLAN, item_lists
from vehicle_process import HOME

pytestmark = pytest.mark.slow

CLIENTS = Path(__file__).with_name("vehicle_clients")
PYTHON = os.environ.get("FRACTUS_CLIENTS_PYTHON", sys.executable)


@pytest.fixture
async def gateway(rig: Rig) -> AsyncIterator[GatewayRig]:
    created = GatewayRig(rig)
    yield created
    await created.close()


@pytest.mark.timeout(300)
@pytest.mark.parametrize("script", ["dronekit_flight.py", "mavsdk_flight.py", "mavproxy_flight.py"])
async def test_client_script_flies_through_the_gateway(script: str, gateway: GatewayRig, tmp_path: Path):
    # MAVProxy reports the mode GUIDED only if the mode changes: it requests GUIDED before it gets control.
    waits = script != "mavproxy_flight.py"
    gateway.start_services("--ready-after", "2" if waits else "30", home=HOME)
    gateway.rig.write_grant(wide_grant(HOME))
    address = await gateway.connect()
    if waits:
        await in_thread(_wait_for_control, address)
    if script.startswith("mavsdk"):
        address = address.replace("tcp:", "tcpout://")
    program = await asyncio.create_subprocess_exec(
        PYTHON, str(CLIENTS / script), address, str(tmp_path),
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    output, _ = await program.communicate()
    assert b"DONE" in output, output.decode()[-4000:]


def _wait_for_control(address: str) -> None:
    """Wait until a program would get control. The scripts have shorter timeouts than the start of a drone takes here."""
    client = connected(address)
    guided(client, 90.0)
    client.close()


def _fly_plan(address: str, plan: Path) -> None:
    client = connected(address)
    guided(client, 90.0)
    mav = client.link.mav
    for kind, items in item_lists(json.loads(plan.read_text())).items():
        mav.mission_count_send(1, 1, len(items), kind)
        for _ in items:
            request = client.wait(lambda m: m.get_type() in ("MISSION_REQUEST", "MISSION_REQUEST_INT"))
            command, frame, params, lat, lon, alt = items[request.seq]
            place = (round(lat * 1e7), round(lon * 1e7), alt)
            mav.mission_item_int_send(1, 1, request.seq, frame, command, 0, 1, *params, *place, kind)
        ack = client.wait_for("MISSION_ACK")
        assert (ack.type, ack.mission_type) == (0, kind), client.texts
    assert acknowledged(client, 207, 1) == ACCEPTED
    assert acknowledged(client, 400, 1) == ACCEPTED, client.texts
    assert acknowledged(client, 300) == ACCEPTED, client.texts
    client.wait(lambda m: m.get_type() == "MISSION_ITEM_REACHED" and m.seq == 3, 90.0)
    assert acknowledged(client, 20) == ACCEPTED
    client.wait(lambda m: m.get_type() == "HEARTBEAT" and not m.base_mode & 128, 90.0)
    client.close()


@pytest.mark.timeout(300)
async def test_qgroundcontrol_plan_is_flown_through_the_gateway(gateway: GatewayRig, tmp_path: Path):
    path = tmp_path / "survey.plan"
    path.write_text(json.dumps(PLAN))
    gateway.start_services(home=HOME)
    gateway.rig.write_grant(wide_grant(HOME))
    await in_thread(_fly_plan, await gateway.connect(), path)
