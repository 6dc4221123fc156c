"""Camera pose from the MAVLink messages of a vehicle: positions, gimbals, silence, invalid bytes, broken links."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator

import pytest
from fractus_runtime.mavlink_codec import Endpoint, Parser
from fractus_world import pose_provider
from fractus_world.pose_provider import CameraPose, VehiclePose, parse_address

TIMEOUT_S = 20.0


class Autopilot:
    """A TCP server that sends MAVLink messages of an autopilot."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(TIMEOUT_S)
        self.address = self._server.getsockname()
        self.link: socket.socket | None = None

    def accept(self) -> None:
        self.link, _ = self._server.accept()
        self.link.settimeout(TIMEOUT_S)

    def send(self, name: str, **values: object) -> None:
        assert self.link is not None
        self.link.sendall(Endpoint(1, 1).encode(name, values))  # type: ignore[arg-type]

    def fly(self, yaw_deg: float = 0.0, **gpi: int) -> None:
        """Send a heartbeat, a position 50 m above home (at 200 m above sea level), and an attitude."""
        self.send("HEARTBEAT", type=2, autopilot=3, mavlink_version=3)
        at = {"lat": 500_000_000, "lon": 40_000_000, "alt": 250_000, "relative_alt": 50_000} | gpi
        self.send("GLOBAL_POSITION_INT", **at)
        self.send("ATTITUDE", roll=math.radians(5), pitch=math.radians(-3), yaw=math.radians(yaw_deg))

    def close(self) -> None:
        if self.link is not None:
            self.link.close()
        self._server.close()


@pytest.fixture
def autopilot() -> Iterator[Autopilot]:
    server = Autopilot()
    yield server
    server.close()


@pytest.fixture
def follower(autopilot: Autopilot) -> Iterator[VehiclePose]:
    vehicle = VehiclePose(autopilot.address)
    vehicle.start()
    autopilot.accept()
    yield vehicle
    vehicle.stop()


def wait_for_pose(vehicle: VehiclePose, known: bool = True) -> CameraPose | None:
    """Wait until the pose is known, or unknown if `known` is False. Return the pose, or None if it is unknown."""
    end = time.monotonic() + TIMEOUT_S
    while time.monotonic() < end:
        camera = vehicle.now()
        if (camera is not None) is known:
            return camera
        time.sleep(0.02)
    raise TimeoutError(f"the pose did not become {'known' if known else 'unknown'}")


def known_pose(vehicle: VehiclePose) -> CameraPose:
    camera = wait_for_pose(vehicle)
    assert camera is not None
    return camera


def test_world_pose_is_reported_pose_of_autopilot(autopilot: Autopilot, follower: VehiclePose) -> None:
    assert follower.now() is None
    autopilot.fly(yaw_deg=80.0)
    camera = known_pose(follower)
    pose = camera.pose
    assert (pose.lat, pose.lon) == pytest.approx((50.0, 4.0), abs=1e-7)
    assert pose.height_m == pytest.approx(50.0)
    assert camera.ground_amsl_m == pytest.approx(200.0)
    assert (pose.roll_deg, pose.pitch_deg, pose.yaw_deg) == pytest.approx((5.0, -3.0, 80.0), abs=1e-4)
    assert camera.mount is None


def test_world_pose_provider_requests_streams_without_heartbeats(autopilot: Autopilot, follower: VehiclePose) -> None:
    autopilot.fly()
    parser = Parser()
    requested = {}
    end = time.monotonic() + TIMEOUT_S
    while len(requested) < 3 and time.monotonic() < end:
        assert autopilot.link is not None
        for message in parser.feed(autopilot.link.recv(4096)):
            assert message.name == "COMMAND_LONG", (
                "the provider sent another message. A heartbeat would prevent the autopilot's failsafe"
            )
            assert message.integer("command") == 511
            requested[int(message.real("param1"))] = message.real("param2")
    assert requested == {33: 50_000.0, 30: 50_000.0, 285: 100_000.0}


def test_world_pose_is_extrapolated_by_velocity(autopilot: Autopilot, follower: VehiclePose) -> None:
    autopilot.fly(vx=1000, vy=0, vz=0)
    first = known_pose(follower)
    time.sleep(0.2)
    later = follower.now()
    assert later is not None
    assert 0.5 < (later.pose.lat - first.pose.lat) * 111_200 < 20.0


@pytest.mark.parametrize(("flags", "yaw"), [(32, 30.0), (16, -50.0), (64, -50.0), (0, 30.0)])
def test_world_pose_uses_gimbal_attitude_instead_of_mount(
    autopilot: Autopilot, follower: VehiclePose, flags: int, yaw: float
) -> None:
    """The flags of the message specify a yaw relative to the airframe or to north."""
    autopilot.fly(yaw_deg=80.0)
    known_pose(follower)
    half_pitch = math.radians(-40.0) / 2
    half_yaw = math.radians(30.0) / 2
    q = (
        math.cos(half_yaw) * math.cos(half_pitch),
        -math.sin(half_yaw) * math.sin(half_pitch),
        math.cos(half_yaw) * math.sin(half_pitch),
        math.sin(half_yaw) * math.cos(half_pitch),
    )
    end = time.monotonic() + TIMEOUT_S
    camera = None
    while (camera is None or camera.mount is None) and time.monotonic() < end:
        autopilot.fly(yaw_deg=80.0)
        autopilot.send("GIMBAL_DEVICE_ATTITUDE_STATUS", q=q, flags=flags)
        time.sleep(0.05)
        camera = follower.now()
    assert camera is not None
    assert camera.mount is not None
    assert camera.mount.pitch_deg == pytest.approx(-40.0, abs=1e-3)
    assert camera.mount.yaw_deg == pytest.approx(yaw, abs=1e-3)


def test_world_pose_is_unknown_if_autopilot_is_silent(
    autopilot: Autopilot, follower: VehiclePose, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_provider, "STALE_S", 0.3)
    autopilot.fly()
    known_pose(follower)
    assert wait_for_pose(follower, known=False) is None


def test_world_pose_is_unknown_without_gps_fix(autopilot: Autopilot, follower: VehiclePose) -> None:
    autopilot.fly(lat=0, lon=0)
    autopilot.fly(lat=0, lon=0)
    time.sleep(0.2)
    assert follower.now() is None


def test_world_pose_provider_recovers_from_invalid_bytes_and_broken_link(
    autopilot: Autopilot, follower: VehiclePose
) -> None:
    assert autopilot.link is not None
    autopilot.link.sendall(bytes(range(256)) * 40)
    end = time.monotonic() + TIMEOUT_S
    while follower.now() is None and time.monotonic() < end:
        autopilot.fly()  # the invalid bytes may begin a frame, which would consume the next message
        time.sleep(0.05)
    known_pose(follower)
    autopilot.link.close()
    autopilot.accept()
    autopilot.fly(lat=510_000_000)
    end = time.monotonic() + TIMEOUT_S
    while known_pose(follower).pose.lat < 50.5 and time.monotonic() < end:
        time.sleep(0.02)
    assert known_pose(follower).pose.lat == pytest.approx(51.0)


@pytest.mark.parametrize("text", ["udp:127.0.0.1:1", "tcp:host", "tcp::5762", "tcp:h:0", "tcp:h:99999", ""])
def test_world_pose_provider_rejects_invalid_address(text: str) -> None:
    with pytest.raises(ValueError, match="tcp:HOST:PORT"):
        parse_address(text)
