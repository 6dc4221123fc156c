"""SpatialIndex compared with brute force over geodesic distances, including the antimeridian and the poles."""

import math
import time

import pytest
import shapely
from depth import examples
from fractus_core.api.geometry import Point
from fractus_core.geo import LocalFrame, distance_m, geodesic_m
from fractus_core.planning import SpatialIndex
from geographiclib.geodesic import Geodesic
from hypothesis import assume, given, settings
from hypothesis import strategies as st

latitudes = st.one_of(st.floats(-90, 90), st.sampled_from([90.0, -90.0, 89.9999, 0.0]))
longitudes = st.one_of(st.floats(-180, 180), st.sampled_from([180.0, -180.0, 179.9999, 0.0]))
places = st.builds(lambda lat, lon: Point(lat=lat, lon=lon), latitudes, longitudes)


def destination(place, bearing_deg, distance):
    target = Geodesic.WGS84.Direct(place.lat, place.lon, bearing_deg, distance)
    return Point(lat=target["lat2"], lon=target["lon2"])


def brute_force(points, centre, radius):
    """Return the names within a radius with their distances, in the documented order."""
    near = [(name, geodesic_m(centre, p)) for name, p in points.items()]
    return sorted(((n, d) for n, d in near if d <= radius), key=lambda x: (round(x[1] * 1000), x[0]))


def index_of(points):
    return SpatialIndex.of((name, p.lat, p.lon) for name, p in points.items())


@given(places, st.floats(1, 300_000), st.lists(st.tuples(st.floats(0, 360), st.floats(0, 2.5)), max_size=25))
@settings(deadline=None)
def test_within_equals_brute_force_anywhere_on_earth(centre, radius, spread):
    points = {f"n{i:02d}": destination(centre, b, share * radius) for i, (b, share) in enumerate(spread)}
    points |= {f"edge{i}": destination(centre, 77.0 * i, radius + d) for i, d in enumerate((-1e-3, 1e-3, -1.0, 1.0))}
    result = index_of(points).within(centre, radius)
    expected = brute_force(points, centre, radius)
    assert {n for n, _ in result} == {n for n, _ in expected}
    assert [round(d, 3) for _, d in result] == pytest.approx([round(d, 3) for _, d in expected], abs=2e-3)


@given(places, st.lists(places, max_size=12), st.floats(300_000, 2e7))
@settings(max_examples=examples(60), deadline=None)
def test_within_equals_brute_force_for_huge_radii(centre, other_points, radius):
    points = {f"n{i}": p for i, p in enumerate(other_points)}
    result = index_of(points).within(centre, radius)
    expected = brute_force(points, centre, radius)
    assert [n for n, _ in result] == [n for n, _ in expected]
    assert [d for _, d in result] == pytest.approx([d for _, d in expected], abs=1e-4)


def test_within_returns_points_across_the_antimeridian_and_the_pole():
    points = {"east": Point(lat=10, lon=-179.9995), "west": Point(lat=10, lon=179.9995)}
    points |= {f"polar{i}": Point(lat=89.9999, lon=-180 + 60 * i) for i in range(6)}
    index = index_of(points)
    assert [n for n, _ in index.within(Point(lat=10, lon=180), 100)] == ["east", "west"]
    assert [n for n, _ in index.within(Point(lat=90, lon=12), 12)] == [f"polar{i}" for i in range(6)]


def test_within_orders_equal_distances_by_name():
    centre = Point(lat=39, lon=23)
    points = {name: destination(centre, bearing, 100) for name, bearing in (("c", 0), ("a", 90), ("b", 270))}
    assert [n for n, _ in index_of(points).within(centre, 200)] == ["a", "b", "c"]


operations = st.lists(
    st.tuples(st.sampled_from("abcdef"), st.one_of(st.none(), st.tuples(st.floats(0, 360), st.floats(0, 3000)))),
    max_size=40,
)


@given(places, operations)
@settings(deadline=None)
def test_index_after_updates_equals_a_new_index(centre, changes):
    index = SpatialIndex()
    points = {}
    for name, target in changes:
        if target is None:
            index.remove(name)
            points.pop(name, None)
        else:
            points[name] = destination(centre, *target)
            index.upsert(name, points[name].lat, points[name].lon)
        assert len(index) == len(points)
    for radius in (100, 1500, 5000, 1e6):
        assert index.within(centre, radius) == index_of(points).within(centre, radius)


@given(
    places,
    st.integers(0, 8),
    st.floats(0, 2000),
    st.lists(st.tuples(st.floats(0, 360), st.floats(1, 50_000)), max_size=20),
)
@settings(deadline=None)
def test_nearest_equals_brute_force_beyond_a_radius(centre, count, beyond, spread):
    points = {f"n{i:02d}": destination(centre, b, d) for i, (b, d) in enumerate(spread)}
    assume(all(abs(geodesic_m(centre, p) - beyond) > 1e-3 for p in points.values()))
    expected = [n for n, d in brute_force(points, centre, 1e5) if d > beyond][:count]
    assert [n for n, _ in index_of(points).nearest(centre, count, beyond)] == expected


@given(
    st.floats(-89.5, 89.5),
    st.floats(-180, 180),
    st.lists(st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000)), min_size=2, max_size=8, unique=True),
    st.lists(st.tuples(st.floats(-4000, 4000), st.floats(-4000, 4000)), max_size=30),
    st.floats(0.5, 500),
)
@settings(deadline=None)
def test_near_area_returns_exactly_the_points_within_the_margin(lat, lon, path, spots, margin):
    frame = LocalFrame(lat, lon)
    shape = shapely.LineString(path).buffer(10)
    points = {f"n{i:02d}": frame.latlon(x, y) for i, (x, y) in enumerate(spots)}
    index = SpatialIndex.of((n, *p) for n, p in points.items())
    index.upsert("behind", -lat, (lon + 360) % 360 - 180)
    names, xy = index.near_area(frame, shape, margin)
    distances = {n: shape.distance(shapely.Point(frame.xy(*p))) for n, p in points.items()}
    sure = {n for n, d in distances.items() if d <= margin - 1e-6}
    possible = {n for n, d in distances.items() if d <= margin + 1e-6}
    assert names == sorted(names)
    assert sure <= set(names) <= possible
    for name, (x, y) in zip(names, xy, strict=True):
        assert (x, y) == pytest.approx(frame.xy(*points[name]), abs=1e-3)


@given(places, st.floats(0, 360), st.floats(0, 60_000))
@settings(deadline=None)
def test_distance_equals_the_geodesic_up_to_60_km(a, bearing, length):
    b = destination(a, bearing, length)
    assert distance_m(a, b) == pytest.approx(geodesic_m(a, b), abs=1e-6)


@given(places, places)
@settings(max_examples=examples(50), deadline=None)
def test_distance_equals_the_geodesic_around_the_globe(a, b):
    assert distance_m(a, b) == pytest.approx(geodesic_m(a, b), abs=1e-4)


def test_upsert_takes_less_than_a_millisecond_among_40000_points():
    frame = LocalFrame(39, 23)
    side = 200
    index = SpatialIndex.of((f"n{i}", *frame.latlon(90 * (i % side), 90 * (i // side))) for i in range(side * side))
    moves = [(f"n{i * 37 % side**2}", *frame.latlon(50 + i, 70 * i)) for i in range(200)]
    started = time.perf_counter()
    for move in moves:
        index.upsert(*move)
    assert (time.perf_counter() - started) / len(moves) < 1e-3
    name, lat, lon = moves[-1]
    assert index.within(Point(lat=lat, lon=lon), 0.01)[0][0] == name
    assert math.isclose(index.position(name).lat, lat)


def test_nearest_orders_equal_distances_at_the_limit_by_name():
    centre = Point(lat=50, lon=4)
    points = {"b": destination(centre, 10, 127.9998), "a": destination(centre, 200, 128.0002)}
    assert [n for n, _ in index_of(points).nearest(centre, 1)] == ["a"]
    assert index_of(points).nearest(centre, 2) == index_of(points).within(centre, 200)


@given(places, st.integers(1, 8), st.floats(0, 2e7), st.floats(1e5, 2e7), st.lists(places, max_size=12))
@settings(max_examples=examples(60), deadline=None)
def test_nearest_equals_brute_force_at_any_distance(centre, count, beyond, limit, other_points):
    points = {f"n{i:02d}": p for i, p in enumerate(other_points)}
    distances = {n: geodesic_m(centre, p) for n, p in points.items()}
    assume(all(abs(d - beyond) > 1e-3 and abs(d - limit) > 1e-3 for d in distances.values()))
    expected = [n for n, d in brute_force(points, centre, limit) if d > beyond][:count]
    assert [n for n, _ in index_of(points).nearest(centre, count, beyond, limit)] == expected


def test_removed_points_are_never_returned():
    index = index_of({"a": Point(lat=1, lon=2), "b": Point(lat=1, lon=3)})
    index.remove("a")
    assert [n for n, _ in index.within(Point(lat=0, lon=0), math.inf)] == ["b"]
    assert [n for n, _ in index.nearest(Point(lat=0, lon=0), 5, 0, math.inf)] == ["b"]


@pytest.mark.parametrize("lat", [0.0, 45.0, -80.0])
def test_within_finds_longitude_minus_180_from_180(lat):
    index = SpatialIndex.of([("west", lat, -180.0)])
    assert index.within(Point(lat=lat, lon=180.0), 0.0) == [("west", 0.0)]
