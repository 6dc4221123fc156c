"""Trajectory estimates from telemetry and the announced path."""

from __future__ import annotations

import pytest
from fractus_core.api.geometry import Position
from fractus_core.geo import LocalFrame
from fractus_core.linking.trajectory_estimator import TelemetrySample, TrajectoryEstimator, local_position

HOME = (39.36, 22.94)
FRAME = LocalFrame(*HOME)


def waypoint(east: float, north: float, alt: float | None = 10.0, reference: str = "home") -> Position:
    lat, lon = FRAME.latlon(east, north)
    return Position(lat=lat, lon=lon, alt=alt, altitude_reference=reference)


def sample(
    east: float, north: float, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), up: float = 10.0
) -> TelemetrySample:
    lat, lon = FRAME.latlon(east, north)
    return TelemetrySample(lat, lon, up, 100.0, velocity)


def test_altitudes_of_every_reference_are_converted_to_metres_above_home() -> None:
    telemetry = sample(0, 0, up=30.0)
    assert local_position(FRAME, waypoint(0, 0, 120.0, "amsl"), telemetry)[2] == pytest.approx(20.0)
    assert local_position(FRAME, waypoint(0, 0, 7.0, "terrain"), telemetry)[2] == 7.0
    assert local_position(FRAME, waypoint(0, 0, None), telemetry)[2] == 30.0


PATH = [waypoint(0, 0), waypoint(100, 0), waypoint(100, 100)]


def remaining(estimator: TrajectoryEstimator, telemetry: TelemetrySample) -> int:
    return len(estimator.estimate(telemetry)[1].waypoints)


def test_reached_waypoints_are_not_remaining() -> None:
    estimator = TrajectoryEstimator(PATH)
    assert remaining(estimator, sample(-50, 0, (3, 0, 0))) == 3
    assert remaining(estimator, sample(0, 1, (3, 0, 0))) == 2
    assert remaining(estimator, sample(60, 0, (3, 0, 0))) == 2
    assert remaining(estimator, sample(96, 2, (3, 0, 0))) == 1
    assert remaining(estimator, sample(100, 50, (0, 3, 0))) == 1
    assert remaining(estimator, sample(100, 99, (0, 3, 0))) == 0


def test_waypoint_counts_as_passed_when_the_corner_is_cut() -> None:
    estimator = TrajectoryEstimator(PATH)
    estimator.estimate(sample(0, 0, (3, 0, 0)))
    assert remaining(estimator, sample(92, 30, (1, 3, 0))) == 1


def test_closed_path_starts_again_at_its_first_waypoint() -> None:
    estimator = TrajectoryEstimator([*PATH, waypoint(0, 0)])
    for east, north in ((0, 0), (100, 0), (100, 100)):
        estimator.estimate(sample(east, north, (3, 0, 0)))
    assert remaining(estimator, sample(0, 1, (3, 0, 0))) == 0
    assert remaining(estimator, sample(1, 0, (3, 0, 0))) == 3


def test_estimator_started_in_flight_finds_the_current_leg() -> None:
    assert remaining(TrajectoryEstimator(PATH), sample(100, 50, (0, 3, 0))) == 1


def test_drone_off_its_path_is_predicted_by_its_velocity() -> None:
    estimator = TrajectoryEstimator(PATH)
    estimator.estimate(sample(0, 0, (3, 0, 0)))
    _, track = estimator.estimate(sample(50, 20, (-3, 0, 0)))
    assert (track.waypoints, track.velocity_mps) == ((), (-3, 0, 0))
    assert remaining(estimator, sample(50, 0, (3, 0, 0))) == 2


def test_hovering_drone_is_predicted_to_stay() -> None:
    _, track = TrajectoryEstimator(PATH).estimate(sample(50, 0, (0.1, 0.0, 0.0)))
    assert (track.waypoints, track.velocity_mps) == ((), (0.0, 0.0, 0.0))


def test_region_navigation_uses_the_velocity_only() -> None:
    _, track = TrajectoryEstimator(()).estimate(sample(0, 0, (0.0, 4.0, 0.0)))
    assert (track.waypoints, track.velocity_mps) == ((), (0.0, 4.0, 0.0))
