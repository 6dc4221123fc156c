"""Where a drone's camera was during an exposure, as its telemetry tells: no motion between two messages is left out."""

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
"""Unix time at the zero of the tests' monotonic clock."""
LENS = Lens(40.0, 30.0, pitch_deg=-60.0, error_deg=0.0)


class Drone:
    """Telemetry as a test tells it, on a clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.poses = PoseHistory(lambda: self.now_s, lens=LENS)

    def tell(
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
        message.position.latitude_deg, message.position.longitude_deg, message.position.altitude_m = lat, lon, alt
        message.velocity.east_mps, message.velocity.down_mps = speed
        message.attitude.roll_deg, message.attitude.pitch_deg, message.attitude.yaw_deg = turned
        message.home.latitude_deg, message.home.longitude_deg, message.home.altitude_m = HOME.lat, HOME.lon, 100.0
        if ages is not None:
            message.position_age_s, message.attitude_age_s = ages
        message.time.FromNanoseconds(round((NOW_S + at_s - late_s) * 1e9))
        self.poses.add(to_measurement(message, at_s, NOW_S + at_s))

    def way(self, begun_s: float) -> tuple[Situation, ...]:
        return self.poses.situations_since(begun_s, 1.0)


@pytest.fixture
def drone() -> Drone:
    return Drone()


def attitude(now: Situation) -> Any:
    assert now.attitude is not None
    return now.attitude


def test_every_pose_since_the_begin_counts_with_the_one_before_it(drone: Drone) -> None:
    for i in range(10):
        drone.tell(100.0 + i / 10, turned=(0.0, 0.0, 10.0 * i))
    way = drone.way(100.45)
    assert [attitude(now).yaw_deg for now in way] == [40, 50, 60, 70, 80, 90]
    # Half of what neighbours differ by, and what an airframe turns unseen in half a tenth of a second.
    assert attitude(way[1]).yaw_error_deg == pytest.approx(pose_history.YAW_ERROR_DEG + 5.0 + 0.05 * 60.0)
    assert attitude(way[1]).tilt_error_deg == pytest.approx(pose_history.TILT_ERROR_DEG + 0.05 * 60.0)
    assert drone.poses.situation(1.0).attitude is not None


def test_errors_grow_with_the_age_of_what_they_belong_to(drone: Drone) -> None:
    drone.tell(100.0, speed=(8.0, -3.0), ages=(0.2, 0.3))
    drone.now_s = 100.4
    now = drone.poses.situation(1.0)
    assert now.position_error_m == pytest.approx(1.0 + 8.0 * 0.6 + 2.5 * 0.36)
    assert now.altitude_error_m == pytest.approx(1.0 + 3.0 * 0.6 + 2.5 * 0.36)
    assert attitude(now).tilt_error_deg == pytest.approx(pose_history.TILT_ERROR_DEG + 60.0 * 0.7)
    drone.now_s = 100.75
    now = drone.poses.situation(1.0)
    assert now.lat is not None
    assert now.attitude is None, "measured more than a second ago"
    drone.now_s = 100.85
    assert drone.poses.situation(1.0).lat is None


def test_a_message_that_waited_tells_where_the_drone_was_when_it_was_made(drone: Drone) -> None:
    drone.tell(100.0, speed=(8.0, 0.0), late_s=0.4)
    now = drone.poses.situation(1.0)
    assert now.position_error_m == pytest.approx(1.0 + 8.0 * 0.4 + 2.5 * 0.16, abs=1e-4)
    assert attitude(now).tilt_error_deg == pytest.approx(pose_history.TILT_ERROR_DEG + 60.0 * 0.4, abs=1e-4)
    drone.tell(100.1, late_s=3.0)
    assert drone.poses.situation(1.0).lat is None
    drone.tell(100.2, late_s=-3600.0)
    assert drone.poses.situation(1.0).lat is None, "the clock was set back meanwhile: nothing tells how late it is"


def test_an_age_that_is_not_told_is_not_none(drone: Drone) -> None:
    drone.tell(100.0, ages=None)
    assert attitude(drone.poses.situation(1.0)).yaw_error_deg > pose_history.YAW_ERROR_DEG + 20.0


def test_where_a_part_of_the_exposure_was_not_told_it_is_unknown(drone: Drone) -> None:
    assert drone.poses.situation(1.0).lat is None
    assert [now.lat for now in drone.way(100.0)] == [None]
    drone.tell(100.0)
    assert drone.way(99.9)[0].lat is None, "nothing was told when it began"
    assert drone.way(100.0)[0].lat is not None
    drone.tell(101.1)
    assert drone.way(100.0)[0].lat is None, "silent for more than a second"
    drone.tell(101.2, connected=False)
    drone.tell(101.3)
    assert [now.lat is None for now in drone.way(101.1)] == [False, True, False]
    for i in range(400):
        drone.tell(102.0 + i / 10)
    assert len(drone.poses) <= 302
    assert drone.way(101.3)[0].lat is None, "longer ago than the history goes"


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(
    gaps=st.lists(st.floats(0.02, 0.5), min_size=2, max_size=5),
    rates=st.tuples(st.floats(-25, 25), st.floats(-25, 25), st.floats(-150, 150)),
    speed=st.tuples(st.floats(-12, 12), st.floats(-4, 4)),
    ages=st.tuples(st.floats(0, 0.2), st.floats(0, 0.2)),
    share=st.floats(0, 1),
)
def test_whatever_is_seen_between_two_messages_is_in_the_footprint(
    gaps: list[float], rates: tuple[float, ...], speed: tuple[float, float], ages: tuple[float, float], share: float
) -> None:
    """A drone that flies and turns steadily, told of at uneven times, each measurement with an age of its own."""
    drone = Drone()

    def turned(at_s: float) -> tuple[float, float, float]:
        since_s = at_s - 100.0
        return rates[0] * since_s, rates[1] * since_s, (rates[2] * since_s) % 360.0

    at_s = 100.0
    for gap_s in [0.0, *gaps]:
        at_s += gap_s
        measured_s = at_s - ages[0] - 100.0
        drone.tell(
            at_s, x=speed[0] * measured_s, alt=40.0 - speed[1] * measured_s, turned=turned(at_s - ages[1]), speed=speed,
            ages=ages,
        )  # fmt: skip
    shown = exposure_footprint(drone.way(100.0), FRAME)
    assert shown is not None
    moment_s = 100.0 + share * (at_s - 100.0)
    drone = Drone()
    drone.tell(
        moment_s, x=speed[0] * (moment_s - 100.0), alt=40.0 - speed[1] * (moment_s - 100.0), turned=turned(moment_s)
    )  # fmt: skip
    exact = drone.poses.situation(1.0)
    actual = footprint(exact, FRAME)
    assert actual is not None
    assert shown.farthest_m >= actual.farthest_m - shown.margin_m
    if math.isfinite(actual.farthest_m):
        assert shown.sight.buffer(shown.margin_m + 0.1).covers(actual.sight)


def gimbal_told(poses: PoseHistory, at_s: float, turned: tuple[float, float, float] | None, age_s: float = 0.0) -> None:
    """A level airframe, whose gimbal turns the camera."""
    message = mobility_pb2.Telemetry(autopilot_connected=True, position_error_m=1.0, position_age_s=0.0)
    message.position.latitude_deg, message.position.longitude_deg = FRAME.latlon(0.0, 0.0)
    message.position.altitude_m = 40.0
    message.home.latitude_deg, message.home.longitude_deg, message.home.altitude_m = HOME.lat, HOME.lon, 100.0
    message.attitude.yaw_deg, message.attitude_age_s = 0.0, 0.0
    if turned is not None:
        message.gimbal.roll_deg, message.gimbal.pitch_deg, message.gimbal.yaw_deg = turned
        message.gimbal_age_s = age_s
    poses.add(to_measurement(message, at_s, NOW_S + at_s, gimbal=True))


def test_a_message_from_the_future_says_nothing(drone: Drone) -> None:
    drone.tell(0.0, late_s=-1.0)
    drone.tell(0.1, late_s=-1.0)
    assert all(there.lat is None and there.attitude is None for there in drone.way(0.05))
    drone.tell(0.2, late_s=-0.01)
    assert drone.poses.situation(1.0).lat is not None, "what rounding makes of its time"


def test_a_clock_that_is_stepped_back_makes_no_late_message_younger() -> None:
    now_s, step_s = 0.0, 0.0
    arrival = ArrivalClock(lambda: NOW_S + now_s + step_s, lambda: now_s)
    assert arrival() == NOW_S
    now_s, step_s = 2.0, -0.9
    assert arrival() == NOW_S + 2.0, "a message that was made at 1 s has waited for a second"
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
def test_whatever_a_moving_gimbal_shows_is_in_the_footprint(
    gaps: list[float], rates: tuple[float, float], begun: tuple[float, float], age_s: float, share: float
) -> None:
    """A gimbal that turns steadily, about straight down as well, where roll and yaw say little one by one."""

    def turned(at_s: float) -> tuple[float, float, float]:
        return 0.0, begun[0] + rates[0] * (at_s - 100.0), (begun[1] + rates[1] * (at_s - 100.0)) % 360.0

    now_s = 100.0
    poses = PoseHistory(lambda: now_s, lens=FORWARD, gimbal=True)
    for gap_s in [0.0, *gaps]:
        now_s += gap_s
        gimbal_told(poses, now_s, turned(now_s - age_s), age_s)
    shown = exposure_footprint(poses.situations_since(100.0, 1.0), FRAME)
    assert shown is not None
    moment_s = 100.0 + share * (now_s - 100.0)
    exact = replace(poses.situation(1.0), attitude=Attitude(*turned(moment_s), 0.0, 0.0), position_error_m=0.0)
    actual = footprint(exact, FRAME)
    assert actual is not None
    assert shown.sight.buffer(shown.margin_m + 0.01).covers(actual.sight)


def test_a_gimbal_that_is_not_measured_lets_the_camera_look_anywhere() -> None:
    now_s = 100.0
    poses = PoseHistory(lambda: now_s, lens=FORWARD, gimbal=True)
    gimbal_told(poses, 100.0, (0.0, -90.0, 0.0))
    now_s = 100.1
    known = poses.situation(1.0)
    assert attitude(known).tilt_error_deg == pytest.approx(
        pose_history.TILT_ERROR_DEG + 0.1 * pose_history.MAX_GIMBAL_TURN_DEG_S
    )
    assert attitude(known).yaw_error_deg == pytest.approx(
        pose_history.YAW_ERROR_DEG + 0.1 * pose_history.MAX_TURN_DEG_S
    )
    told = []
    for turned, age_s in ((None, 0.0), ((0.0, -90.0, 0.0), 1.01), ((0.0, math.nan, 0.0), 0.0)):
        gimbal_told(poses, now_s, turned, age_s)
        told.append(poses.situation(1.0))
    for now in told:
        view = footprint(now, FRAME)
        assert view is None or math.isinf(view.farthest_m), "the airframe's attitude stands for none of a gimbal"
    assert [now.attitude is None for now in told] == [True, True, False]


def test_a_gimbals_camera_looks_where_its_attitude_points() -> None:
    camera = {"methods": ["CaptureImage"], "horizontalFieldOfView": 60, "lens": {"model": "pinhole"}}
    mounted = CameraFeatures.model_validate(camera | {"mount": {"pitch": -90, "stabilised": True, "gimbal": True}})
    lens = bounding_lens(mounted)
    assert lens is not None
    assert (lens.pitch_deg, lens.yaw_deg, lens.stabilised) == (0.0, 0.0, False)
    axis = camera_axes(lens, Attitude(0.0, -30.0, 90.0))[0]
    assert axis == pytest.approx((0.0, math.cos(math.radians(30)), math.sin(math.radians(30))))
