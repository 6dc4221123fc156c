"""Legality of a planned path before takeoff, judged by the same policy engine as the flight."""

import math
import random
from dataclasses import replace
from datetime import UTC, datetime

import pytest
from fractus_core.api import Zone
from fractus_core.api.geometry import Point
from fractus_core.api.plans import DroneChoice
from fractus_core.planning import Infeasible, Settings, operation_area, plan
from fractus_core.planning.grant_compiler import AROUND_CORRIDOR_M, compile_grants, flight_grant, validated
from fractus_core.planning.legality import MAX_LISTED, MAX_SEARCHES, with_legality
from fractus_core.policy.compiled_grant import compile_grant
from fractus_core.policy.decision_types import Airframe, Call, GotoArgs, Home, Situation
from fractus_core.policy.engine import judge
from test_grants import FENCE, guide, policy, zone
from test_plan_drones import flown_by_other, shared
from test_planning import PATH, application, at, drone, inventory, manifest, navigator

NOW = 1_780_000_000.0
WARN = Settings(time_s=NOW)
FORBID = Settings(time_s=NOW, policy_conflicts="forbid")
APP = application(navigator(PATH))
NEAR = {"control": "partial"}


def stock(*policies, zones=(), drones=None, **more):
    fleet = [drone("d", minutes=30)] if drones is None else drones
    return inventory(fleet, policies={p.name: p for p in policies}, zones={z.name: z for z in zones}, **more)


def fenced(x, y, radius=20, **more):
    """Return an inventory with an exclusion zone."""
    return stock(policy("keep-out", zones=["z"], **FENCE | more), zones=[zone("z", (x, y), radius)])


def outcomes(choice: DroneChoice):
    return [(leg.flown_by, leg.outcome, leg.policies) for leg in choice.legality]


def test_legality_is_empty_for_permitted_path():
    for inventory_ in (stock(), fenced(2000, 2000)):
        choice = plan(APP, inventory_, FORBID).drone
        assert choice.legality == ()
        assert choice.policy_conflict is None
        assert choice.mission == plan(APP, inventory_).drone.mission


def test_legality_is_not_checked_without_time():
    assert plan(APP, fenced(200, 0)).drone.legality == ()


def test_legality_reports_leg_through_zone_before_takeoff():
    choice = plan(APP, fenced(200, 0), WARN).drone
    assert outcomes(choice)[0] == ("driver", "Denied", ("keep-out",))
    assert choice.policy_conflict.startswith("policies do not allow the leg to 39.3606")
    assert "crosses zone z for 40.0 m of policy keep-out" in choice.policy_conflict
    with pytest.raises(Infeasible) as caught:
        plan(APP, fenced(200, 0), FORBID)
    assert caught.value.reason == "PolicyConflict"
    assert [(r.node, r.reason) for r in caught.value.rejected] == [("d", "PolicyConflict")]


def test_legality_matches_engine_verdict_in_flight():
    inventory_ = fenced(200, 0)
    chosen = plan(APP, inventory_, WARN)
    (grant,) = compile_grants(APP, chosen, inventory_)
    start, end = (at(x, 0, 10) for x in (100, 300))
    home = Home(at(0, 0)["lat"], at(0, 0)["lon"], 0.0)
    now = Situation(NOW, start["lat"], start["lon"], 10.0, home=home, in_air=True, airframe=Airframe(retraces=True))
    verdict = judge(Call("Goto", GotoArgs(end["lat"], end["lon"], 10.0)), now, compile_grant(grant))
    leg = chosen.drone.legality[0]
    assert (verdict.code, verdict.reason) == (leg.reason, leg.message)


def test_transit_detour_around_zone_counts_in_mission_distance():
    partial = application(navigator([at(300, 60, 10), at(330, 60, 10)], point={"position": at(280, 0)}, **NEAR))
    inventory_ = fenced(140, 0)
    choice = plan(partial, inventory_, FORBID).drone
    assert outcomes(choice)[0] == ("system", "Detour", ("keep-out",))
    assert choice.policy_conflict is None
    assert choice.mission.distance > plan(partial, inventory_).drone.mission.distance


def test_legality_reports_conflict_when_zone_contains_point_of_interest():
    tour = application(guide([at(100, 0, 10), at(300, 0, 10)]))
    choice = plan(tour, fenced(300, 0), WARN).drone
    assert next(leg for leg in outcomes(choice) if leg[1] == "Denied") == ("system", "Denied", ("keep-out",))
    with pytest.raises(Infeasible):
        plan(tour, fenced(300, 0), FORBID)


def test_legality_reports_conflict_when_zone_contains_depot():
    choice = plan(APP, fenced(0, 0), WARN).drone
    assert choice.legality[0].start == choice.legality[0].end
    assert choice.policy_conflict is not None


def test_legality_reports_conflict_when_speed_limit_makes_mission_too_long():
    slow = policy("slow", type="LimitControl", kind="speed", upperLimit=0.5)
    choice = plan(APP, stock(slow), WARN).drone
    assert {leg[1:] for leg in outcomes(choice)} == {("Corrected", ("slow",))}
    assert choice.mission.duration == pytest.approx(600 / 0.425 / 60 + 20 / 1.5 / 60, rel=0.01)
    assert choice.policy_conflict is None
    short = stock(slow, drones=[drone("d", minutes=20)])
    choice = plan(APP, short, WARN).drone
    assert "under slow the mission takes 23.8 min" in choice.policy_conflict
    assert "can fly only 16.0 min without its battery reserve" in choice.policy_conflict
    with pytest.raises(Infeasible, match=r"no drone may fly Navigator: d: under slow"):
        plan(APP, short, FORBID)


def test_legality_reports_altitude_limit_without_conflict():
    low = policy("low", type="LimitControl", kind="altitude", upperLimit=8)
    choice = plan(APP, stock(low), FORBID).drone
    assert {leg[1:] for leg in outcomes(choice)} == {("Corrected", ("low",))}
    refusing = policy("low", type="LimitControl", kind="altitude", upperLimit=8, action="refuse")
    assert plan(APP, stock(refusing), WARN).drone.policy_conflict is not None


@pytest.mark.parametrize("settings", [WARN, FORBID])
def test_plan_prefers_drone_without_policy_conflict(settings):
    fleet = [drone("a", minutes=30), drone("b", battery=0.9, minutes=30)]
    banned = policy("ban", zones=["z"], nodes=[{"key": "name", "operator": "In", "values": ["a"]}], **FENCE)
    inventory_ = stock(banned, zones=[zone("z", (200, 0))], drones=fleet)
    chosen = plan(APP, inventory_, settings)
    assert chosen.drone.node == "b"
    assert chosen.drone.alternatives == ()
    assert [(r.node, r.reason) for r in chosen.rejected] == [("a", "PolicyConflict")]
    assert plan(APP, inventory_).drone.node == "a"


def test_plan_keeps_drone_with_policy_conflict_unless_forbidden():
    fleet = [drone("a", battery=0.9, minutes=30), drone("b", minutes=30)]
    alone = stock(drones=fleet[:1])
    before = plan(APP, alone, WARN)
    banned = policy("ban", zones=["z"], nodes=[{"key": "name", "operator": "In", "values": ["a"]}], **FENCE)
    inventory_ = stock(banned, zones=[zone("z", (200, 0))], drones=fleet)
    after = plan(APP, inventory_, WARN, previous=before)
    assert after.drone.node == "a"
    assert after.drone.policy_conflict is not None
    assert plan(APP, inventory_, FORBID, previous=before).drone.node == "b"


def test_passenger_on_shared_drone_has_no_legality():
    tour = application(guide([at(120, 0), at(250, 3)]))
    base = shared([drone("busy", minutes=30)], {"busy": flown_by_other()})
    fences = fenced(200, 0)
    choice = plan(tour, replace(base, policies=fences.policies, zones=fences.zones), FORBID).drone
    assert choice.shared_with == "default/other"
    assert choice.legality == ()


def test_legality_includes_policies_that_begin_or_end_during_mission():
    for begin_s, end_s, conflicts in ((60, 9000, True), (-9000, 60, True), (9000, 9060, False), (-9000, -60, False)):
        window = {"validFrom": _utc(NOW + begin_s), "validUntil": _utc(NOW + end_s)}
        choice = plan(APP, fenced(200, 0, **window), WARN).drone
        assert (choice.policy_conflict is not None) == conflicts, begin_s


def _utc(time_s):
    return datetime.fromtimestamp(time_s, UTC).isoformat()


def test_legality_reports_no_denied_leg_for_zone_inside_region_of_driver():
    region = {"polygon": {"exterior": [at(100, -100), at(300, -100), at(300, 100), at(100, 100)]}}
    driver = navigator(PATH) | {"controlPoints": [{"navigation": "regionBased", "region": region, "duration": 5}]}
    choice = plan(application(driver), fenced(200, 0, radius=10), FORBID).drone
    assert [leg for leg in choice.legality if leg.outcome == "Denied"] == []


def test_legality_of_active_plan_follows_policies_and_zones():
    before = plan(APP, stock(), WARN)
    assert with_legality(APP, before, stock(), WARN) is before
    after = with_legality(APP, before, fenced(200, 0), WARN)
    assert after.drone.policy_conflict is not None
    assert after.placements == before.placements
    assert with_legality(APP, after, stock(), WARN) == before
    without_drone = with_legality(APP, before, stock(drones=[]), WARN)
    assert without_drone is before


def test_legality_lists_limited_number_of_legs():
    path = [at(100 + i % 2 * 40, i, 10) for i in range(2 * MAX_LISTED)]
    slow = policy("slow", type="LimitControl", kind="speed", upperLimit=4)
    choice = plan(application(navigator(path)), stock(slow, drones=[drone("d", minutes=60)]), WARN).drone
    assert len(choice.legality) == MAX_LISTED
    assert choice.legality_omitted == 2 * MAX_LISTED + 1 - MAX_LISTED


def test_legality_ignores_policy_with_unknown_zone():
    broken = policy("keep-out", zones=["nowhere"], **FENCE)
    assert plan(APP, stock(broken), FORBID).drone.policy_conflict is None


def test_legality_permits_path_above_zone():
    flat = Zone.from_body(
        manifest("Zone", "z", {"area": {"circle": {"center": at(200, 0), "radius": 20}}, "altitude": {"upper": 5}})
    )
    below = stock(policy("keep-out", zones=["z"], **FENCE), zones=[flat])
    assert plan(APP, below, FORBID).drone.legality == ()


def test_legality_uses_every_zone_near_path():
    rng = random.Random(5)

    def area():
        x = rng.uniform(-3000, 3000)
        y = rng.uniform(-3000, 3000)
        size = rng.choice([5, 300, 3000, 30_000])
        if rng.random() < 0.5:
            return {"circle": {"center": at(x, y), "radius": size}}
        around = [(0, 0), (1, rng.uniform(-1, 0.4)), (1, 1), (rng.uniform(-1, 0.4), 1)]
        return {"polygon": {"exterior": [at(x + size * (dx - 0.5), y + size * (dy - 0.5)) for dx, dy in around]}}

    zones = [Zone.from_body(manifest("Zone", f"z{i}", {"area": area()})) for i in range(300)]
    inventory_ = stock(policy("keep-out", zones=[z.name for z in zones], **FENCE), zones=zones)
    area_ = operation_area(APP.spec, inventory_.depots, 7.0)
    grant = flight_grant(APP, inventory_.drones["d"], inventory_, area_)
    corners = [area_.frame.xy(p.lat, p.lon) for p in grant.corridor[0].polygon.exterior]
    reach_m = max(math.hypot(x, y) for x, y in corners) + AROUND_CORRIDOR_M
    middle = Point(lat=area_.frame.lat, lon=area_.frame.lon)
    near = {z.name for z in zones if validated(z).distance_m(middle) <= reach_m}
    assert {z.name for z in grant.policies[0].zones} == near
    assert 50 < len(near) < 300


def test_legality_reports_corridor_too_narrow_for_driver():
    partial = application(navigator(PATH, point={"position": at(100, 0)}, control="partial"))
    far = policy("far", type="LimitControl", kind="altitude", upperLimit=70)
    narrow = replace(WARN, safety_radius_m=2.0)
    choice = plan(partial, stock(far), narrow).drone
    assert next(leg.reason for leg in choice.legality if leg.flown_by == "driver") == "OutsideOperationArea"
    assert plan(partial, stock(far), WARN).drone.legality == ()


def test_legality_limits_number_of_detour_searches():
    walls = [zone(f"z{i}", (115, 60 * i), 10) for i in range(MAX_SEARCHES + 5)]
    tour = application(guide([p for i in range(len(walls)) for p in (at(50, 60 * i, 10), at(180, 60 * i, 10))]))
    fleet = [drone(f"d{i}", home=(i, 0), minutes=1000) for i in range(3)]
    inventory_ = stock(policy("keep-out", zones=[z.name for z in walls], **FENCE), zones=walls, drones=fleet)
    choice = plan(tour, inventory_, WARN).drone
    assert sum(leg.outcome == "Detour" for leg in choice.legality) == MAX_SEARCHES
    assert choice.legality[-1].message.startswith("no further detour is searched: ")
    with pytest.raises(Infeasible) as caught:
        plan(tour, inventory_, FORBID)
    assert sorted(r.reason for r in caught.value.rejected) == ["NotJudged", "NotJudged", "PolicyConflict"]


def test_legality_reports_waypoints_unreachable_after_denied_waypoint():
    corner = application(navigator([at(100, 0, 10), at(200, 0, 10), at(200, 100, 10), at(200, 200, 10)]))
    choice = plan(corner, fenced(200, 0), WARN).drone
    assert "a driver that skips it cannot reach any of the 2 waypoints after it" in choice.legality[0].message
    assert "any of the 2 waypoints after it" in choice.policy_conflict
    with pytest.raises(Infeasible, match="use regionBased navigation"):
        plan(corner, fenced(200, 0), FORBID)
    high = Zone.from_body(
        manifest("Zone", "z", {"area": {"circle": {"center": at(200, 0), "radius": 20}}, "altitude": {"lower": 40}})
    )
    above = stock(policy("keep-out", zones=["z"], **FENCE), zones=[high])
    up = application(navigator([at(100, 0, 10), at(200, 0, 50), at(300, 0, 10)]))
    legs = [leg for leg in plan(up, above, WARN).drone.legality if leg.outcome == "Denied"]
    assert legs
    assert "skips it" not in legs[0].message, "the driver can pass below the zone, so no waypoint is unreachable"
