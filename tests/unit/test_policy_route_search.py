"""Routes around zones: the engine permits every leg, and the routes are not much longer than the shortest ones."""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import replace
from typing import Any

import pytest
import shapely
from depth import cells
from fractus_core.policy.compiled_grant import CompiledGrant, compile_transit_grant
from fractus_core.policy.decision_types import Airframe, GotoArgs, Situation
from fractus_core.policy.engine import judge
from fractus_core.policy.route_search import CLEARANCES_M, find_route
from policy_world import Corners, altitude, at, box, compiled, exclusion, goto, inclusion, policy, ring, spec, zone

RETRACING = Airframe(retraces=True)
Route = tuple[tuple[float, float], ...]


def free(*policies: dict[str, Any]) -> CompiledGrant:
    return compiled(*policies, operationArea=[])


def find(grant: CompiledGrant, *ends: tuple[float, float], alt: float = 10.0, **state: Any) -> Route | None:
    now = at(*ends[0], alt=alt, **{"airframe": RETRACING, **state})
    return find_route(ends[0], ends[1], now, grant, alt)


def length(start: tuple[float, float], route: Route) -> float:
    return sum(math.dist(a, b) for a, b in itertools.pairwise((start, *route)))


def legal(grant: CompiledGrant, start: tuple[float, float], route: Route, now: Situation) -> None:
    """Check that the engine permits every leg.

    The drone starts each leg from standstill, within a metre of the end of the previous leg.
    """
    for a, b in itertools.pairwise((start, *route)):
        for dx, dy in ((0.0, 0.0), (0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7)):
            x, y = (a[0] + dx, a[1] + dy) if a != start else a
            lat, lon = grant.frame.latlon(x, y)
            verdict = judge(goto(*b, now.altitude_m), replace(now, lat=lat, lon=lon), grant)
            assert verdict.action == "allow", (a, b, verdict)


def test_route_is_straight_without_obstacles() -> None:
    assert find(free(), (0, 0), (100, 50)) == ((100, 50),)
    assert find(free(), (5, 5), (5, 5)) == ((5, 5),)


def test_route_passes_wall_on_the_shorter_side() -> None:
    grant = free(exclusion(box(-100, 40, 30, 50)))
    route = find(grant, (0, 0), (0, 100))
    assert route is not None
    assert len(route) == 3
    assert route[-1] == (0, 100)
    assert all(x > 30 for x, _ in route[:-1])
    legal(grant, (0, 0), route, at(airframe=RETRACING))
    assert find(grant, (0, 0), (0, 100)) == route, "the search is deterministic"


def test_route_is_none_when_target_is_enclosed() -> None:
    hole = [(-10, 30), (10, 30), (10, 50), (-10, 50)]
    area = ring([(-20, 20), (20, 20), (20, 60), (-20, 60)])
    area["polygon"]["holes"] = [ring(hole)["polygon"]["exterior"]]  # type: ignore[list-item]
    grant = free(exclusion(area))
    assert find(grant, (0, 0), (0, 40)) is None, "the target is enclosed by the walls"
    assert find(grant, (0, 40), (3, 42)) is not None
    assert find(grant, (0, 0), (0, 25)) is None, "the target is in the wall"
    assert find(grant, (0, 0), (0, 18.5)) is None, "the target is too close to the zone"
    assert find(grant, (0, 0), (math.nan, 0)) is None
    assert find(grant, (0, 0), (0, -40), home=None) is None


def test_route_respects_altitude_bands_and_limits() -> None:
    low = free(exclusion(box(-100, 40, 30, 50), upper=20))
    assert find(low, (0, 0), (0, 100), alt=30) == ((0, 100),)
    assert len(find(low, (0, 0), (0, 100), alt=21) or ()) == 3, "the straight leg is too close above the zone"
    climbing = find_route((0, 0), (0, 100), at(airframe=RETRACING), low, 30.0, from_m=5.0)
    assert len(climbing or ()) == 3, "the drone may still climb when it reaches the zone"
    limited = free(altitude(zones=[zone("low", box(-100, 40, 30, 50))], upperLimit=15))
    assert find(limited, (0, 0), (0, 100)) == ((0, 100),)
    assert len(find(limited, (0, 0), (0, 100), alt=30) or ()) == 3
    above_terrain = free(
        altitude(zones=[zone("low", box(-100, 40, 30, 50))], upperLimit=15, altitudeReference="terrain")
    )
    assert len(find(above_terrain, (0, 0), (0, 100)) or ()) == 3, "the altitude above terrain is unknown"


def test_route_stays_inside_inclusion_zone() -> None:
    corner: Corners = [(-20, -20), (100, -20), (100, 20), (20, 20), (20, 100), (-20, 100)]
    grant = free(inclusion(ring(corner)))
    route = find(grant, (0, 90), (90, 0))
    assert route is not None
    assert len(route) == 2
    assert route[0][0] < 20 - 2.5
    assert route[0][1] < 20 - 2.5
    legal(grant, (0, 90), route, at(airframe=RETRACING))
    banded = free(inclusion(ring(corner), upper=15))
    assert find(banded, (0, 90), (90, 0), alt=20) is None


def test_route_of_the_system_may_use_the_corridor() -> None:
    body = spec(
        exclusion(box(10, -60, 30, 5)),
        operationArea=[box(50, -20, 150, 20)], corridor=[box(-30, -30, 150, 30)], control="partial",
        services=[{"service": "mobility", "methods": ["GetPosition"]}],
    )  # fmt: skip
    grant = compile_transit_grant(body)
    now = at(airframe=RETRACING)
    route = find_route((0, 0), (100, 0), now, grant, 10.0)
    assert route is not None
    assert len(route) > 1
    legal(grant, (0, 0), route, now)
    assert find_route((0, 0), (100, 40), now, grant, 10.0) is None, "the target is outside the corridor"


def test_route_requires_legal_straight_return_from_every_waypoint() -> None:
    wall = free(exclusion(box(-100, 40, 30, 50)))
    assert find(wall, (60, 45), (0, 100), airframe=Airframe()) is None, "the return from the target is blocked"
    assert find(wall, (60, 45), (0, 100)) is not None
    island = free(exclusion(box(30, -10, 50, 10)))
    route = find(island, (80, -60), (80, 60), airframe=Airframe())
    assert route == ((80, 60),)


def test_route_leads_away_from_zone_when_start_is_too_close() -> None:
    grant = free(exclusion(box(-30, 1, 30, 40)))
    route = find(grant, (0, 0), (0, 60))
    assert route is not None
    assert route[0] == pytest.approx((0, -3.4), abs=0.5)
    inside = find(free(exclusion(box(-30, -2, 30, 40))), (0, 0), (0, -60))
    assert inside == ((0, -60),)


def test_route_uses_narrow_gap_when_no_wider_gap_exists() -> None:
    gap = 2 * (2.5 + CLEARANCES_M[1]) + 0.6
    grant = free(exclusion(box(-500, 40, 0, 50), name="west"), exclusion(box(gap, 40, 500, 50), name="east"))
    route = find(grant, (-30, 0), (-30, 100))
    assert route is not None
    assert length((-30, 0), route) < 130
    shut = free(exclusion(box(-500, 40, 0, 50), name="west"), exclusion(box(4.9, 40, 500, 50), name="east"))
    assert length((-30, 0), find(shut, (-30, 0), (-30, 100)) or ()) > 900, (
        "the gap is too narrow, so the route leads around both zones"
    )


def _shortest(zones: list[Corners], start: tuple[float, float], to: tuple[float, float]) -> float:
    """Return the length of the shortest route, computed independently of the engine.

    The nodes of Dijkstra's algorithm are all corners of the finely buffered zones.
    """
    walls = shapely.union_all([shapely.Polygon(z).buffer(2.5 + CLEARANCES_M[0], quad_segs=4) for z in zones])
    nodes = [start, to, *map(tuple, shapely.get_coordinates(walls.buffer(0.01)))]
    inner = walls.buffer(-1e-3)
    costs = {0: 0.0}
    done = set()
    while True:
        at_ = min((n for n in costs if n not in done), key=costs.__getitem__)
        if at_ == 1:
            return costs[1]
        done.add(at_)
        others = [n for n in range(len(nodes)) if n not in done]
        lines = shapely.linestrings([(nodes[at_], nodes[n]) for n in others])
        for n, hit in zip(others, shapely.intersects(inner, lines), strict=True):
            cost = costs[at_] + math.dist(nodes[at_], nodes[n])
            if not hit and cost < costs.get(n, math.inf):
                costs[n] = cost


@pytest.mark.parametrize("seed", cells(range(4), quick=[1]))
def test_route_is_not_much_longer_than_the_shortest(seed: int) -> None:
    draw = random.Random(seed)
    zones: list[Corners] = []
    for x, y in itertools.product(range(20, 90, 34), repeat=2):
        count = draw.randint(3, 5)
        turn = draw.uniform(0, 6)
        radius = draw.uniform(8, 14)
        angles = [turn + 2 * math.pi * i / count for i in range(count)]
        zones.append([(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles])
    grant = free(*(exclusion(ring(z), name=f"z{i}") for i, z in enumerate(zones)))
    route = find(grant, (0, 0), (110, 105))
    assert route is not None
    legal(grant, (0, 0), route, at(airframe=RETRACING))
    best = _shortest(zones, (0, 0), (110, 105))
    assert best * 0.999 <= length((0, 0), route) <= best * 1.02


def test_route_search_handles_a_thousand_zones() -> None:
    draw = random.Random(3)
    zones = []
    for i, (x, y) in enumerate(itertools.product(range(-960, 961, 60), repeat=2)):
        if math.hypot(x, y) > 40:
            cx = x + draw.uniform(-12, 12)
            cy = y + draw.uniform(-12, 12)
            half = draw.uniform(8, 18)
            zones.append(zone(f"z{i}", box(cx - half, cy - half, cx + half, cy + half)))
    many = policy("many", "GeofenceControl", "exclusion", zones[:1000])
    grant = free({**many, "zones": zones})
    route = find(grant, (0, 0), (303, 273))
    assert route is not None
    assert length((0, 0), route) < 1.15 * math.hypot(303, 273)
    legal(grant, (0, 0), route, at(airframe=RETRACING))


def test_goto_behind_wall_is_legal_when_the_autopilot_retraces_its_path() -> None:
    wall = free(exclusion(box(-100, 40, 30, 50)))
    behind = at(60, 100)
    assert judge(goto(0, 100), behind, wall).code == "WayHomeBlocked"
    retracing = replace(behind, airframe=RETRACING)
    verdict = judge(goto(0, 100), retracing, wall)
    assert verdict.action == "allow"
    assert isinstance(verdict.args, GotoArgs)
    court = inclusion(box(-300, 60, 300, 300), name="court")
    shut = judge(goto(0, 100), retracing, free(exclusion(box(-100, 40, 30, 50)), court))
    assert shut.code == "WayHomeBlocked"
    assert "no legal route around it was found" in shut.reason


def test_route_first_leg_sinks_when_a_zone_is_too_close_overhead() -> None:
    grant = free(exclusion(box(-200, -200, 200, 200), lower=16), exclusion(box(50, 2, 70, 30), name="wall"))
    low = replace(RETRACING, return_altitude_m=10.0)
    now = at(60, 0, alt=14.5, airframe=low)
    route = find_route((60, 0), (60, 100), now, grant, 13.0, from_m=14.5)
    assert route is not None
    assert judge(goto(*route[0], 13.0), now, grant).action == "allow"
    legal(grant, route[0], route[1:], at(alt=13.0, airframe=low))
    assert find_route((60, 0), (60, 100), now, grant, 14.5) is None, "the whole route is too close below the zone"


def test_route_checks_both_altitudes_on_the_first_leg_only() -> None:
    grant = free(exclusion(box(30, -60, 40, 10), name="wall"), exclusion(box(80, -60, 90, 60), upper=20))
    climbing = find_route((0, 0), (150, 0), at(alt=5, airframe=RETRACING), grant, 30.0, from_m=5.0)
    level = find_route((0, 0), (150, 0), at(alt=5, airframe=RETRACING), grant, 5.0)
    assert level is not None
    assert climbing is not None
    assert length((0, 0), climbing) < 155 < length((0, 0), level), (
        "after its first leg, the climbing drone is above the second zone"
    )
