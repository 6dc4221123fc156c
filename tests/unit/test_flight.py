"""Duration of missions, order of points, and flights that passengers can share."""

import itertools
import math

import pytest
from depth import examples
from fractus_core.api.geometry import Position
from fractus_core.planning import Flight, Settings, flight_of, operation_area
from fractus_core.planning.mission import MissionEstimator, first_missed, transit_legs
from fractus_core.planning.operation_area import short_tour
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from test_planning import FRAME, PATH, VIEWER, application, at, drone, inventory, navigator

spots = st.tuples(st.floats(-300, 300), st.floats(-300, 300))
HOME = Position(**at(0, 0))


def place(x, y, alt=None, **more):
    return Position(**at(x, y, alt), **more)


def flight(*legs, **more):
    return Flight(("default", "other"), tuple(tuple(place(*p) for p in leg) for leg in legs), **more)


def walk(leg, step=0.25):
    """Yield points along a polyline, at most `step` metres apart."""
    for (ax, ay), (bx, by) in itertools.pairwise(leg):
        pieces = max(1, math.ceil(math.hypot(bx - ax, by - ay) / step))
        for i in range(pieces + 1):
            yield ax + (bx - ax) * i / pieces, ay + (by - ay) * i / pieces


def visits(leg, points, radius, ordered):
    """Return True if the path visits all points. This oracle checks the path in small steps."""
    steps = list(walk(leg))
    remaining = list(points)
    if not ordered:
        return all(any(math.dist(s, p) <= radius for s in steps) for p in points)
    for s in steps:
        while remaining and math.dist(s, remaining[0]) <= radius:
            remaining.pop(0)
    return not remaining


@given(
    st.lists(spots, min_size=2, max_size=6),
    st.lists(st.tuples(st.floats(0, 1), st.floats(-12, 12), st.floats(-12, 12)), min_size=1, max_size=4),
    st.booleans(),
)
@settings(max_examples=examples(150), deadline=None)
def test_first_missed_equals_walk_along_path(leg, offsets, ordered):
    steps = list(walk(leg))
    assume(len(steps) > 10)
    points = [
        (steps[int(t * (len(steps) - 1))][0] + dx, steps[int(t * (len(steps) - 1))][1] + dy) for t, dx, dy in offsets
    ]
    sure = visits(leg, points, 6.8, ordered)
    possible = visits(leg, points, 7.2, ordered)
    missed = first_missed([place(*p) for p in points], flight(leg), 7.0, ordered=ordered)
    if sure:
        assert missed is None
    if not possible:
        assert missed is not None


def test_first_missed_accepts_point_on_second_pass():
    out_and_back = flight([(0, 0), (300, 0), (0, 0)])
    assert first_missed([place(200, 0), place(100, 0)], out_and_back, 7, ordered=True) is None
    assert first_missed([place(200, 0), place(100, 0)], flight([(0, 0), (300, 0)]), 7, ordered=True) == 1


def test_first_missed_compares_altitude_when_point_and_path_have_an_altitude():
    climbing = flight([(0, 0, 10), (300, 0, 40)])
    assert first_missed([place(150, 0, 25)], climbing, 7, ordered=True) is None
    assert first_missed([place(150, 0, 60)], climbing, 7, ordered=True) == 0
    assert first_missed([place(150, 0)], climbing, 7, ordered=True) is None
    assert first_missed([place(150, 0, 60, altitude_reference="amsl")], climbing, 7, ordered=True) is None


def test_first_missed_ignores_path_behind_drone_and_gaps_between_legs():
    legs = [(0, 0), (100, 0), (200, 0)]
    assert first_missed([place(50, 0)], flight(legs, reached=2), 7, ordered=True) == 0
    assert first_missed([place(150, 0)], flight(legs, reached=2), 7, ordered=True) is None
    assert first_missed([place(150, 0)], flight(legs, reached=3), 7, ordered=True) == 0
    assert first_missed([place(150, 0)], flight([(0, 0), (100, 0)], [(200, 0), (300, 0)]), 7, ordered=True) == 0


def test_flight_of_driver_is_interrupted_by_regions():
    square = [at(400, 0), at(500, 0), at(500, 100), at(400, 100)]
    points = [
        {"navigation": "pathBased", "path": [at(100, 0), at(200, 0)]},
        {
            "navigation": "regionBased",
            "region": {"polygon": {"exterior": square}},
            "duration": 1,
            "point": {"position": at(400, 0)},
        },
        {"navigation": "pathBased", "path": [at(600, 0)]},
    ]
    app = application(navigator(PATH) | {"control": "partial", "controlPoints": points})
    flown = flight_of(app, {})
    assert [[round(FRAME.xy(p.lat, p.lon)[0]) for p in leg] for leg in flown.legs] == [[100, 200, 400], [600]]
    assert flown.holder == ("default", "traffic")


@given(st.lists(spots, min_size=1, max_size=7))
@settings(max_examples=examples(60), deadline=None)
def test_short_tour_is_optimal_for_few_points(points):
    def length(order):
        return sum(math.dist(points[a], points[b]) for a, b in itertools.pairwise(order))

    tour = short_tour(points)
    assert tour[0] == 0
    assert sorted(tour) == list(range(len(points)))
    rest = itertools.permutations(range(1, len(points)))
    assert length(tour) == pytest.approx(min(length((0, *r)) for r in rest))


@given(st.lists(spots, min_size=10, max_size=30))
@settings(max_examples=examples(30), deadline=None)
def test_short_tour_of_many_points_is_no_longer_than_given_order(points):
    tour = short_tour(points)
    assert sorted(tour) == list(range(len(points)))
    length = sum(math.dist(points[a], points[b]) for a, b in itertools.pairwise(tour))
    assert length <= sum(math.dist(a, b) for a, b in itertools.pairwise(points)) + 1e-6


def test_mission_estimate_equals_manual_calculation():
    app = application(navigator([at(300, 0, 30), at(300, 400, 30)]))
    depots = inventory().depots
    area = operation_area(app.spec, depots, 7)
    estimate = MissionEstimator(app.spec, area, Settings(cruise_speed_mps=5, climb_speed_mps=1.5)).estimate(
        HOME, drone("d")
    )
    assert estimate.distance_m == pytest.approx(300 + 400 + 500, rel=1e-4)
    assert estimate.needed_min == pytest.approx((1200 / 5 + 60 / 1.5) / 60, rel=1e-4)
    assert estimate.available_min == pytest.approx(15 - 0.2 * 15)
    assert estimate.top_m == 30


def test_mission_estimate_includes_time_in_region():
    region = {"circle": {"center": at(300, 0), "radius": 50}}
    app = application(
        navigator(PATH) | {"controlPoints": [{"navigation": "regionBased", "region": region, "duration": 9}]}
    )
    area = operation_area(app.spec, {}, 7)
    assert MissionEstimator(app.spec, area, Settings()).estimate(HOME, drone("d")).needed_min == pytest.approx(
        9 + 2, rel=1e-3
    )


def test_transit_legs_connect_home_and_control_points():
    points = [{"navigation": "pathBased", "path": [at(x, 0), at(x + 50, 0)]} for x in (100, 400)]
    spec = application(navigator(PATH) | {"control": "partial", "controlPoints": points}).spec
    area = operation_area(spec, {}, 7)
    legs = transit_legs(spec, area, HOME, {})
    metres = [tuple(round(FRAME.xy(p.lat, p.lon)[0]) for p in (leg.start, leg.end)) for leg in legs]
    assert metres == [(0, 100), (150, 400), (450, 0)]
    full = application(navigator(PATH)).spec
    assert transit_legs(full, area, HOME, inventory().depots) == []


def test_operation_area_joins_unordered_points_by_short_tour():
    poi = {"points": [at(x, 0) for x in (0, 300, 100, 200)], "ordered": False}
    spec = application(VIEWER | {"egress": [], "pointsOfInterest": poi}).spec
    area = operation_area(spec, {}, 7)
    assert area.length_m == pytest.approx(300, rel=1e-4)
    assert [round(FRAME.xy(p.lat, p.lon)[0]) for p in area.route] == [0, 100, 200, 300]


def test_operation_area_has_part_for_each_control_point():
    points = [{"navigation": "pathBased", "path": [at(x, 0), at(x + 50, 0)]} for x in (100, 400)]
    spec = application(navigator(PATH) | {"control": "partial", "controlPoints": points}).spec
    area = operation_area(spec, {}, 7)
    assert [round(p.area) for p in area.parts] == pytest.approx([50 * 14 + 49 * math.pi] * 2, rel=2e-2)
    assert area.shape.area == pytest.approx(sum(p.area for p in area.parts))
