"""Policy engine with unusual and malicious input: positions, zones, numbers and clocks."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import pytest
from fractus_core.api import InvalidObject
from fractus_core.api.grants import GrantSpec
from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
from fractus_core.policy.decision_types import (
    Airframe,
    Call,
    GotoArgs,
    Home,
    SetSpeedArgs,
    Situation,
    TakeoffArgs,
    UncertainTime,
    VelocityArgs,
)
from fractus_core.policy.engine import judge
from fractus_core.policy.limits import limit_forbids_altitudes
from fractus_core.policy.monitoring import monitor
from fractus_core.policy.return_route import may_change_altitude
from fractus_core.policy.route_search import find_route
from policy_world import (
    FRAME,
    METHODS,
    NOW,
    altitude,
    ask,
    at,
    box,
    compiled,
    exclusion,
    goto,
    inclusion,
    policy,
    ring,
    spec,
    speed,
    zone,
)

SERVICES = [{"service": "mobility", "methods": [*METHODS, "SetVelocity"]}]
RETRACING = Airframe(retraces=True)


def test_judge_is_fast_near_outline_with_many_corners() -> None:
    """A region of an application may have ten thousand corners.

    The engine must be fast, because motion monitor and heartbeats wait while it judges a call.
    """
    corners = [
        ((300.0 if i % 2 else 150.0) * math.sin(math.tau * i / 10_000), (300.0 if i % 2 else 150.0) * math.cos(math.tau * i / 10_000))
        for i in range(10_000)
    ]  # fmt: skip
    region = compiled(operationArea=[ring(corners)])
    zones = compiled(exclusion(ring(corners), "adjust"), operationArea=[box(-900, -900, 900, 900)], home=None)
    away = Home(*FRAME.latlon(0.0, 500.0), 100.0)
    begun_s = time.process_time()
    assert ask(region, goto(0, 0), at(0, 149)).action == "allow", "the leg leads away from the border"
    assert ask(region, goto(0, 0), at(0, 315)).action == "allow", "the leg leads from outside into the region"
    assert ask(zones, goto(0, 0), at(0, 400, home=away)).code == "LegShortened"
    assert ask(zones, goto(0, 400), at(0, 301, home=away)).action == "allow", "the leg leads out of the margin"
    assert time.process_time() - begun_s < 1.0


@pytest.mark.parametrize(
    ("lat", "lon"), [(-17.0, 179.9999), (-17.0, -180.0), (89.9995, 40.0), (-89.9995, -120.0), (0, 0)]
)
def test_engine_works_anywhere_on_the_globe(lat: float, lon: float) -> None:
    frame = LocalFrame(lat, lon)

    def area(x0: float, y0: float, x1: float, y1: float) -> dict[str, Any]:
        corners = [frame.latlon(x, y) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        return {"polygon": {"exterior": [{"lat": a, "lon": b} for a, b in corners]}}

    body = spec(exclusion(area(30, -20, 60, 20)), services=SERVICES, operationArea=[], home={"lat": lat, "lon": lon})
    grant = compile_grant(body)
    now = Situation(
        time_s=NOW, lat=lat, lon=lon, altitude_m=10, home=Home(lat, lon, 0), in_air=True, airframe=RETRACING
    )
    for x, y, code in ((45, 0, "InsideExclusionZone"), (100, 0, "LegThroughExclusionZone"), (0, 100, "")):
        assert judge(Call("Goto", GotoArgs(*frame.latlon(x, y), 10)), now, grant).code == code
    assert judge(Call("SetVelocity", VelocityArgs(0, 9, hold_s=2)), replace(now, east_mps=9), grant).action == "deny"
    route = find_route((0, 0), (100, 0), now, grant, 10)
    assert route is not None
    assert len(route) == 3
    assert monitor(replace(now, east_mps=9), grant) is None
    assert monitor(replace(now, east_mps=14), grant) is not None


@pytest.mark.parametrize("place", [(90.0, 0.0), (-90.0, 180.0), (39.36, -157.05), (0.0, 202.95)])
def test_goto_to_target_on_far_side_of_globe_is_denied(place: tuple[float, float]) -> None:
    for area in ([], [box(-200, -200, 200, 200)]):
        assert ask(compiled(operationArea=area), Call("Goto", GotoArgs(*place, 10))).code == "InvalidArgument"


def test_zone_of_country_size_is_respected() -> None:
    huge = {"circle": {"center": {"lat": 39.0, "lon": 22.0}, "radius": 200_000}}
    assert ask(compiled(exclusion(huge)), goto(50, 0)).action == "deny"
    assert ask(compiled(inclusion(huge)), goto(50, 0)).action == "allow"
    beside = {"circle": {"center": {"lat": 41.3, "lon": 22.95}, "radius": 200_000}}
    assert ask(compiled(exclusion(beside)), goto(50, 0)).action == "allow"
    assert ask(compiled(inclusion(beside)), goto(50, 0)).action == "deny"


def test_grant_with_zone_around_the_globe_is_rejected() -> None:
    corners = [(0, -62), (0, 23), (0, 108), (70, 108), (80, 23), (70, -62)]
    world = {"polygon": {"exterior": [{"lat": lat, "lon": lon} for lat, lon in corners]}}
    with pytest.raises(InvalidObject, match="more than 1000 km from the middle"):
        compiled(exclusion(world))
    far = {"polygon": {"exterior": [{"lat": lat, "lon": lon} for lat, lon in ((-39, 170), (-39, 171), (-38, 171))]}}
    assert ask(compiled(exclusion(far)), goto(50, 0)).action == "allow"


def test_equal_lower_and_upper_limit_forbids_other_altitudes() -> None:
    height = 20.0
    (level,) = compiled(
        altitude(zones=[zone("level", box(0, 0, 9, 9))], lowerLimit=height, upperLimit=height)
    ).altitude_limits.zones
    assert [limit_forbids_altitudes(level, m, m, at(), flat=False) for m in (19.0, 20.0, 21.0)] == [True, False, True]


@pytest.mark.parametrize(
    ("present_m", "target_m", "permitted"),
    [
        (50.0, 21.0, False),
        (50.0, 49.0, True),
        (35.0, 21.0, True),
        (20.0, 40.0, False),
        (20.0, 16.0, True),
        (5.0, 16.0, True),
        (5.0, 40.0, False),
    ],
)
def test_return_flight_changes_altitude_only_where_limit_of_zone_permits_it(
    present_m: float, target_m: float, permitted: bool
) -> None:
    limited = altitude(
        zones=[zone("limited", box(-50, -50, 50, 50), lower=10, upper=45)], lowerLimit=5.0, upperLimit=22.0
    )
    assert may_change_altitude(at(alt=present_m), compiled(limited), target_m) == permitted


@pytest.mark.parametrize(("beyond_margin_m", "permitted"), [(0.3, False), (0.7, True)])
def test_return_flight_does_not_climb_where_wind_moves_drone_into_margin_of_limited_zone(
    beyond_margin_m: float, permitted: bool
) -> None:
    limited = altitude(
        zones=[zone("limited", box(-50, -50, 50, 50), lower=10, upper=45)], lowerLimit=5.0, upperLimit=22.0
    )
    east_m = 50 + at().margin_m + beyond_margin_m
    assert may_change_altitude(at(east_m, alt=15.0), compiled(limited), 40.0) == permitted


def _court() -> dict[str, Any]:
    area = box(-60, -60, 60, 60)
    area["polygon"]["holes"] = [box(-40, -40, 40, 40)["polygon"]["exterior"]]
    return area


def test_goto_into_hole_of_zone_is_judged_by_the_ring() -> None:
    grant = compiled(exclusion(_court()), operationArea=[])
    assert ask(grant, goto(30, 0)).action == "allow"
    assert ask(grant, goto(38, 0)).code == "TooCloseToExclusionZone"
    assert ask(grant, goto(50, 0)).code == "InsideExclusionZone"
    assert ask(grant, goto(100, 0)).code == "LegThroughExclusionZone"
    assert find_route((0, 0), (100, 0), at(airframe=RETRACING), grant, 10) is None
    inclusion_grant = compiled(inclusion(_court()), operationArea=[])
    assert ask(inclusion_grant, goto(50, 20), at(50, 0)).code == "WayHomeBlocked", (
        "the return is blocked, because home lies in the hole"
    )
    assert ask(inclusion_grant, goto(30, 0), at(50, 0)).action == "deny"


def test_touching_zones_leave_no_gap() -> None:
    two = (exclusion(box(-100, 20, 0, 40), name="a"), exclusion(box(0, 20, 100, 40), name="b"))
    for target in ((0, 60), (0.001, 60), (-0.001, 60)):
        assert ask(compiled(*two), goto(*target)).action == "deny"
    union = policy(
        "in", "GeofenceControl", "inclusion", [zone("a", box(-50, -50, 0, 50)), zone("b", box(0, -50, 50, 50))]
    )
    assert ask(compiled(union), goto(30, 0), at(-30, 0)).action == "allow", "there is no gap at the common border"


def test_goto_to_current_position_is_allowed() -> None:
    grant = compiled(exclusion(box(10, -20, 30, 20)), services=SERVICES)
    assert ask(grant, goto(0, 0)).action == "allow"
    assert ask(grant, goto(0, 0, 30)).action == "allow"
    assert ask(grant, goto(8.5, 0), at(8.5, 0)).action == "deny", "the position is too close to the zone"
    assert ask(grant, Call("SetVelocity", VelocityArgs(0, 0, 0))).action == "allow"
    assert ask(grant, goto(20, 0), at(20, 0)).action == "deny"


def test_engine_handles_home_inside_a_zone() -> None:
    grant = compiled(exclusion(box(-20, -20, 20, 20), "land"), operationArea=[])
    assert ask(grant, Call("Arm"), at(alt=0, in_air=False)).code == "InsideExclusionZone"
    assert ask(grant, Call("Takeoff"), at(alt=0)).action == "deny"
    assert ask(grant, goto(100, 0), at(60, 0)).code == "WayHomeBlocked"
    assert ask(grant, goto(100, 0), at(60, 0, airframe=RETRACING)).code == "WayHomeBlocked"
    assert ask(grant, goto(40, 0), at(15, 0)).action == "allow", "the drone may leave the zone regardless of home"
    assert ask(grant, Call("ReturnToLaunch"), at(60, 0)).action == "allow"


NANS = [math.nan, math.inf, -math.inf, 1e300, -1e300]


@pytest.mark.parametrize("invalid", NANS)
def test_non_finite_arguments_are_denied(invalid: float) -> None:
    grant = compiled(exclusion(box(-20, 20, 20, 60)), altitude(upperLimit=30), services=SERVICES)
    calls = [
        Call("SetVelocity", VelocityArgs(invalid, 0)), Call("SetVelocity", VelocityArgs(0, 0, invalid)),
        Call("SetVelocity", VelocityArgs(0, 1, hold_s=invalid)), Call("Goto", GotoArgs(invalid, 22.95)),
        Call("Goto", GotoArgs(39.36, 22.95, speed_mps=invalid)),
    ]  # fmt: skip
    assert {ask(grant, call).code for call in calls} == {"InvalidArgument"}
    fine = Call("SetVelocity", VelocityArgs(1, 0))
    for field in ("altitude_m", "down_mps", "forward_mps2", "latency_s", "position_error_m", "altitude_error_m"):
        assert ask(grant, fine, replace(at(), **{field: invalid})).code == "PositionUnknown", field
        assert ask(grant, goto(0, 10), replace(at(), **{field: invalid})).code == "PositionUnknown", field


def test_clock_set_back_in_flight_keeps_restrictions() -> None:
    shut = {"validFrom": "2026-06-01T11:00:00Z", "validUntil": "2026-06-01T13:00:00Z"}
    fence = exclusion(box(-20, 20, 20, 60), "land")
    fence["spec"] |= shut
    grant = compiled(fence, services=SERVICES)
    after_step = replace(at(0, 10, north_mps=5), time_s=UncertainTime(NOW, NOW - 7200.0))
    assert monitor(after_step, grant) is not None, "the true time may be anywhere between the two readings"
    assert not ask(grant, Call("SetVelocity", VelocityArgs(5, 0)), after_step).permits
    assert not ask(grant, goto(0, 40), replace(after_step, time_s=UncertainTime(NOW + 7200, NOW))).permits


def test_empty_grant_denies_everything() -> None:
    empty = compile_grant(GrantSpec.model_validate(spec(services=[]).to_dict()))
    for method in (*METHODS, "CaptureImage", "SetVelocity", "Explode"):
        assert judge(Call(method), at(), empty).action == "deny"


def test_granted_method_without_rule_is_denied() -> None:
    grant = replace(compiled(), methods=frozenset({"Barrel"}))
    assert ask(grant, Call("Barrel")).code == "MethodUnknown"


def test_judge_handles_thousands_of_policies_at_one_place() -> None:
    many = [exclusion(box(50, -20, 80, 20), "ignore" if i else "land", f"p{i:04}", priority=i % 7) for i in range(500)]
    verdict = ask(compiled(*many), goto(60, 0))
    assert (verdict.action, verdict.takeover, verdict.policies[0]) == ("takeover", "land", "p0000")
    assert len(verdict.policies) == 500
    sixth = [f"p{i:04}" for i in range(1, 500) if i % 7 == 6]
    assert list(verdict.policies[1 : len(sixth) + 1]) == sixth, "further policies are sorted by priority, then by name"


def test_altitude_bands_of_every_datum_are_respected() -> None:
    amsl = compiled(exclusion(box(50, -20, 80, 20), lower=90, upper=115, reference="amsl"), services=SERVICES)
    low = at(40, 0, alt=10)
    high = at(40, 0, alt=30)
    push = Call("SetVelocity", VelocityArgs(0, 9, hold_s=2))
    assert ask(amsl, push, low).action == "deny", "home is 100 m above sea level, so 10 m above home is inside the band"
    assert ask(amsl, push, high).action == "allow"
    sunk = replace(high, home=Home(39.36, 22.95, 80.0))
    assert ask(amsl, push, sunk).action == "deny", "home is 20 m lower, so the drone is inside the band"
    terrain = exclusion(box(50, -20, 80, 20), lower=0, upper=15, reference="terrain")
    assert ask(compiled(terrain, services=SERVICES), push, high).action == "deny", "the terrain is unknown"
    assert ask(compiled(terrain, services=SERVICES, flat_terrain=True), push, high).action == "allow"


def test_leg_out_of_zone_may_not_climb_into_it() -> None:
    above = compiled(exclusion(box(-30, -30, 30, 30), lower=14), operationArea=[])
    under = at(25, 0, alt=12.5, airframe=RETRACING)
    assert ask(above, goto(60, 0, 11), under).action == "allow", "the leg leads out from under the zone"
    assert ask(above, goto(60, 0, 30), under).action == "deny", "the drone would climb into the zone on its way out"
    assert ask(above, goto(60, 0, 12.7), under).action == "allow", "the change of height is within the altitude error"
    assert ask(above, goto(60, 0, 13.6), under).action == "deny", "the leg brings the drone closer to the zone above"
    for alt in (13.2, 13.6):
        close = replace(under, altitude_m=alt)
        assert ask(above, goto(60, 0, alt), close).action == "allow", "the leg keeps the height"
        assert ask(above, goto(60, 0, alt + 0.1), close).action == "deny", (
            "a sequence of such legs would enter the zone"
        )
    lower = replace(under, altitude_m=10.0)
    assert ask(above, goto(60, 0, 11.9), lower).action == "allow"
    assert ask(above, goto(60, 0, 12.5), lower).action == "deny", "the leg enters the height margin"
    assert ask(above, goto(60, 0, 12.1), replace(lower, altitude_m=11.9)).action == "deny"
    inside = at(25, 0, alt=20)
    assert ask(above, goto(60, 0, 30), replace(inside, airframe=RETRACING)).action == "allow"


@pytest.mark.parametrize("kind", ["altitude", "speed"])
@pytest.mark.parametrize(
    ("band", "near_m", "clear_m"),
    [
        ({"upper": 25}, 25.1, 27.1),
        ({"upper": 25}, 26.9, 27.1),
        ({"lower": 40, "upper": 60}, 39.9, 37.9),
        ({"lower": 40, "upper": 60}, 38.1, 37.9),
        ({"lower": 140, "upper": 160, "reference": "amsl"}, 38.1, 37.9),
    ],
)
def test_limit_of_zone_applies_within_the_height_margin_of_its_altitudes(
    kind: str, band: dict[str, Any], near_m: float, clear_m: float
) -> None:
    """An altitude error of 1 m and a control deviation of 1 m may carry the drone into the zone."""
    small = {"upperLimit": 5.0, "action": "refuse"}
    limit = {"altitude": altitude, "speed": speed}[kind](zones=[zone("z", box(20, -30, 60, 30), **band)], **small)
    grant = compiled(limit, operationArea=[], services=SERVICES)
    velocity = Call("SetVelocity", VelocityArgs(0, 7))
    for height_m, permitted in ((near_m, False), (clear_m, True)):
        beside = at(-20, 0, alt=height_m, speed_setpoint_mps=7.0)
        assert ask(grant, goto(80, 0, height_m), beside).permits == permitted, height_m
        velocity_m = height_m + 1.0 if near_m < clear_m else height_m - 1.0
        border = at(15, 0, alt=velocity_m, speed_setpoint_mps=7.0)
        assert ask(grant, velocity, border).permits == permitted, "a velocity keeps the control deviation twice"
        if kind == "speed":
            assert ask(grant, Call("SetSpeed", SetSpeedArgs(7.0)), at(30, 0, alt=height_m)).permits == permitted
            continue
        ground = at(40, 0, alt=0.0, in_air=False)
        if "lower" in band:
            assert ask(grant, Call("Takeoff", TakeoffArgs(height_m)), ground).permits == permitted


def test_drone_enters_zone_of_limit_from_above_only_at_permitted_altitude() -> None:
    def grant(upper_m: float) -> CompiledGrant:
        limit = altitude(zones=[zone("z", box(-30, -30, 30, 30), upper=25)], upperLimit=upper_m)
        return compiled(limit, operationArea=[], services=SERVICES)

    above = at(0, 0, alt=40)
    assert ask(grant(15), goto(0, 0, 10), above).code == "AltitudeAboveLimit"
    assert ask(grant(15), goto(100, 0, 10), above).code == "AltitudeAboveLimit"
    assert ask(grant(25), goto(0, 0, 10), above).action == "allow"
    assert ask(grant(15), goto(0, 0, 10), at(0, 0, alt=20)).action == "allow", "the drone returns below the limit"


@pytest.mark.parametrize("height_m", [26.9, 25.1])
def test_drone_too_close_above_zone_of_limit_may_continue_or_climb(height_m: float) -> None:
    limit = altitude(zones=[zone("z", box(-30, -30, 30, 30), upper=25)], upperLimit=15)
    grant = compiled(limit, operationArea=[], services=SERVICES)
    close = at(0, 0, alt=height_m)
    assert ask(grant, goto(10, 0, height_m), close).action == "allow"
    assert ask(grant, goto(0, 0, 40), close).action == "allow"
    assert ask(grant, Call("SetVelocity", VelocityArgs(1.0, 0.0, -1.0)), close).action == "allow"
    assert not ask(grant, goto(0, 0, 24), close).permits
    assert ask(grant, goto(60, 0, 24), at(-60, 0, alt=height_m)).action != "allow"


@pytest.mark.parametrize(
    ("start", "height_m"),
    [
        pytest.param((20.05, 0.0), 30.0, id="beside-and-climbing"),
        pytest.param((20.05, 0.0), 60.0, id="beside-and-climbing-high"),
        pytest.param((0.0, 0.0), 20.05, id="above"),
        pytest.param((0.0, 0.0), 21.9, id="within-the-margin-above"),
    ],
)
def test_drone_just_outside_inclusion_zone_does_not_fly_through_uncovered_air_to_another_zone(
    start: tuple[float, float], height_m: float
) -> None:
    zones = [zone("low", box(-20, -20, 20, 20), upper=20), zone("tall", box(56, -20, 100, 20), upper=80)]
    grant = compiled(policy("in", "GeofenceControl", "inclusion", zones), operationArea=[])
    present_m = height_m if start == (0.0, 0.0) else 10.0
    beside = at(*start, alt=present_m)
    verdict = ask(grant, goto(70, 0, height_m), beside)
    assert (verdict.action, verdict.code) == ("deny", "LegOutsideInclusionZone")
    back = goto(10, 0, 10.0) if start != (0.0, 0.0) else goto(0, 0, 10.0)
    assert ask(grant, back, beside).action == "allow", "the drone may return into the zone that it left"
    assert ask(grant, goto(70, 0, height_m), at(45, 0, alt=height_m)).action == "allow", "the other zone is nearest"


def test_drone_sinks_only_into_the_inclusion_zone_below_it() -> None:
    def grant(*zones: dict[str, Any]) -> CompiledGrant:
        return compiled(policy("in", "GeofenceControl", "inclusion", list(zones)), operationArea=[])

    low = zone("low", box(-20, -20, 20, 20), upper=20)
    high = zone("high", box(-20, -20, 20, 20), lower=30)
    assert ask(grant(low), goto(0, 0, 10), at(0, 0, alt=25)).action == "allow"
    assert ask(grant(low), goto(0, 0, 10), at(0, 0, alt=19)).action == "allow", "too close to the ceiling"
    assert ask(grant(low), goto(0, 0, 19), at(0, 0, alt=25)).action == "deny", "the end is too close to the ceiling"
    assert ask(grant(low), goto(5, 0, 10), at(0, 0, alt=25)).action == "deny", "the drone may fly ahead before it sinks"
    assert ask(grant(low), goto(19, 0, 10), at(19, 0, alt=25)).action == "deny", "the border is too close"
    assert ask(grant(high), goto(0, 0, 35), at(0, 0, alt=25)).action == "allow"
    assert ask(grant(low, high), goto(0, 0, 10), at(0, 0, alt=40)).action == "deny"
    assert ask(grant(low, high), goto(0, 0, 10), at(0, 0, alt=29.9)).action == "deny", "the upper zone is nearer"
    assert ask(grant(low, high), goto(0, 0, 10), at(0, 0, alt=22)).action == "allow"
    above_sea = zone("low", box(-20, -20, 20, 20), upper=120, reference="amsl")
    assert ask(grant(above_sea), goto(0, 0, 10), at(0, 0, alt=25, home=None)).action == "deny"


def test_leg_may_not_sink_out_of_inclusion_zone() -> None:
    two = policy(
        "in", "GeofenceControl", "inclusion",
        [zone("ground", box(-50, -50, 10, 50)), zone("high", box(0, -50, 60, 50), lower=16)],
    )  # fmt: skip
    grant = compiled(two, operationArea=[])
    assert ask(grant, goto(-30, 0, 5), at(-20, 0, alt=25)).action == "allow"
    sinking = ask(grant, goto(-30, 0, 5), at(30, 0, alt=25))
    assert sinking.action == "deny", (
        "the drone may leave the high zone through its bottom before it reaches the ground zone"
    )
    assert ask(grant, goto(-30, 0, 5), at(30, 0, alt=8)).action == "allow", (
        "the drone is already below the high zone, so the leg leads back into an inclusion zone"
    )
