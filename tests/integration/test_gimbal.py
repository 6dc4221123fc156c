"""Camera on a gimbal: pictures are judged by its measured attitude."""

from __future__ import annotations

import asyncio
import io
import signal
import socket
from collections.abc import AsyncIterator
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
import yaml
from fractus_cluster.ports import free_port
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc, types_pb2
from fractus_proto.v1 import mobility_pb2 as pb
from fractus_runtime.mavlink_codec import Endpoint
from mobility_rig import HOME, NODE, PASSENGER, Driver, Rig, area, denied, grant, passenger_grant
from PIL import Image
from pymavlink.dialects.v20 import ardupilotmega as mavlink

SIYI = 8
SERVOS = 1
METHODS = ["CaptureImage", "RetrieveImage", "DeleteImage"]
ALLOW = types_pb2.Decision.ACTION_ALLOW
CORRECT = types_pb2.Decision.ACTION_CORRECT
GPS = 0x8825
DIRECTION = 17
NORTH = {
    "name": "north",
    "spec": {"type": "PrivacyControl", "kind": "camera", "action": "black", "selector": {"zones": ["yard"]}},
    "zones": [{"name": "yard", "area": area(-60, 40, 60, 80)}],
}
TIMEOUT_S = 90.0
PACE_S = 0.2
"""Pause between two pictures, so that the camera service does not refuse calls because of their rate."""


class Station:
    """A ground station on a separate link to the vehicle."""

    def __init__(self, port: int) -> None:
        self._link = socket.create_connection(("127.0.0.1", port), timeout=10)
        self._endpoint = Endpoint(255, 190)

    def _send(self, name: str, **values: Any) -> None:
        self._link.sendall(self._endpoint.encode(name, {"target_system": 1, "target_component": 1, **values}))

    def point(self, pitch_deg: float, yaw_deg: float) -> None:
        nan = float("nan")
        angles = {"param1": pitch_deg, "param2": yaw_deg, "param3": nan, "param4": nan}
        self._send("COMMAND_LONG", command=mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, **angles)

    def set_type(self, kind: int) -> None:
        self._send("PARAM_SET", param_id=b"MNT1_TYPE", param_value=kind, param_type=mavlink.MAV_PARAM_TYPE_INT8)

    def close(self) -> None:
        self._link.close()


class Stage:
    """A drone in flight with a camera on a gimbal, and a passenger. A privacy zone (`NORTH`) is north of the drone."""

    def __init__(self, rig: Rig, station: Station, driver: Driver, camera: Any) -> None:
        self.rig = rig
        self.station = station
        self.driver = driver
        self.camera = camera

    async def take_picture(self) -> tuple[Any, bytes]:
        """Return the decision on a picture and the picture. Retry until the camera is ready and the position is known.

        The decision is from the capture if the capture changed the picture, otherwise from the retrieval.
        """
        async with asyncio.timeout(TIMEOUT_S):
            while True:
                try:
                    capture = await self.camera.CaptureImage(
                        camera_pb2.CaptureImageRequest(), wait_for_ready=True, timeout=60
                    )
                except grpc.aio.AioRpcError as error:
                    assert error.code() in {grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.PERMISSION_DENIED}, error
                    await asyncio.sleep(PACE_S)
                    continue
                request = camera_pb2.RetrieveImageRequest(name=capture.image.name)
                try:
                    chunks = [chunk async for chunk in self.camera.RetrieveImage(request, timeout=20)]
                except grpc.aio.AioRpcError as error:
                    # The service refuses the picture, because the measured attitude changed after the capture.
                    assert "request it again" in (error.details() or ""), error
                    await asyncio.sleep(PACE_S)
                    continue
                await self.camera.DeleteImage(camera_pb2.DeleteImageRequest(name=capture.image.name), timeout=5)
                decision = capture.decision if capture.decision.action == CORRECT else chunks[0].decision
                return decision, b"".join(chunk.data for chunk in chunks)

    async def take_until(self, action: int) -> tuple[Any, bytes]:
        """Take pictures until a decision has this action.

        For a moment after a rotation, the service still takes the attitudes during the rotation into account.
        """
        async with asyncio.timeout(TIMEOUT_S):
            while True:
                decision, data = await self.take_picture()
                if decision.action == action:
                    return decision, data
                await asyncio.sleep(PACE_S)

    async def wait_for_attitude(self, pitch_deg: float, yaw_deg: float) -> pb.Telemetry:
        """Wait until the gimbal's measured attitude is near these angles."""

        def is_near(state: pb.Telemetry) -> bool:
            yaw_error_deg = abs((state.gimbal.yaw_deg - yaw_deg + 180) % 360 - 180)
            return state.HasField("gimbal") and abs(state.gimbal.pitch_deg - pitch_deg) < 3 and yaw_error_deg < 10

        return await self.rig.until(is_near, description=f"gimbal at pitch {pitch_deg:g}, yaw {yaw_deg:g} degrees")


async def take_off(driver: Driver) -> None:
    """Arm and take off. Retry if the position is unknown for a moment on a busy machine."""
    await driver.arm()
    async with asyncio.timeout(TIMEOUT_S):
        while True:
            try:
                await driver.take_off()
            except grpc.aio.AioRpcError as error:
                assert error.code() == grpc.StatusCode.UNAVAILABLE, error
                await asyncio.sleep(0.5)
            else:
                return


@pytest.fixture
def ports() -> list[int]:
    """Ports of the vehicle for the camera world and the ground station, and the port of the camera world."""
    return [free_port() for _ in range(3)]


@pytest.fixture
async def driver(rig: Rig, ports: list[int]) -> Driver:
    """Driver in control of a drone on the ground, which has a camera on a gimbal."""
    rig.write_grant(grant())
    services = [{"service": "camera", "methods": METHODS}, {"service": "mobility", "methods": ["GetPosition"]}]
    rig.write_grant(passenger_grant(NORTH, services=services))
    camera = {
        "connection": f"http://127.0.0.1:{ports[2]}/snapshot.jpg", "resolution": "320x240", "methods": METHODS,
        "horizontalFieldOfView": 30, "lens": {"model": "pinhole"}, "mount": {"gimbal": True},
    }  # fmt: skip
    metadata = {"name": NODE}
    spec = {"services": {"camera": camera}}
    described = yaml.safe_dump(
        {"apiVersion": "fractus.dev/v1alpha1", "kind": "Drone", "metadata": metadata, "spec": spec}
    )
    (rig.directory / "node.yaml").write_text(described)
    rig.start_service("--description", str(rig.directory / "node.yaml"))
    links = [part for port in ports[:2] for part in ("--listen", f"tcp:127.0.0.1:{port}")]
    rig.start_vehicle(1.0, *links, "--param", f"MNT1_TYPE={SIYI}")
    driver = Driver(rig)
    await driver.take()
    return driver


@pytest.fixture
async def stage(driver: Driver, ports: list[int]) -> AsyncIterator[Stage]:
    rig = driver.rig
    rig.start(
        "world", "-m", "fractus_world", "--listen", f"127.0.0.1:{ports[2]}", "--vehicle",
        f"tcp:127.0.0.1:{ports[0]}", "--origin", f"{HOME[0]},{HOME[1]}", "--resolution", "320x240", "--fov", "30",
    )  # fmt: skip
    address = rig.start_camera()
    await take_off(driver)
    station = Station(ports[1])
    yield Stage(rig, station, driver, camera_pb2_grpc.CameraServiceStub(rig.channel(PASSENGER, address=address)))
    station.close()


def brightness(data: bytes) -> float:
    return float(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).mean())


async def point(driver: Driver, pitch_deg: float, yaw_deg: float = 0.0) -> pb.PointGimbalResponse:
    return await driver.stub.PointGimbal(pb.PointGimbalRequest(pitch_deg=pitch_deg, yaw_deg=yaw_deg), timeout=10)


async def test_gimbal_picture_is_judged_by_measured_attitude(stage: Stage) -> None:
    driver = stage.driver
    assert (await point(driver, -90.0)).decision.action == ALLOW
    await stage.wait_for_attitude(-90.0, 0.0)
    _, below = await stage.take_until(ALLOW)
    assert brightness(below) > 10

    # The driver turns the camera to the privacy zone.
    await point(driver, -10.0)
    await stage.wait_for_attitude(-10.0, 0.0)
    decision, ahead = await stage.take_picture()
    assert (decision.action, decision.code, list(decision.policies)) == (CORRECT, "PrivacyFilter", ["north"])
    assert brightness(ahead) < 1

    # The driver turns the camera away from the privacy zone.
    await point(driver, -10.0, 180.0)
    await stage.wait_for_attitude(-10.0, 180.0)
    _, behind = await stage.take_until(ALLOW)
    assert brightness(behind) > 10
    direction = Image.open(io.BytesIO(behind)).getexif().get_ifd(GPS)[DIRECTION]
    assert abs(float(direction) - 180.0) < 10.0

    # A ground station turns the camera back without a call to the service.
    stage.station.point(-10.0, 0.0)
    await stage.wait_for_attitude(-10.0, 0.0)
    assert (await stage.take_picture())[0].action == CORRECT
    stage.station.point(-90.0, 0.0)
    await stage.wait_for_attitude(-90.0, 0.0)
    await stage.take_until(ALLOW)

    # The camera points straight down, but its attitude is no longer measured.
    stage.station.set_type(SERVOS)
    await stage.rig.until(
        lambda state: not state.HasField("gimbal"), description="telemetry without the attitude of the gimbal"
    )
    decision, hidden = await stage.take_until(CORRECT)
    assert decision.code == "PrivacyFilter"
    assert brightness(hidden) < 1


async def test_point_gimbal_is_refused_for_passenger_or_invalid_angle(rig: Rig, driver: Driver) -> None:
    refused = [
        (driver.stub, 45.0, grpc.StatusCode.FAILED_PRECONDITION, "AutopilotRefused"),
        (driver.stub, 95.0, grpc.StatusCode.INVALID_ARGUMENT, "InvalidArgument"),
        (rig.stub(PASSENGER), -45.0, grpc.StatusCode.PERMISSION_DENIED, "NotADriver"),
    ]
    for stub, pitch_deg, status, code in refused:
        refused_status, decision = await denied(
            stub.PointGimbal(pb.PointGimbalRequest(pitch_deg=pitch_deg), timeout=10)
        )
        assert (refused_status, decision.code) == (status, code)
    # The audit log is written in batches, at the latest when the service ends.
    rig.kill("service", signal.SIGTERM)
    calls = [entry for entry in rig.entries("call") if "PointGimbal" in str(entry)]
    assert len(calls) >= len(refused), "the audit log lacks a refused call"


async def test_point_gimbal_is_refused_for_fixed_camera(rig: Rig, driver: Driver) -> None:
    """Replace the gimbal in the node description by a fixed mount. The service then refuses PointGimbal."""
    assert (await point(driver, -45.0)).decision.action == ALLOW
    path = rig.directory / "node.yaml"
    described = yaml.safe_load(path.read_text())
    described["spec"]["services"]["camera"]["mount"] = {"pitch": -90, "stabilised": True}
    path.write_text(yaml.safe_dump(described))
    await rig.until_logged("service", "description: changed")
    code, decision = await denied(point(driver, -90.0))
    assert (code, decision.code) == (grpc.StatusCode.FAILED_PRECONDITION, "CameraFixed")
    assert "services.camera.mount.gimbal" in decision.reason
