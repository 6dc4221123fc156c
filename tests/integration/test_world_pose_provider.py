"""The camera's pose from a vehicle's MAVLink: positions, gimbals, silence, garbage, broken links."""

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
    """A TCP server that says what a test tells it to."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(TIMEOUT_S)
        self.address = self._server.getsockname()
        self.link: socket.socket | None = None

    def accept(self) -> None:
        self.link, _ = self._server.accept()
        self.link.settimeout(TIMEOUT_S)

    def say(self, name: str, **values: object) -> None:
        assert self.link is not None
        self.link.sendall(Endpoint(1, 1).encode(name, values))  # type: ignore[arg-type]

    def fly(self, yaw_deg: float = 0.0, **gpi: int) -> None:
        """A heartbeat, a position 50 m above home on 200 m, and an attitude."""
        self.say("HEARTBEAT", type=2, autopilot=3, mavlink_version=3)
        at = {"lat": 500_000_000, "lon": 40_000_000, "alt": 250_000, "relative_alt": 50_000} | gpi
        self.say("GLOBAL_POSITION_INT", **at)
        self.say("ATTITUDE", roll=math.radians(5), pitch=math.radians(-3), yaw=math.radians(yaw_deg))

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


def camera_pose(vehicle: VehiclePose, wanted: bool = True) -> CameraPose | None:
    end = time.monotonic() + TIMEOUT_S
    while time.monotonic() < end:
        found = vehicle.now()
        if (found is not None) is wanted:
            return found
        time.sleep(0.02)
    raise TimeoutError(f"wanted: {wanted}")


def known(vehicle: VehiclePose) -> CameraPose:
    found = camera_pose(vehicle)
    assert found is not None
    return found


def test_pose_is_what_the_autopilot_says(autopilot: Autopilot, follower: VehiclePose) -> None:
    assert follower.now() is None
    autopilot.fly(yaw_deg=80.0)
    found = known(follower)
    assert (found.pose.lat, found.pose.lon) == pytest.approx((50.0, 4.0), abs=1e-7)
    assert found.pose.height_m == pytest.approx(50.0)
    assert found.ground_amsl_m == pytest.approx(200.0)
    assert (found.pose.roll_deg, found.pose.pitch_deg, found.pose.yaw_deg) == pytest.approx((5.0, -3.0, 80.0), abs=1e-4)
    assert found.mount is None


def test_streams_are_asked_for_and_no_heartbeat_is_sent(autopilot: Autopilot, follower: VehiclePose) -> None:
    autopilot.fly()
    parser = Parser()
    asked = {}
    end = time.monotonic() + TIMEOUT_S
    while len(asked) < 3 and time.monotonic() < end:
        assert autopilot.link is not None
        for message in parser.feed(autopilot.link.recv(4096)):
            assert message.name == "COMMAND_LONG", "a heartbeat would hold off the autopilot's failsafe"
            assert message.integer("command") == 511
            asked[int(message.real("param1"))] = message.real("param2")
    assert asked == {33: 50_000.0, 30: 50_000.0, 285: 100_000.0}


def test_position_goes_on_with_the_speed(autopilot: Autopilot, follower: VehiclePose) -> None:
    autopilot.fly(vx=1000, vy=0, vz=0)
    first = known(follower)
    time.sleep(0.2)
    later = follower.now()
    assert later is not None
    assert 0.5 < (later.pose.lat - first.pose.lat) * 111_200 < 20.0


@pytest.mark.parametrize(("flags", "yaw"), [(32, 30.0), (16, -50.0), (64, -50.0), (0, 30.0)])
def test_gimbal_overrides_the_mount(autopilot: Autopilot, follower: VehiclePose, flags: int, yaw: float) -> None:
    """Its yaw is the airframe's, or north's: MAVLink tells by flags."""
    autopilot.fly(yaw_deg=80.0)
    known(follower)
    half_pitch = math.radians(-40.0) / 2
    half_yaw = math.radians(30.0) / 2
    q = (
        math.cos(half_yaw) * math.cos(half_pitch),
        -math.sin(half_yaw) * math.sin(half_pitch),
        math.cos(half_yaw) * math.sin(half_pitch),
        math.sin(half_yaw) * math.cos(half_pitch),
    )
    end = time.monotonic() + TIMEOUT_S
    found = None
    while (found is None or found.mount is None) and time.monotonic() < end:
        autopilot.fly(yaw_deg=80.0)
        autopilot.say("GIMBAL_DEVICE_ATTITUDE_STATUS", q=q, flags=flags)
        time.sleep(0.05)
        found = follower.now()
    assert found is not None
    assert found.mount is not None
    assert found.mount.pitch_deg == pytest.approx(-40.0, abs=1e-3)
    assert found.mount.yaw_deg == pytest.approx(yaw, abs=1e-3)


def test_silence_is_unknown(autopilot: Autopilot, follower: VehiclePose, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_provider, "STALE_S", 0.3)
    autopilot.fly()
    known(follower)
    assert camera_pose(follower, wanted=False) is None


def test_no_fix_is_unknown(autopilot: Autopilot, follower: VehiclePose) -> None:
    autopilot.fly(lat=0, lon=0)
    autopilot.fly(lat=0, lon=0)
    time.sleep(0.2)
    assert follower.now() is None


def test_garbage_and_a_broken_link_are_survived(autopilot: Autopilot, follower: VehiclePose) -> None:
    assert autopilot.link is not None
    autopilot.link.sendall(bytes(range(256)) * 40)
    end = time.monotonic() + TIMEOUT_S
    while follower.now() is None and time.monotonic() < end:
        autopilot.fly()  # the garbage may begin a frame that swallows the next one
        time.sleep(0.05)
    known(follower)
    autopilot.link.close()
    autopilot.accept()
    autopilot.fly(lat=510_000_000)
    end = time.monotonic() + TIMEOUT_S
    while known(follower).pose.lat < 50.5 and time.monotonic() < end:
        time.sleep(0.02)
    assert known(follower).pose.lat == pytest.approx(51.0)


@pytest.mark.parametrize("text", ["udp:127.0.0.1:1", "tcp:host", "tcp::5762", "tcp:h:0", "tcp:h:99999", ""])
def test_addresses_are_checked(text: str) -> None:
    with pytest.raises(ValueError, match="tcp:HOST:PORT"):
        parse_address(text)
