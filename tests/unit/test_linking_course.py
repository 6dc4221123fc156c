"""Where the drone will be, from telemetry and the path of its driver; against the projection of `fractus_core.geo`."""

from __future__ import annotations

import math

import pytest
from fractus_core.api.geometry import Position
from fractus_core.geo import LocalFrame
from fractus_core.linking.course import Course, Frame, Seen
from hypothesis import given
from hypothesis import strategies as st

HOME = (39.36, 22.94)
FRAME = LocalFrame(*HOME)


def place(east: float, north: float, alt: float | None = 10.0, reference: str = "home") -> Position:
    lat, lon = FRAME.latlon(east, north)
    return Position(lat=lat, lon=lon, alt=alt, altitude_reference=reference)


def seen(east: float, north: float, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), up: float = 10.0) -> Seen:
    lat, lon = FRAME.latlon(east, north)
    return Seen(lat, lon, up, 100.0, velocity)


@given(
    st.floats(-80, 80), st.floats(-180, 180), st.floats(-10_000, 10_000), st.floats(-10_000, 10_000)
)  # fmt: skip
def test_the_frame_agrees_with_the_projection(lat: float, lon: float, east: float, north: float) -> None:
    at = LocalFrame(lat, lon).latlon(east, north)
    x, y, up = Frame(lat, lon).position(*at, 5.0)
    assert math.hypot(x - east, y - north) <= 0.01 * math.hypot(east, north) + 1e-6
    assert up == 5.0


def test_distances_near_the_origin_are_right_to_a_decimetre() -> None:
    x, y, _ = Frame(*HOME).position(*FRAME.latlon(800.0, -600.0), 0.0)
    assert (x, y) == pytest.approx((800.0, -600.0), abs=0.1)


def test_heights_are_above_home_whatever_they_are_given_in() -> None:
    frame, here = Frame(*HOME), seen(0, 0, up=30.0)
    assert frame.place(place(0, 0, 120.0, "amsl"), here)[2] == pytest.approx(20.0)
    assert frame.place(place(0, 0, 7.0, "terrain"), here)[2] == 7.0
    assert frame.place(place(0, 0, None), here)[2] == 30.0


PATH = [place(0, 0), place(100, 0), place(100, 100)]


def ahead(course: Course, at: Seen) -> int:
    return len(course.track(at)[1].waypoints)


def test_waypoints_that_were_reached_do_not_come_again() -> None:
    course = Course(PATH)
    assert ahead(course, seen(-50, 0, (3, 0, 0))) == 3
    assert ahead(course, seen(0, 1, (3, 0, 0))) == 2
    assert ahead(course, seen(60, 0, (3, 0, 0))) == 2
    assert ahead(course, seen(96, 2, (3, 0, 0))) == 1
    assert ahead(course, seen(100, 50, (0, 3, 0))) == 1
    assert ahead(course, seen(100, 99, (0, 3, 0))) == 0


def test_a_corner_that_is_cut_is_behind_the_drone() -> None:
    course = Course(PATH)
    course.track(seen(0, 0, (3, 0, 0)))
    assert ahead(course, seen(92, 30, (1, 3, 0))) == 1


def test_a_path_is_flown_again() -> None:
    course = Course([*PATH, place(0, 0)])
    for east, north in ((0, 0), (100, 0), (100, 100)):
        course.track(seen(east, north, (3, 0, 0)))
    assert ahead(course, seen(0, 1, (3, 0, 0))) == 0
    assert ahead(course, seen(1, 0, (3, 0, 0))) == 3


def test_an_agent_that_starts_in_flight_finds_its_leg() -> None:
    assert ahead(Course(PATH), seen(100, 50, (0, 3, 0))) == 1


def test_a_drone_that_leaves_its_path_is_predicted_by_its_velocity() -> None:
    course = Course(PATH)
    course.track(seen(0, 0, (3, 0, 0)))
    _, track = course.track(seen(50, 20, (-3, 0, 0)))
    assert (track.waypoints, track.velocity_mps) == ((), (-3, 0, 0))
    assert ahead(course, seen(50, 0, (3, 0, 0))) == 2


def test_a_drone_that_hovers_stays() -> None:
    _, track = Course(PATH).track(seen(50, 0, (0.1, 0.0, 0.0)))
    assert (track.waypoints, track.velocity_mps) == ((), (0.0, 0.0, 0.0))


def test_region_navigation_knows_the_velocity_only() -> None:
    _, track = Course(()).track(seen(0, 0, (0.0, 4.0, 0.0)))
    assert (track.waypoints, track.velocity_mps) == ((), (0.0, 4.0, 0.0))
