"""Local frame and areas, compared with geodesics and analytic formulas."""

import itertools
import math

import numpy as np
import pytest
import shapely
from fractus_core.api import InvalidObject
from fractus_core.api.geometry import Area, Circle, Point, Polygon
from fractus_core.geo import (
    LocalFrame,
    area_polygon,
    areas_of_shape,
    center_of,
    corridor,
    count_crossings,
    cut_path,
    geodesic_m,
    multipolygon_geojson,
)
from hypothesis import assume, given
from hypothesis import strategies as st

latitudes = st.floats(-89.9, 89.9)
longitudes = st.floats(-180, 180)


@given(latitudes, longitudes, st.floats(0, 2 * math.pi), st.floats(1, 50_000))
def test_local_frame_distances_match_geodesic_distances(lat, lon, bearing, distance):
    frame = LocalFrame(lat, lon)
    x = distance * math.sin(bearing)
    y = distance * math.cos(bearing)
    target_lat, target_lon = frame.latlon(x, y)
    geodesic = geodesic_m(Point(lat=lat, lon=lon), Point(lat=target_lat, lon=target_lon))
    assert geodesic == pytest.approx(distance, rel=1e-3)


@given(latitudes, longitudes, st.floats(-50_000, 50_000), st.floats(-50_000, 50_000))
def test_local_frame_conversion_round_trips(lat, lon, x, y):
    frame = LocalFrame(lat, lon)
    assert frame.xy(*frame.latlon(x, y)) == pytest.approx((x, y), abs=1e-3)


def test_local_frame_rejects_points_beyond_the_horizon():
    with pytest.raises(ValueError, match="beyond the horizon"):
        LocalFrame(10, 20).latlon(9_000_000, 0)
    with pytest.raises(ValueError, match="beyond the horizon"):
        LocalFrame(10, 20).latlon_array(np.array([[5.0, 5.0], [9_000_000.0, 1.0]]))


@pytest.mark.parametrize("origin", [(0.0, 0.0), (39.36, 22.95), (-80.0, 179.99), (90.0, 0.0)])
def test_local_frame_array_conversion_matches_single_conversion(origin):
    frame = LocalFrame(*origin)
    xy = np.array([(x, y) for x in (-5e4, -3.0, 0.0, 120.5) for y in (-40.0, 0.0, 3e4)])
    lats, lons = frame.latlon_array(xy)
    for (x, y), lat, lon in zip(xy.tolist(), lats.tolist(), lons.tolist(), strict=True):
        assert (lat, lon) == pytest.approx(frame.latlon(x, y), abs=1e-10)
    assert frame.xy_array(lats, lons) == pytest.approx(xy, abs=1e-6)


@pytest.mark.parametrize("lat", [0, 45, 80, -80])
@pytest.mark.parametrize("lon", [0, 179.9999, -180])
def test_circle_has_the_right_area_anywhere(lat, lon):
    area = Area(circle=Circle(center=Point(lat=lat, lon=lon), radius=500))
    shape = area_polygon(LocalFrame(lat, lon), area)
    assert shape.area == pytest.approx(math.pi * 500**2, rel=5e-3)
    assert shape.area >= math.pi * 500**2


@pytest.mark.parametrize(("radius", "pieces"), [(1e-6, 32), (0.5, 32), (7, 60), (33, 128), (500, 128), (40_000, 128)])
def test_circles_and_corridors_are_circumscribed_tightly(radius, pieces):
    frame = LocalFrame(50, 4)
    center = Point(lat=50, lon=4)
    exact = shapely.Point(0, 0).buffer(radius, quad_segs=2000)
    for shape in (
        area_polygon(frame, Area(circle=Circle(center=center, radius=radius))),
        corridor(frame, [center], radius),
    ):
        assert shape.buffer(1e-12).covers(exact)
        assert shape.area == pytest.approx(exact.area, rel=4e-3)
        corners = shapely.get_coordinates(shape)[:-1]
        assert len(corners) == pieces
        beyond = max(math.hypot(x, y) for x, y in corners) - radius
        assert beyond <= max(0.0101, 3.2e-4 * radius)


@given(latitudes, longitudes, st.floats(1, 200_000), st.floats(0, 300_000), st.floats(0, math.tau))
def test_inscribed_circle_is_never_larger_than_the_circle(lat, lon, radius, away, bearing):
    """The frame shortens distances far from its origin, so the test uses circles at various distances."""
    frame = LocalFrame(lat, lon)
    centre_lat, centre_lon = frame.latlon(away * math.sin(bearing), away * math.cos(bearing))
    centre = Point(lat=centre_lat, lon=centre_lon)
    shape = area_polygon(frame, Area(circle=Circle(center=centre, radius=radius)), within=True)
    for x, y in shapely.get_coordinates(shape)[::16]:
        corner_lat, corner_lon = frame.latlon(x, y)
        assert geodesic_m(centre, Point(lat=corner_lat, lon=corner_lon)) <= radius + 1e-6
    assert shape.area >= math.pi * radius**2 * (0.99 if away < 50_000 else 0.98)


@given(st.floats(1, 200), st.floats(-9, 3), st.floats(0, math.tau))
def test_corridor_covers_short_legs(radius, magnitude, direction):
    frame = LocalFrame(50, 4)
    length = 10**magnitude
    legs = [(0.0, 0.0), (length * math.sin(direction), length * math.cos(direction))]
    points = [Point(lat=lat, lon=lon) for lat, lon in (frame.latlon(*leg) for leg in legs)]
    shape = corridor(frame, points, radius)
    line = shapely.LineString([frame.xy(p.lat, p.lon) for p in points])
    assert shape.covers(line)
    assert shape.exterior.distance(line) >= radius


def square(lat, lon, half):
    corners = [(-half, -half), (-half, half), (half, half), (half, -half)]
    wrap = lambda v: (v + 180) % 360 - 180  # noqa: E731
    return tuple(Point(lat=lat + a, lon=wrap(lon + b)) for a, b in corners)


def test_polygon_across_the_antimeridian_is_small():
    ring = square(10, 180, 0.01)
    shape = area_polygon(LocalFrame(10, 180), Area(polygon=Polygon(exterior=ring)))
    assert shape.area == pytest.approx(2211.9 * 2193.0, rel=5e-3)
    collection = multipolygon_geojson(LocalFrame(10, 180), shape)
    assert len(collection["coordinates"]) == 2
    assert all(-180 <= lon <= 180 for part in collection["coordinates"] for lon, _ in part[0])


@given(
    st.sampled_from([90.0, -90.0]),
    st.floats(0, 3000),
    longitudes,
    st.floats(5, 3000),
    st.lists(st.tuples(st.floats(0, 2 * math.pi), st.sampled_from([0.0, 0.5, 0.9, 1.1, 2.0])), min_size=5, max_size=20),
)
def test_geojson_of_circles_at_the_poles_covers_the_same_area(pole, off, lon, radius, places):
    # Near the pole, a straight edge is curved in degrees, even if the edge is short.
    assume(abs(off - radius) > 0.2 * radius)
    lat = pole - math.copysign(off / 111_694, pole)
    frame = LocalFrame(lat, lon)
    shape = area_polygon(frame, Area(circle=Circle(center=Point(lat=lat, lon=lon), radius=radius)))
    drawn = [
        shapely.Polygon(*map(list, (part[0], part[1:]))) for part in multipolygon_geojson(frame, shape)["coordinates"]
    ]
    assert all(part.is_valid for part in drawn)
    for bearing, share in places:
        x = share * radius * math.sin(bearing)
        y = share * radius * math.cos(bearing)
        target_lat, target_lon = frame.latlon(x, y)
        assert any(part.covers(shapely.Point(target_lon, target_lat)) for part in drawn) == (share < 1)


def test_self_crossing_ring_error_names_ring_and_place():
    a, b, c, d = square(0, 0, 0.01)
    with pytest.raises(InvalidObject, match=r"polygon\.exterior: the ring crosses itself near lat -?0\.0"):
        area_polygon(LocalFrame(0, 0), Area(polygon=Polygon(exterior=(a, c, b, d))))


def test_ring_without_area_is_rejected():
    line = tuple(Point(lat=0, lon=v) for v in (0, 0.1, 0.2))
    with pytest.raises(InvalidObject, match=r"polygon\.exterior"):
        area_polygon(LocalFrame(0, 0), Area(polygon=Polygon(exterior=line)))


def test_hole_outside_exterior_is_rejected():
    with pytest.raises(InvalidObject, match=r"holes\[0\]"):
        area_polygon(LocalFrame(0, 0), Area(polygon=Polygon(exterior=square(0, 0, 0.01), holes=(square(1, 1, 0.01),))))


def test_corridor_covers_points_within_its_radius():
    frame = LocalFrame(47, 8)
    points = [Point(lat=47, lon=8), Point(lat=47.002, lon=8), Point(lat=47.002, lon=8.002)]
    shape = corridor(frame, points, 7)
    x, y = frame.xy(47.001, 8)
    assert shape.covers(shapely.Point(x + 6.999, y))
    assert not shape.covers(shapely.Point(x + 7.05, y))


@given(latitudes, longitudes)
def test_areas_of_shape_round_trip(lat, lon):
    frame = LocalFrame(lat, lon)
    shape = shapely.Polygon([(0, 0), (100, 0), (100, 80), (0, 80)], [[(10, 10), (20, 10), (20, 20)]])
    (area,) = areas_of_shape(frame, shape)
    assert area_polygon(frame, area).symmetric_difference(shape).area < 0.5


def test_center_is_correct_across_the_antimeridian():
    middle = center_of([Point(lat=0, lon=179), Point(lat=0, lon=-179)])
    assert abs(middle.lon) == pytest.approx(180)


def test_corridor_of_self_crossing_path_equals_dilated_path():
    frame = LocalFrame(50, 4)
    turns = [
        frame.latlon(300 * math.sin(math.tau * i * 0.497), 300 * math.cos(math.tau * i * 0.497)) for i in range(60)
    ]
    points = [Point(lat=lat, lon=lon) for lat, lon in turns]
    whole = shapely.LineString([frame.xy(*t) for t in turns]).buffer(7, quad_segs=32)
    shape = corridor(frame, points, 7)
    assert shape.covers(whole)
    assert shape.area == pytest.approx(whole.area, rel=2e-3)


def test_crossings_count_matches_pairwise_comparison():
    rng = np.random.default_rng(7)
    for corners in (2, 3, 30, 200):
        lines = [rng.uniform(-100, 100, (corners, 2)) for _ in range(3)]
        pieces = [shapely.LineString(pair) for line in lines for pair in itertools.pairwise(line)]
        expected = sum(a.crosses(b) for a, b in itertools.combinations(pieces, 2))
        assert count_crossings(lines, 10**9) == expected
        assert count_crossings(lines, expected) == expected
        assert (expected == 0) or count_crossings(lines, expected - 1) == expected
    assert count_crossings([], 5) == 0


def test_crossings_exclude_touching_and_overlapping_lines():
    square = np.array([[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]], dtype=float)
    assert count_crossings([square, square, np.add(square, (10, 0))], 100) == 0


def test_crossings_of_too_many_parallel_pieces_exceed_the_limit():
    teeth = np.array([[i + (i % 2) * 1e4, -i + (i % 2) * 1e4] for i in range(10_000)], dtype=float)
    assert count_crossings([teeth], 5000) == 5001
    assert count_crossings([teeth[:2000]], 5000) == 0


def test_geojson_rings_across_the_antimeridian_are_closed_without_repeated_corners():
    for lon in (179.9999, -179.9998):
        for radius in (20.0, 137.3, 900.0):
            frame = LocalFrame(-41.0, lon)
            for part in multipolygon_geojson(frame, shapely.Point(3.0, 5.0).buffer(radius))["coordinates"]:
                for ring in part:
                    assert ring[0] == ring[-1]
                    assert all(a != b for a, b in itertools.pairwise(ring))


def test_path_across_the_antimeridian_is_cut_with_interpolated_values():
    path = [(179.9, 10.0, 30.0), (-179.7, 10.4, 34.0), (-179.9, 10.0, 30.0), (179.9, 10.0, 30.0)]
    first, second, third = cut_path(path)
    assert first == [path[0], pytest.approx((180.0, 10.1, 31.0))]
    assert second == [pytest.approx((-180.0, 10.1, 31.0)), *path[1:3], pytest.approx((-180.0, 10.0, 30.0))]
    assert third == [pytest.approx((180.0, 10.0, 30.0)), path[3]]


@pytest.mark.parametrize("edge", [180.0, -180.0])
def test_path_that_touches_the_antimeridian_has_no_leg_around_the_world(edge):
    for path in ([(179.9, 1.0), (edge, 1.0), (-179.9, 1.0)], [(179.9, 1.0), (edge, 1.0), (179.9, 1.0)]):
        parts = cut_path(path)
        assert all(abs(a[0] - b[0]) < 1 for part in parts for a, b in itertools.pairwise(part))
        assert all(parts)


def test_path_without_a_crossing_is_one_part():
    assert cut_path([(1.0, 2.0), (3.0, 4.0)]) == [[(1.0, 2.0), (3.0, 4.0)]]
    assert cut_path([]) == []
