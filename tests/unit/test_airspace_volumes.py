"""4D volumes: construction, and overlaps at the antimeridian, at the poles, and in a single point, altitude or moment."""

import math

import pytest
import shapely
from depth import examples
from fractus_core.airspace import Airspace, OperationalIntent, Volume4D
from fractus_core.airspace.volumes import MAX_REACH_M, TOLERANCE_M
from fractus_core.api import InvalidObject
from fractus_core.api.geometry import Area, Circle, Point, Polygon
from fractus_core.geo import LocalFrame, geodesic_m
from hypothesis import example, given, settings
from hypothesis import strategies as st

BEGIN_S = 1_800_000_000.0
END_S = BEGIN_S + 600
FRAME = LocalFrame(39.36, 22.93)


def volume(shape, frame=FRAME, *, altitudes=(0.0, 50.0), times=(BEGIN_S, END_S)):
    return Volume4D.of_shape(frame, shape, lower_m=altitudes[0], upper_m=altitudes[1], begin_s=times[0], end_s=times[1])


def square(x=0.0, y=0.0, side=100.0):
    return shapely.box(x, y, x + side, y + side)


def disc(lat, lon, radius, **more):
    area = Area(circle=Circle(center=Point(lat=lat, lon=lon), radius=radius))
    bounds = {"lower_m": 0.0, "upper_m": 50.0, "begin_s": BEGIN_S, "end_s": END_S} | more
    return Volume4D.of_area(area, **bounds)


def meets(a, b):
    """Return True if two volumes overlap, after a check that the index finds the same in both directions."""
    found = a.overlap(b) is not None
    assert (b.overlap(a) is not None) == found
    for one, other in ((a, b), (b, a)):
        airspace = Airspace([OperationalIntent("other", "Accepted", volumes=(other,))])
        assert bool(airspace.overlapping([one], without="")) == found
    return found


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (square(50, 50), True),
        (square(10, 10, 20), True),
        (square(100, 0), True),  # a common edge
        (square(100, 100), True),  # a common corner
        (square(100 + 0.9 * TOLERANCE_M, 0), True),
        (square(101, 0), False),
        (square(-100, 101), False),
    ],
)
def test_volumes_overlap_if_their_grounds_meet(other, expected):
    assert meets(volume(square()), volume(other)) == expected


def test_volume_in_hole_of_another_volume_is_apart():
    ring = shapely.Polygon(square(-100, -100, 300).exterior.coords, [square(-50, -50, 200).exterior.coords])
    assert not meets(volume(square()), volume(ring))
    assert meets(volume(square(-60, 0)), volume(ring))


@pytest.mark.parametrize(
    ("altitudes", "expected"),
    [
        ((50.0, 80.0), True),  # a common altitude
        ((51.0, 80.0), False),
        ((-math.inf, -1.0), False),
        ((-math.inf, 0.0), True),
        ((40.0, math.inf), True),
        ((-math.inf, math.inf), True),
        ((25.0, 25.0), True),
    ],
)
def test_volumes_overlap_if_their_altitudes_meet(altitudes, expected):
    assert meets(volume(square()), volume(square(), altitudes=altitudes)) == expected


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ((END_S, END_S + 60), True),  # a common moment
        ((END_S + 0.001, END_S + 60), False),
        ((BEGIN_S - 60, BEGIN_S - 0.001), False),
        ((BEGIN_S, BEGIN_S), True),  # a duration of zero
        ((END_S + 1, END_S + 1), False),
    ],
)
def test_volumes_overlap_if_their_times_meet(times, expected):
    assert meets(volume(square()), volume(square(), times=times)) == expected


def test_two_volumes_of_zero_duration_overlap_only_in_the_same_moment():
    moment = volume(square(), times=(BEGIN_S, BEGIN_S))
    assert meets(moment, volume(square(), times=(BEGIN_S, BEGIN_S)))
    assert not meets(moment, volume(square(), times=(BEGIN_S + 1, BEGIN_S + 1)))


PLACES = [(0.0, 180.0), (39.36, -180.0), (-77.8, 179.9999), (90.0, 0.0), (-90.0, 45.0), (89.9999, 120.0), (0.0, 0.0)]


@pytest.mark.parametrize("place", PLACES)
def test_discs_overlap_across_antimeridian_and_poles(place):
    frame = LocalFrame(*place)
    near = frame.latlon(-150.0, 60.0)
    far = frame.latlon(-150.0, 140.0)
    middle = disc(place[0], place[1], 100)
    assert meets(middle, disc(*near, 65))
    assert not meets(middle, disc(*far, 100))
    assert meets(middle, disc(*frame.latlon(3.0, -4.0), 1))


def test_polygon_around_pole_contains_disc_at_pole():
    ring = tuple(Point(lat=89.99, lon=lon) for lon in (-180, -120, -60, 0, 60, 120))
    bounds = {"lower_m": 0.0, "upper_m": 50.0, "begin_s": BEGIN_S, "end_s": END_S}
    around = Volume4D.of_area(Area(polygon=Polygon(exterior=ring)), **bounds)
    assert meets(around, disc(90.0, 0.0, 5))
    assert not meets(around, disc(89.97, 33.0, 5))


@settings(max_examples=examples(400), deadline=None)
@given(
    lat=st.floats(-90, 90),
    lon=st.floats(-180, 180),
    radii=st.tuples(st.floats(0.5, 2000), st.floats(0.5, 2000)),
    bearing=st.floats(0, 2 * math.pi),
    share=st.floats(0, 2),
)
@example(lat=90.0, lon=0.0, radii=(1.0, 1.0), bearing=0.0, share=1.0)
@example(lat=0.0, lon=180.0, radii=(5.0, 2000.0), bearing=math.pi / 2, share=1.0)
def test_discs_overlap_exactly_if_they_are_closer_than_their_radii(lat, lon, radii, bearing, share):
    frame = LocalFrame(lat, lon)
    away = sum(radii) * share
    second = frame.latlon(away * math.sin(bearing), away * math.cos(bearing))
    gap = geodesic_m(Point(lat=lat, lon=lon), Point(lat=second[0], lon=second[1])) - sum(radii)
    found = meets(disc(lat, lon, radii[0]), disc(*second, radii[1]))
    if gap <= 0:
        assert found
    if gap > 1 + TOLERANCE_M:  # two circumscribed circles of at most 2 km
        assert not found


@settings(max_examples=examples(200), deadline=None)
@given(
    lat=st.floats(-90, 90),
    lon=st.floats(-180, 180),
    size=st.floats(1, 20_000),
    x=st.floats(-5000, 5000),
    y=st.floats(-5000, 5000),
)
def test_overlap_is_independent_of_the_frame_of_a_volume(lat, lon, size, x, y):
    here = LocalFrame(lat, lon)
    there = LocalFrame(*here.latlon(x, y))
    shape = shapely.box(-size / 2, -size / 3, size / 2, size / 3)
    probe = disc(lat, lon, 1)
    moved = volume(shapely.box(-size / 2 - x, -size / 3 - y, size / 2 - x, size / 3 - y), there)
    assert meets(volume(shape, here), probe)
    if min(size / 2 - abs(x), size / 3 - abs(y)) > 5:
        assert meets(moved, volume(shape, here))


def test_long_edge_stays_in_place_in_a_distant_frame():
    here = LocalFrame(60.0, 10.0)
    there = LocalFrame(*here.latlon(60_000, 0))
    shape = shapely.box(0, -25_000, 15_000, 25_000)
    dense = shapely.get_coordinates(shapely.segmentize(shape, 100))
    points = shapely.points(there.xy_array(*here.latlon_array(dense)))
    assert shapely.distance(volume(shape, here).in_frame(there).boundary, points).max() < 0.01


@settings(max_examples=examples(100), deadline=None)
@given(lat=st.floats(-90, 90), lon=st.floats(-180, 180), size=st.floats(1, 20_000))
def test_reach_contains_every_corner(lat, lon, size):
    frame = LocalFrame(lat, lon)
    made = volume(shapely.box(-size, -size / 7, size, size / 7), frame)
    origin = Point(lat=made.frame.lat, lon=made.frame.lon)
    for lon_, lat_ in shapely.get_coordinates(made.outline):
        # A chord is up to a metre shorter than the geodesic of this length.
        assert geodesic_m(origin, Point(lat=lat_, lon=lon_)) <= made.reach_m + 1


def test_areas_of_volume_cover_the_ground_of_the_volume():
    (area,) = disc(0.0, 180.0, 100).areas()
    assert len(area.polygon.exterior) > 8
    middle = Point(lat=0.0, lon=180.0)
    assert all(geodesic_m(middle, corner) + 1e-3 >= 100 for corner in area.polygon.exterior)


def test_volumes_with_equal_values_are_equal():
    assert volume(square()) == volume(square())
    assert volume(square()) != volume(square(1))


@pytest.mark.parametrize("field", ["lower_m", "upper_m", "begin_s", "end_s"])
def test_volume_with_nan_is_refused(field):
    with pytest.raises(InvalidObject):
        disc(0.0, 0.0, 10, **{field: math.nan})


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ({"lower_m": 60.0}, "altitudes: the lower bound 60 m must not be above the upper bound 50 m"),
        ({"lower_m": math.inf, "upper_m": math.inf}, "altitudes: an infinite bound leaves no airspace"),
        ({"upper_m": -math.inf, "lower_m": -math.inf}, "altitudes: an infinite bound leaves no airspace"),
        ({"begin_s": END_S + 1}, "time: give a start after 1970 and an end that is not before the start"),
        ({"begin_s": -1.0}, "time: give a start after 1970"),
        ({"end_s": math.inf}, "time: give a start after 1970"),
    ],
)
def test_volume_with_impossible_bounds_is_refused(bounds, message):
    with pytest.raises(InvalidObject, match=message):
        disc(0.0, 0.0, 10, **bounds)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (shapely.Polygon(), "the area is empty"),
        (shapely.LineString([(0, 0), (1, math.nan)]), "a coordinate is not a number"),
        (shapely.LineString([(0, 0), (1, math.inf)]), "a coordinate is not a number"),
        (square(MAX_REACH_M, 0), "a corner is more than 30 km from the middle"),
        (square(1e12, 0), "a corner is more than 30 km from the middle"),
    ],
)
def test_volume_with_impossible_ground_is_refused(shape, message):
    with pytest.raises(InvalidObject, match=f"area: .*{message}"):
        volume(shape)


@pytest.mark.parametrize(
    ("altitudes", "text"),
    [
        ((20.0, 40.0), "between 20.0 and 40.0 m AMSL"),
        ((-math.inf, 40.0), "between 0.0 and 40.0 m AMSL"),
        ((20.0, math.inf), "between 20.0 and 50.0 m AMSL"),
    ],
)
def test_overlap_names_place_altitudes_and_time(altitudes, text):
    overlap = volume(square()).overlap(volume(square(90, 0), altitudes=altitudes, times=(BEGIN_S + 60, END_S + 60)))
    assert str(overlap).endswith(f" {text} from 2027-01-15T08:01:00Z to 2027-01-15T08:10:00Z")
    x, y = FRAME.xy(overlap.lat, overlap.lon)
    assert square(90, 0, 10).union(square(90, 0)).dwithin(shapely.Point(x, y), 0.1)


@pytest.mark.parametrize(
    ("altitudes", "text"),
    [
        ((-math.inf, 40.0), "up to 40.0 m AMSL"),
        ((20.0, math.inf), "above 20.0 m AMSL"),
        ((-math.inf, math.inf), "at all altitudes"),
    ],
)
def test_overlap_with_open_altitudes_is_named(altitudes, text):
    one = volume(square(), altitudes=altitudes)
    assert f" {text} from " in str(one.overlap(one))
