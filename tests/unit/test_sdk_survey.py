"""`fractus.survey`: lines that cover a region."""

from __future__ import annotations

import itertools
import math

import fractus
import pytest
import shapely
from fractus.control_point import Circle, Polygon, Region
from fractus.values import AltitudeReference, Position
from hypothesis import given
from hypothesis import strategies as st

METRE = 1 / 111_195.0
"""Degrees of latitude per metre."""


def region_of(
    corners: list[tuple[float, float]],
    lat: float = 50.0,
    lon: float = 4.0,
    holes: list[list[tuple[float, float]]] | None = None,
) -> Polygon:
    """Return a polygon from corners in metres east and north."""

    def corner(east: float, north: float) -> Position:
        degrees = lon + east * METRE / math.cos(math.radians(lat))
        return Position(lat + north * METRE, (degrees + 180) % 360 - 180)

    return Polygon(tuple(corner(*c) for c in corners), tuple(tuple(corner(*c) for c in hole) for hole in holes or []))


def metres(region: Region, waypoints: tuple[fractus.Waypoint, ...]) -> list[tuple[float, float]]:
    origin = region.center if isinstance(region, Circle) else region.exterior[0]
    east_m = math.cos(math.radians(origin.lat)) / METRE
    positions = [w.position for w in waypoints]
    return [(((p.lon - origin.lon + 180) % 360 - 180) * east_m, (p.lat - origin.lat) / METRE) for p in positions]


SQUARE = [(0.0, 0.0), (100.0, 0.0), (100.0, 60.0), (0.0, 60.0)]


def test_survey_of_rectangle_flies_its_long_side_with_margin() -> None:
    region = region_of(SQUARE)
    waypoints = fractus.survey(region, 20, 30)
    points = metres(region, waypoints)
    assert len(points) == 6
    assert all(p.position.alt == 30 and p.position.reference is AltitudeReference.HOME for p in waypoints)
    assert {round(north) for _, north in points} == {10, 30, 50}
    assert {round(east) for east, _ in points} == {10, 90}
    assert [round(math.dist(a, b)) for a, b in itertools.pairwise(points)] == [80, 20, 80, 20, 80]
    seen = shapely.LineString(points).buffer(14.2)  # half the diagonal of a square picture of 20 m
    assert seen.covers(shapely.Polygon(SQUARE)), "the camera sees the whole region"


def test_survey_across_antimeridian_stays_in_region() -> None:
    region = region_of(SQUARE, lat=-17.0, lon=179.9995)
    points = metres(region, fractus.survey(region, 20, 30))
    assert all(9 < east < 91 and 9 < north < 51 for east, north in points)


def test_survey_of_circle_stays_in_circle() -> None:
    region = Circle(Position(50.0, 4.0), 80.0)
    points = metres(region, fractus.survey(region, 25, 30, margin_m=5))
    assert all(math.hypot(*point) <= 75.05 for point in points)
    assert len(points) == 12


def test_survey_chooses_direction_in_which_no_leg_leaves_concave_region() -> None:
    u_shape = [
        (0.0, 0.0),
        (120.0, 0.0),
        (120.0, 100.0),
        (80.0, 100.0),
        (80.0, 30.0),
        (40.0, 30.0),
        (40.0, 100.0),
        (0.0, 100.0),
    ]
    points = metres(region_of(u_shape), fractus.survey(region_of(u_shape), 20, 30))
    assert shapely.LineString(points).within(shapely.Polygon(u_shape).buffer(0.1))
    with pytest.raises(fractus.InvalidRequest, match="split the region"):
        fractus.survey(region_of(u_shape), 20, 30, heading_deg=90)


def test_survey_refuses_region_with_hole_between_lines() -> None:
    region = region_of(SQUARE, holes=[[(40.0, 20.0), (60.0, 20.0), (60.0, 40.0), (40.0, 40.0)]])
    with pytest.raises(fractus.InvalidRequest, match="hole"):
        fractus.survey(region, 5, 30)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spacing_m": 0, "altitude_m": 30}, "spacing_m must be above 0 m"),
        ({"spacing_m": math.nan, "altitude_m": 30}, "spacing_m must be above 0 m"),
        ({"spacing_m": 20, "altitude_m": math.nan}, "altitude_m must be a number"),
        ({"spacing_m": 20, "altitude_m": 30, "margin_m": -1}, "margin_m must be at least 0 m"),
        ({"spacing_m": 200, "altitude_m": 30}, "decrease margin_m or spacing_m"),
        ({"spacing_m": 0.001, "altitude_m": 30}, "increase spacing_m"),
    ],
)
def test_survey_names_argument_out_of_range(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(fractus.InvalidRequest, match=message):
        fractus.survey(region_of(SQUARE), **arguments)


def test_survey_refuses_border_that_crosses_itself() -> None:
    with pytest.raises(fractus.InvalidRequest, match="crosses itself"):
        fractus.survey(region_of([(0.0, 0.0), (100.0, 60.0), (100.0, 0.0), (0.0, 60.0)]), 20, 30)


@given(
    st.lists(st.tuples(st.floats(0, 400), st.floats(0, 400)), min_size=3, max_size=8),
    st.floats(8, 60),
    st.floats(-80, 80),
)
def test_survey_of_convex_region_stays_in_region(
    corners: list[tuple[float, float]], spacing: float, lat: float
) -> None:
    hull = shapely.MultiPoint(corners).convex_hull
    if not isinstance(hull, shapely.Polygon) or hull.buffer(-spacing).is_empty:
        return
    region = region_of([(float(x), float(y)) for x, y in hull.exterior.coords[:-1]], lat=lat)
    points = metres(region, fractus.survey(region, spacing, 30))
    x, y = hull.exterior.coords[0]
    area = shapely.affinity.translate(hull, -x, -y)
    assert shapely.LineString(points).within(area.buffer(0.1))
