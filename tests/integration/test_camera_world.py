"""Camera world: as a process that follows the simulated vehicle, and as an HTTP server with slow and malformed clients."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from fractus_cluster.ports import free_port
from fractus_world import server as server_module
from fractus_world.camera_api import CameraApi
from fractus_world.optics import Intrinsics, Mount, Pose
from fractus_world.pose_provider import FixedPose
from fractus_world.server import CameraServer
from fractus_world.world import WorldAround
from geotagged import save
from vehicle_process import HOME, Client, running_vehicle


def get(port: int, path: str, timeout_s: float = 60.0) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout_s)
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        return response.status, dict(response.getheaders()), response.read()
    finally:
        connection.close()


def eventually(poll: Callable[[], int | None], timeout_s: float = 60.0) -> int:
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        result = poll()
        if result is not None:
            return result
        time.sleep(0.1)
    raise TimeoutError(f"no result within {timeout_s:.0f} s")


def wait_for_picture(port: int, path: str) -> tuple[int, dict[str, str], bytes]:
    """Return the first response with a picture. On a busy machine, the messages of the vehicle may arrive late."""
    responses: list[tuple[int, dict[str, str], bytes]] = []

    def status_if_ok() -> int | None:
        responses.append(get(port, path))
        return responses[-1][0] if responses[-1][0] == 200 else None

    eventually(status_if_ok)
    return responses[-1]


@contextlib.contextmanager
def running_world(*arguments: str) -> Iterator[int]:
    """Run the camera world as a process, and yield its port."""
    command = [sys.executable, "-m", "fractus_world", "--listen", "127.0.0.1:0", *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        lines: list[str] = []
        while "camera world at" not in (line := process.stderr.readline()):
            lines.append(line)
            assert line, "".join(lines)
        yield int(line.rstrip().rstrip("/").rsplit(":", 1)[1])
    finally:
        process.terminate()
        process.wait(15)
    assert process.returncode == 0, process.stderr.read()


@pytest.fixture
def served() -> Iterator[CameraServer]:
    """Camera server in this process. Its camera has a fixed position."""
    frame_pose = Pose(50.8637, 4.6785, 40.0, yaw_deg=20.0)
    api = CameraApi(
        WorldAround(7, (50.8637, 4.6785)), FixedPose(frame_pose), Intrinsics(320, 180), Mount(), now=lambda: 1000.0
    )
    server = CameraServer(("127.0.0.1", 0), api)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join(10)


def picture_of(body: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def test_camera_world_follows_vehicle_and_its_restart() -> None:
    """The server returns pictures while a vehicle is connected, and otherwise 503."""
    links = [f"tcp:127.0.0.1:{free_port()}" for _ in range(2)]
    origin = f"{HOME[0]},{HOME[1]}"
    small = "/snapshot.jpg?width=320&height=180"
    with running_world("--vehicle", links[1], "--origin", origin, "--mount-pitch", "-60") as port:
        status, _, body = get(port, small)
        assert status == 503
        assert b"position" in body
        with running_vehicle("--ready-after", "2", "--speedup", "4", links=tuple(links)):
            eventually(lambda: get(port, small)[0] == 200 or None)
            pilot = Client(links[0])
            pilot.take_off(20.0)
            status, headers, body = wait_for_picture(port, small)
            assert status == 200
            assert headers["Content-Type"] == "image/jpeg"
            assert picture_of(body).shape == (180, 320, 3)
            truth = json.loads(get(port, f"/truth.json?snapshot={headers['X-Fractus-Snapshot']}")[2])
            assert truth["pose"]["heightM"] == pytest.approx(20.0, abs=3.0)
            assert truth["pose"]["lat"] == pytest.approx(HOME[0], abs=1e-4)
            assert isinstance(truth["objects"], list)
            pilot.close()
        assert eventually(lambda: get(port, small)[0] == 503 or None)
        with running_vehicle("--ready-after", "2", links=tuple(links)):
            eventually(lambda: get(port, small)[0] == 200 or None)


def test_camera_world_truth_belongs_to_its_snapshot(served: CameraServer) -> None:
    status, headers, first = get(served.port, "/snapshot.jpg?time=77.5")
    assert status == 200
    assert headers["X-Fractus-Time"] == "77.500"
    assert get(served.port, "/snapshot.jpg?time=77.5")[2] == first, "two pictures with the same pose and time differ"
    assert get(served.port, "/snapshot.jpg?time=77.5&band=ir")[2] != first
    truth = json.loads(get(served.port, f"/truth.json?snapshot={headers['X-Fractus-Snapshot']}")[2])
    assert truth["time"] == 77.5
    assert truth["band"] == "rgb"
    assert json.loads(get(served.port, "/truth.json")[2])["band"] == "ir", (
        "without a snapshot number, the truth does not belong to the last snapshot"
    )


def test_camera_world_serves_orthophoto_and_page(served: CameraServer) -> None:
    status, headers, body = get(served.port, "/orthophoto.png?metres=100&pixels=200")
    assert status == 200
    assert headers["Content-Type"] == "image/png"
    assert picture_of(body).shape == (200, 200, 3)
    lines = get(served.port, "/orthophoto.pgw?metres=100&pixels=200")[2].split()
    assert len(lines) == 6
    assert float(lines[4]) + 99.5 * float(lines[0]) == pytest.approx(4.6785, abs=1e-9)
    assert float(lines[5]) + 99.5 * float(lines[3]) == pytest.approx(50.8637, abs=1e-9)
    status, headers, body = get(served.port, "/")
    assert status == 200
    assert b"snapshot.jpg" in body
    assert headers["Content-Type"].startswith("text/html")


@pytest.mark.parametrize(
    ("path", "status", "words"),
    [
        ("/nothing", 404, "unknown page /nothing"),
        ("/snapshot.jpg?width=9999", 400, "width: 9999"),
        ("/snapshot.jpg?width=8192&height=8192", 400, "more than 16,000,000 pixels"),
        ("/snapshot.jpg?width=-5", 400, "whole number"),
        ("/snapshot.jpg?height=nan", 400, "whole number"),
        ("/snapshot.jpg?band=uv", 400, "neither rgb nor ir"),
        ("/snapshot.jpg?time=inf", 400, "time"),
        ("/snapshot.jpg?with=5", 400, "unknown parameter 'with'"),
        ("/truth.json?snapshot=999999", 404, "snapshot 999999"),
        ("/truth.json", 404, "no picture has been taken"),
        ("/orthophoto.png?metres=1e9", 400, "metres"),
        ("/orthophoto.png?pixels=100000", 400, "pixels"),
        ("/orthophoto.png?lat=89", 400, "lat"),
        ("/snapshot.jpg?" + "&".join(f"a{n}=1" for n in range(40)), 400, "query"),
    ],
)
def test_camera_world_rejects_bad_request_with_reason(served: CameraServer, path: str, status: int, words: str) -> None:
    if "999999" in path:
        get(served.port, "/snapshot.jpg")
    response = get(served.port, path)
    assert response[0] == status
    assert words in response[2].decode()


def test_camera_world_disconnects_idle_and_slow_clients(served: CameraServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clients without a complete request occupy all connections. The server disconnects them and renders no picture."""
    monkeypatch.setattr(server_module, "CLIENT_LIFE_S", 0.5)
    monkeypatch.setattr(server_module, "MAX_CLIENTS", 8)
    idle = [socket.create_connection(("127.0.0.1", served.port), timeout=5) for _ in range(24)]
    for number, client in enumerate(idle):
        if number % 3 == 0:
            with contextlib.suppress(OSError):
                client.sendall(b"GET /snapshot.jpg HTTP/1.1\r\nHost: x\r\n")
        elif number % 3 == 1:
            client.close()
    for number, client in enumerate(idle):
        if number % 3 != 1:
            client.settimeout(30)
            with contextlib.suppress(ConnectionError):
                assert client.recv(1) == b""
            client.close()
    monkeypatch.undo()
    assert eventually(lambda: _status(served.port)) == 200
    assert json.loads(get(served.port, "/truth.json")[2])["snapshot"] == 1


def _status(port: int) -> int | None:
    try:
        return get(port, "/snapshot.jpg", 10.0)[0]
    except (OSError, http.client.HTTPException):
        return None


def test_camera_world_returns_picture_or_503_to_many_clients(served: CameraServer) -> None:
    statuses: list[int | None] = []
    threads = [threading.Thread(target=lambda: statuses.append(_status(served.port))) for _ in range(24)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(statuses) == 24
    assert set(statuses) <= {200, 503}
    assert statuses.count(200) >= 8


def test_camera_world_rejects_other_http_methods(served: CameraServer) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=10)
    connection.request("POST", "/snapshot.jpg", body=b"x" * 100)
    assert connection.getresponse().status == 501
    connection.close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--vehicle", "udp:1"), "tcp:HOST:PORT"),
        (("--pose", "50"), "LAT,LON,HEIGHT"),
        (("--pose", "95,4,10"), "not on the globe"),
        (("--fov", "200"), "field of view"),
        (("--resolution", "big"), "WIDTHxHEIGHT"),
        (("--listen", "8090"), "HOST:PORT"),
        (("--orthophoto", "/nowhere.png"), "/nowhere.png"),
        (("--photos", "/nowhere"), "/nowhere"),
    ],
)
def test_camera_world_command_rejects_bad_option_with_reason(arguments: tuple[str, ...], words: str) -> None:
    from click.testing import CliRunner
    from fractus_world.__main__ import camera_world

    result = CliRunner().invoke(camera_world, list(arguments))
    assert result.exit_code != 0
    assert words in result.output


def test_camera_world_serves_nearest_photo_if_configured(tmp_path: Path) -> None:
    save(tmp_path / "near.jpg", 50.0, 4.0, 60.0, (200, 20, 20))
    save(tmp_path / "far.jpg", 50.01, 4.0, 60.0, (20, 20, 200))
    save(tmp_path / "ir" / "a.jpg", 50.01, 4.0, 60.0, (90, 90, 90))
    with running_world("--photos", str(tmp_path), "--pose", "50.0001,4,20", "--ground", "40") as port:
        assert picture_of(get(port, "/snapshot.jpg?width=64&height=48")[2])[20, 20, 2] > 180
        truth = json.loads(get(port, "/truth.json")[2])
        assert truth["photo"]["name"] == "near.jpg"
        assert truth["photo"]["awayM"] == pytest.approx(11.1, abs=0.2)
        get(port, "/snapshot.jpg?width=64&height=48&band=ir")
        assert json.loads(get(port, "/truth.json")[2])["photo"]["name"] == "a.jpg"
