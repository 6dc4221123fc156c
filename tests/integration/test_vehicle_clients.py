"""Third-party clients fly the simulated vehicle: MAVProxy, DroneKit and MAVSDK. Also fly plans of QGroundControl.

The clients are development dependencies. FRACTUS_CLIENTS_PYTHON selects another interpreter that has these packages.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fractus_cluster.ports import free_port
from vehicle_process import HOME, Client, running_vehicle

pytestmark = pytest.mark.slow

SESSIONS = Path(__file__).with_name("vehicle_clients")
PYTHON = os.environ.get("FRACTUS_CLIENTS_PYTHON", sys.executable)


def _fly(script: str, address: str, tmp_path: Path, *arguments: str) -> str:
    port = free_port()
    with running_vehicle("--ready-after", "4", "--speedup", "5", *arguments, links=(f"tcp:127.0.0.1:{port}",)):
        result = subprocess.run(
            [PYTHON, str(SESSIONS / script), address.format(port=port), str(tmp_path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            timeout=170,
            check=False,
        )
    assert "DONE" in result.stdout, result.stdout[-4000:]
    return result.stdout


@pytest.mark.timeout(200)
def test_dronekit_client_flies_vehicle(tmp_path: Path):
    _fly("dronekit_flight.py", "tcp:127.0.0.1:{port}", tmp_path)


@pytest.mark.timeout(200)
def test_mavsdk_client_flies_vehicle(tmp_path: Path):
    _fly("mavsdk_flight.py", "tcpout://127.0.0.1:{port}", tmp_path, "--param", "SR0_EXT_STAT=5")


@pytest.mark.timeout(200)
def test_mavproxy_client_flies_vehicle(tmp_path: Path):
    output = _fly("mavproxy_flight.py", "tcp:127.0.0.1:{port}", tmp_path)
    assert "fence breach" not in output


def _item(command: int, north: float, east: float, alt: float, frame: int = 3) -> dict[str, Any]:
    lat = HOME[0] + north / 111_319
    lon = HOME[1] + east / 74_000
    return {
        "type": "SimpleItem",
        "autoContinue": True,
        "command": command,
        "frame": frame,
        "params": [0, 0, 0, None, lat, lon, alt],
    }


PLAN: dict[str, Any] = {
    "fileType": "Plan",
    "groundStation": "QGroundControl",
    "version": 1,
    "mission": {
        "version": 2,
        "plannedHomePosition": list(HOME),
        "items": [_item(22, 0, 0, 10), _item(16, 20, 0, 12), _item(16, 20, 15, 12)],
    },
    "geoFence": {
        "version": 2,
        "polygons": [
            {
                "version": 1,
                "inclusion": True,
                "polygon": [
                    [HOME[0] + n / 111_319, HOME[1] + e / 74_000]
                    for n, e in ((-90, -90), (90, -90), (90, 90), (-90, 90))
                ],
            }
        ],
        "circles": [
            {"version": 1, "inclusion": False, "circle": {"center": [HOME[0] + 80 / 111_319, HOME[1]], "radius": 10}}
        ],
    },
    "rallyPoints": {"version": 2, "points": [[HOME[0] - 15 / 111_319, HOME[1], 10]]},
}


def item_lists(plan: dict[str, Any]) -> dict[int, list[tuple[int, int, list[float], float, float, float]]]:
    """Convert a plan to item lists like QGroundControl: mission (0), fence (1) and rally points (2).

    Each item is (command, frame, params, lat, lon, alt).
    """
    home = plan["mission"]["plannedHomePosition"]
    mission = [(16, 0, [0.0] * 4, *home)]
    for item in plan["mission"]["items"]:
        values = [float("nan") if value is None else float(value) for value in item["params"]]
        mission.append((item["command"], item["frame"], values[:4], *values[4:]))
    fence = []
    for polygon in plan["geoFence"]["polygons"]:
        command = 5001 if polygon["inclusion"] else 5002
        count = float(len(polygon["polygon"]))
        fence += [(command, 0, [count, 0.0, 0.0, 0.0], lat, lon, 0.0) for lat, lon in polygon["polygon"]]
    for circle in plan["geoFence"]["circles"]:
        command = 5003 if circle["inclusion"] else 5004
        lat, lon = circle["circle"]["center"]
        fence.append((command, 0, [float(circle["circle"]["radius"]), 0.0, 0.0, 0.0], lat, lon, 0.0))
    rally = [(5100, 3, [0.0] * 4, lat, lon, alt) for lat, lon, alt in plan["rallyPoints"]["points"]]
    return {0: mission, 1: fence, 2: rally}


def test_qgroundcontrol_plan_is_uploaded_and_flown(tmp_path: Path):
    path = tmp_path / "survey.plan"
    path.write_text(json.dumps(PLAN))
    lists = item_lists(json.loads(path.read_text()))
    port = free_port()
    with running_vehicle("--ready-after", "3", "--speedup", "10", links=(f"tcp:127.0.0.1:{port}",)):
        client = Client(f"tcp:127.0.0.1:{port}")
        client.wait_for("HEARTBEAT")
        mav = client.link.mav
        for kind, items in lists.items():
            mav.mission_count_send(1, 1, len(items), kind)
            for _ in items:
                request = client.wait(lambda m: m.get_type() in ("MISSION_REQUEST", "MISSION_REQUEST_INT"))
                command, frame, params, lat, lon, alt = items[request.seq]
                mav.mission_item_int_send(
                    1, 1, request.seq, frame, command, 0, 1, *params, round(lat * 1e7), round(lon * 1e7), alt, kind
                )
            ack = client.wait_for("MISSION_ACK")
            assert (ack.type, ack.mission_type) == (0, kind)
        mav.mission_request_list_send(1, 1, 1)
        assert client.wait_for("MISSION_COUNT").count == 5
        assert client.command(207, 1) == 0
        while client.command(400, 1) != 0:
            client.beat()
        assert client.command(300) == 0 or client.command(176, 1, 3) == 0
        client.wait(lambda m: m.get_type() == "MISSION_ITEM_REACHED" and m.seq == 3, 40.0)
        assert client.command(20) == 0
        client.wait(lambda m: m.get_type() == "HEARTBEAT" and not m.base_mode & 128, 40.0)
        client.interval(33, 10)
        place = client.wait_for("GLOBAL_POSITION_INT")
        from_rally = (place.lat * 1e-7 - HOME[0]) * 111_319 + 15
        assert abs(from_rally) < 2.0 or abs(from_rally - 15) < 2.0
