"""The spatial index against geodesics to every point."""

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


def away(place, bearing_deg, distance):
    there = Geodesic.WGS84.Direct(place.lat, place.lon, bearing_deg, distance)
    return Point(lat=there["lat2"], lon=there["lon2"])


def brute(points, centre, radius):
    """Every name with its geodesic distance, in the order that the index promises."""
    near = [(name, geodesic_m(centre, p)) for name, p in points.items()]
    return sorted(((n, d) for n, d in near if d <= radius), key=lambda x: (round(x[1] * 1000), x[0]))


def index_of(points):
    return SpatialIndex.of((name, p.lat, p.lon) for name, p in points.items())


@given(places, st.floats(1, 300_000), st.lists(st.tuples(st.floats(0, 360), st.floats(0, 2.5)), max_size=25))
@settings(deadline=None)
def test_within_is_exact_anywhere_on_earth(centre, radius, spread):
    points = {f"n{i:02d}": away(centre, b, share * radius) for i, (b, share) in enumerate(spread)}
    points |= {f"edge{i}": away(centre, 77.0 * i, radius + d) for i, d in enumerate((-1e-3, 1e-3, -1.0, 1.0))}
    found = index_of(points).within(centre, radius)
    wanted = brute(points, centre, radius)
    assert {n for n, _ in found} == {n for n, _ in wanted}
    assert [round(d, 3) for _, d in found] == pytest.approx([round(d, 3) for _, d in wanted], abs=2e-3)


@given(places, st.lists(places, max_size=12), st.floats(300_000, 2e7))
@settings(max_examples=examples(60), deadline=None)
def test_within_is_exact_for_huge_radii(centre, others, radius):
    points = {f"n{i}": p for i, p in enumerate(others)}
    found, wanted = index_of(points).within(centre, radius), brute(points, centre, radius)
    assert [n for n, _ in found] == [n for n, _ in wanted]
    assert [d for _, d in found] == pytest.approx([d for _, d in wanted], abs=1e-4)


def test_neighbours_across_the_antimeridian_and_over_the_pole():
    points = {"east": Point(lat=10, lon=-179.9995), "west": Point(lat=10, lon=179.9995)}
    points |= {f"polar{i}": Point(lat=89.9999, lon=-180 + 60 * i) for i in range(6)}
    index = index_of(points)
    assert [n for n, _ in index.within(Point(lat=10, lon=180), 100)] == ["east", "west"]
    assert [n for n, _ in index.within(Point(lat=90, lon=12), 12)] == [f"polar{i}" for i in range(6)]


def test_equally_far_goes_by_name():
    centre = Point(lat=39, lon=23)
    points = {name: away(centre, bearing, 100) for name, bearing in (("c", 0), ("a", 90), ("b", 270))}
    assert [n for n, _ in index_of(points).within(centre, 200)] == ["a", "b", "c"]


operations = st.lists(
    st.tuples(st.sampled_from("abcdef"), st.one_of(st.none(), st.tuples(st.floats(0, 360), st.floats(0, 3000)))),
    max_size=40,
)


@given(places, operations)
@settings(deadline=None)
def test_an_index_that_followed_every_change_equals_one_made_again(centre, changes):
    index, points = SpatialIndex(), {}
    for name, target in changes:
        if target is None:
            index.remove(name)
            points.pop(name, None)
        else:
            points[name] = away(centre, *target)
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
def test_nearest_beyond_a_radius(centre, count, beyond, spread):
    points = {f"n{i:02d}": away(centre, b, d) for i, (b, d) in enumerate(spread)}
    assume(all(abs(geodesic_m(centre, p) - beyond) > 1e-3 for p in points.values()))
    wanted = [n for n, d in brute(points, centre, 1e5) if d > beyond][:count]
    assert [n for n, _ in index_of(points).nearest(centre, count, beyond)] == wanted


@given(
    st.floats(-89.5, 89.5),
    st.floats(-180, 180),
    st.lists(st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000)), min_size=2, max_size=8, unique=True),
    st.lists(st.tuples(st.floats(-4000, 4000), st.floats(-4000, 4000)), max_size=30),
    st.floats(0.5, 500),
)
@settings(deadline=None)
def test_points_near_an_area(lat, lon, path, spots, margin):
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
def test_fast_distance_is_the_geodesic(a, bearing, length):
    b = away(a, bearing, length)
    assert distance_m(a, b) == pytest.approx(geodesic_m(a, b), abs=1e-6)


@given(places, places)
@settings(max_examples=examples(50), deadline=None)
def test_fast_distance_is_the_geodesic_around_the_globe(a, b):
    assert distance_m(a, b) == pytest.approx(geodesic_m(a, b), abs=1e-4)


def test_a_move_takes_less_than_a_millisecond_among_many():
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


def test_equally_near_points_go_by_name_also_where_a_look_ends():
    centre = Point(lat=50, lon=4)
    points = {"b": away(centre, 10, 127.9998), "a": away(centre, 200, 128.0002)}
    assert [n for n, _ in index_of(points).nearest(centre, 1)] == ["a"]
    assert index_of(points).nearest(centre, 2) == index_of(points).within(centre, 200)


def test_what_is_too_near_is_measured_once_and_not_again_for_every_wider_look(monkeypatch):
    centre = Point(lat=50, lon=4)
    points = {f"near{i}": away(centre, 9 * i, 50 + i) for i in range(40)}
    points |= {f"far{i}": away(centre, 30 * i, 20_000 + i) for i in range(5)}
    spatial = index_of(points)
    looks = []
    exactly = SpatialIndex._exactly

    def counted(self, *args):
        looks.append(args)
        return exactly(self, *args)

    monkeypatch.setattr(SpatialIndex, "_exactly", counted)
    assert [n for n, _ in spatial.nearest(centre, 5, 150)] == [f"far{i}" for i in range(5)]
    assert len(looks) == 2


@pytest.mark.parametrize("lat", [0.0, 45.0, -80.0])
def test_one_place_on_both_sides_of_the_antimeridian(lat):
    index = SpatialIndex.of([("west", lat, -180.0)])
    assert index.within(Point(lat=lat, lon=180.0), 0.0) == [("west", 0.0)]
