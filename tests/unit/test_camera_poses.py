"""Camera poses during an exposure, derived from telemetry. They include the motion between two messages."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from depth import examples
from fractus_core.api.nodes import CameraFeatures
from fractus_core.policy.decision_types import Attitude, Lens, Situation
from fractus_core.policy.footprint import camera_axes, exposure_footprint, footprint
from fractus_core.policy.lenses import bounding_lens
from fractus_proto.v1 import mobility_pb2
from fractus_services.camera import pose_history
from fractus_services.camera.pose_history import PoseHistory
from fractus_services.camera.telemetry_client import STEP_WINDOW_S, ArrivalClock, to_measurement
from hypothesis import given, settings
from hypothesis import strategies as st
from policy_world import FRAME, HOME

NOW_S = 1_800_000_000.0
"""Unix time at which the monotonic clock of the tests is 0."""
LENS = Lens(40.0, 30.0, pitch_deg=-60.0, error_deg=0.0)


class Drone:
    """Fake telemetry subscription. A test sets the clock and sends the messages."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.poses = PoseHistory(lambda: self.now_s, lens=LENS)

    def send(
        self,
        at_s: float,
        *,
        x: float = 0.0,
        alt: float = 20.0,
        turned: tuple[float, float, float] = (0.0, 0.0, 0.0),
        speed: tuple[float, float] = (0.0, 0.0),
        ages: tuple[float, float] | None = (0.0, 0.0),
        connected: bool = True,
        late_s: float = 0.0,
    ) -> None:
        self.now_s = at_s
        lat, lon = FRAME.latlon(x, 0.0)
        message = mobility_pb2.Telemetry(autopilot_connected=connected, position_error_m=1.0)
        message.position.latitude_deg = lat
        message.position.longitude_deg = lon
        message.position.altitude_m = alt
        message.velocity.east_mps, message.velocity.down_mps = speed
        message.attitude.roll_deg, message.attitude.pitch_deg, message.attitude.yaw_deg = turned
        message.home.latitude_deg = HOME.lat
        message.home.longitude_deg = HOME.lon
        message.home.altitude_m = 100.0
        if ages is not None:
            message.position_age_s, message.attitude_age_s = ages
        message.time.FromNanoseconds(round((NOW_S + at_s - late_s) * 1e9))
        self.poses.add(to_measurement(message, at_s, NOW_S + at_s))

    def poses_since(self, begun_s: float) -> tuple[Situation, ...]:
        return self.poses.situations_since(begun_s, 1.0)


@pytest.fixture
def drone() -> Drone:
    return Drone()


def attitude(now: Situation) -> Any:
    assert now.attitude is not None
    return now.attitude


def test_pose_history_returns_poses_since_a_time_and_the_pose_before(drone: Drone) -> None:
    for i in range(10):
        drone.send(100.0 + i / 10, turned=(0.0, 0.0, 10.0 * i))
    poses = drone.poses_since(100.45)
    assert [attitude(now).yaw_deg for now in poses] == [40, 50, 60, 70, 80, 90]
    # The error contains half of the yaw difference to adjacent poses, and the maximum rotation of an airframe in 0.05
    # s.
    assert attitude(poses[1]).yaw_error_deg == pytest.approx(pose_history.YAW_ERROR_DEG + 5.0 + 0.05 * 60.0)
    assert attitude(poses[1]).tilt_error_deg == pytest.approx(pose_history.TILT_ERROR_DEG + 0.05 * 60.0)
    assert drone.poses.situation(1.0).attitude is not None


def test_pose_errors_grow_with_measurement_age(drone: Drone) -> None:
    drone.send(100.0, speed=(8.0, -3.0), ages=(0.2, 0.3))
    drone.now_s = 100.4
    now = drone.poses.situation(1.0)
    assert now.position_error_m == pytest.approx(1.0 + 8.0 * 0.6 + 2.5 * 0.36)
    assert now.altitude_error_m == pytest.approx(1.0 + 3.0 * 0.6 + 2.5 * 0.36)
    assert attitude(now).tilt_error_deg == pytest.approx(pose_history.TILT_ERROR_DEG + 60.0 * 0.7)
    drone.now_s = 100.75
    now = drone.poses.situation(1.0)
    assert now.lat is not None
    assert now.attitude is None, "the pose is unknown, because it was measured more than a second ago"
    drone.now_s = 100.85
    assert drone.poses.situation(1.0).lat is None


def test_pose_errors_include_delay_of_telemetry(drone: Drone) -> None:
    drone.send(100.0, speed=(8.0, 0.0), late_s=0.4)
    now = drone.poses.situation(1.0)
    assert now.position_error_m == pytest.approx(1.0 + 8.0 * 0.4 + 2.5 * 0.16, abs=1e-4)
    assert attitude(now).tilt_error_deg == pytest.approx(pose_history.TILT_ERROR_DEG + 60.0 * 0.4, abs=1e-4)
    drone.send(100.1, late_s=3.0)
    assert drone.poses.situation(1.0).lat is None
    drone.send(100.2, late_s=-3600.0)
    assert drone.poses.situation(1.0).lat is None, "the clock was set back, so the delay is unknown"


def test_pose_error_is_large_when_age_is_unknown(drone: Drone) -> None:
    drone.send(100.0, ages=None)
    assert attitude(drone.poses.situation(1.0)).yaw_error_deg > pose_history.YAW_ERROR_DEG + 20.0


def test_pose_is_unknown_when_telemetry_is_missing(drone: Drone) -> None:
    assert drone.poses.situation(1.0).lat is None
    assert [now.lat for now in drone.poses_since(100.0)] == [None]
    drone.send(100.0)
    assert drone.poses_since(99.9)[0].lat is None, "the pose at the beginning is unknown without telemetry"
    assert drone.poses_since(100.0)[0].lat is not None
    drone.send(101.1)
    assert drone.poses_since(100.0)[0].lat is None, "the pose is unknown after more than a second without telemetry"
    drone.send(101.2, connected=False)
    drone.send(101.3)
    assert [now.lat is None for now in drone.poses_since(101.1)] == [False, True, False]
    for i in range(400):
        drone.send(102.0 + i / 10)
    assert len(drone.poses) <= 302
    assert drone.poses_since(101.3)[0].lat is None, "the beginning is older than the history, so the pose is unknown"


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(
    gaps=st.lists(st.floats(0.02, 0.5), min_size=2, max_size=5),
    rates=st.tuples(st.floats(-25, 25), st.floats(-25, 25), st.floats(-150, 150)),
    speed=st.tuples(st.floats(-12, 12), st.floats(-4, 4)),
    ages=st.tuples(st.floats(0, 0.2), st.floats(0, 0.2)),
    share=st.floats(0, 1),
)
def test_footprint_contains_view_between_two_messages(
    gaps: list[float], rates: tuple[float, ...], speed: tuple[float, float], ages: tuple[float, float], share: float
) -> None:
    """The drone flies and rotates at constant rates.

    Telemetry arrives at irregular intervals, and each measurement has a different age.
    """
    drone = Drone()

    def turned(at_s: float) -> tuple[float, float, float]:
        since_s = at_s - 100.0
        return rates[0] * since_s, rates[1] * since_s, (rates[2] * since_s) % 360.0

    at_s = 100.0
    for gap_s in [0.0, *gaps]:
        at_s += gap_s
        measured_s = at_s - ages[0] - 100.0
        drone.send(
            at_s, x=speed[0] * measured_s, alt=40.0 - speed[1] * measured_s, turned=turned(at_s - ages[1]), speed=speed,
            ages=ages,
        )  # fmt: skip
    shown = exposure_footprint(drone.poses_since(100.0), FRAME)
    assert shown is not None
    moment_s = 100.0 + share * (at_s - 100.0)
    drone = Drone()
    drone.send(
        moment_s, x=speed[0] * (moment_s - 100.0), alt=40.0 - speed[1] * (moment_s - 100.0), turned=turned(moment_s)
    )  # fmt: skip
    exact = drone.poses.situation(1.0)
    actual = footprint(exact, FRAME)
    assert actual is not None
    assert shown.farthest_m >= actual.farthest_m - shown.margin_m
    if math.isfinite(actual.farthest_m):
        assert shown.sight.buffer(shown.margin_m + 0.1).covers(actual.sight)


def send_gimbal(poses: PoseHistory, at_s: float, turned: tuple[float, float, float] | None, age_s: float = 0.0) -> None:
    """Send telemetry of a level airframe, and of a gimbal with the given attitude or no attitude."""
    message = mobility_pb2.Telemetry(autopilot_connected=True, position_error_m=1.0, position_age_s=0.0)
    message.position.latitude_deg, message.position.longitude_deg = FRAME.latlon(0.0, 0.0)
    message.position.altitude_m = 40.0
    message.home.latitude_deg = HOME.lat
    message.home.longitude_deg = HOME.lon
    message.home.altitude_m = 100.0
    message.attitude.yaw_deg = 0.0
    message.attitude_age_s = 0.0
    if turned is not None:
        message.gimbal.roll_deg, message.gimbal.pitch_deg, message.gimbal.yaw_deg = turned
        message.gimbal_age_s = age_s
    poses.add(to_measurement(message, at_s, NOW_S + at_s, gimbal=True))


def test_pose_is_unknown_when_telemetry_is_from_the_future(drone: Drone) -> None:
    drone.send(0.0, late_s=-1.0)
    drone.send(0.1, late_s=-1.0)
    assert all(pose.lat is None and pose.attitude is None for pose in drone.poses_since(0.05))
    drone.send(0.2, late_s=-0.01)
    assert drone.poses.situation(1.0).lat is not None, (
        "a time in the future is accepted if the difference is a rounding error"
    )


def test_arrival_clock_ignores_step_back_for_a_while() -> None:
    now_s = 0.0
    step_s = 0.0
    arrival = ArrivalClock(lambda: NOW_S + now_s + step_s, lambda: now_s)
    assert arrival() == NOW_S
    now_s = 2.0
    step_s = -0.9
    assert arrival() == NOW_S + 2.0, "a message sent at 1 s was delayed by one second"
    now_s = 2.1 + STEP_WINDOW_S
    assert arrival() == pytest.approx(NOW_S + now_s - 0.9)
    step_s = 30.0
    assert arrival() == pytest.approx(NOW_S + now_s + 30.0)


FORWARD = Lens(40.0, 30.0, pitch_deg=0.0, error_deg=0.0)


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(
    gaps=st.lists(st.floats(0.05, 0.2), min_size=1, max_size=4),
    rates=st.tuples(st.floats(-80, 80), st.floats(-150, 150)),
    begun=st.tuples(st.floats(-90, -60), st.floats(0, 360)),
    age_s=st.floats(0, 0.1),
    share=st.floats(0, 1),
)
def test_footprint_contains_view_of_moving_gimbal(
    gaps: list[float], rates: tuple[float, float], begun: tuple[float, float], age_s: float, share: float
) -> None:
    """The gimbal rotates at constant rates, also through straight down.

    In that direction, only the sum of roll and yaw is meaningful.
    """

    def turned(at_s: float) -> tuple[float, float, float]:
        return 0.0, begun[0] + rates[0] * (at_s - 100.0), (begun[1] + rates[1] * (at_s - 100.0)) % 360.0

    now_s = 100.0
    poses = PoseHistory(lambda: now_s, lens=FORWARD, gimbal=True)
    for gap_s in [0.0, *gaps]:
        now_s += gap_s
        send_gimbal(poses, now_s, turned(now_s - age_s), age_s)
    shown = exposure_footprint(poses.situations_since(100.0, 1.0), FRAME)
    assert shown is not None
    moment_s = 100.0 + share * (now_s - 100.0)
    exact = replace(poses.situation(1.0), attitude=Attitude(*turned(moment_s), 0.0, 0.0), position_error_m=0.0)
    actual = footprint(exact, FRAME)
    assert actual is not None
    assert shown.sight.buffer(shown.margin_m + 0.01).covers(actual.sight)


def test_footprint_is_unbounded_when_gimbal_attitude_is_unknown() -> None:
    now_s = 100.0
    poses = PoseHistory(lambda: now_s, lens=FORWARD, gimbal=True)
    send_gimbal(poses, 100.0, (0.0, -90.0, 0.0))
    now_s = 100.1
    known = poses.situation(1.0)
    assert attitude(known).tilt_error_deg == pytest.approx(
        pose_history.TILT_ERROR_DEG + 0.1 * pose_history.MAX_GIMBAL_TURN_DEG_S
    )
    assert attitude(known).yaw_error_deg == pytest.approx(
        pose_history.YAW_ERROR_DEG + 0.1 * pose_history.MAX_TURN_DEG_S
    )
    situations = []
    for turned, age_s in ((None, 0.0), ((0.0, -90.0, 0.0), 1.01), ((0.0, math.nan, 0.0), 0.0)):
        send_gimbal(poses, now_s, turned, age_s)
        situations.append(poses.situation(1.0))
    for now in situations:
        view = footprint(now, FRAME)
        assert view is None or math.isinf(view.farthest_m), (
            "the attitude of the airframe must not be used instead of an unknown gimbal attitude"
        )
    assert [now.attitude is None for now in situations] == [True, True, False]


def test_gimbal_camera_axis_follows_gimbal_attitude() -> None:
    camera = {"methods": ["CaptureImage"], "horizontalFieldOfView": 60, "lens": {"model": "pinhole"}}
    mounted = CameraFeatures.model_validate(camera | {"mount": {"pitch": -90, "stabilised": True, "gimbal": True}})
    lens = bounding_lens(mounted)
    assert lens is not None
    assert (lens.pitch_deg, lens.yaw_deg, lens.stabilised) == (0.0, 0.0, False)
    axis = camera_axes(lens, Attitude(0.0, -30.0, 90.0))[0]
    assert axis == pytest.approx((0.0, math.cos(math.radians(30)), math.sin(math.radians(30))))
