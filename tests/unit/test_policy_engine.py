"""The engine's rules, one by one."""

from __future__ import annotations

import math
from typing import Any

import pytest
from fractus_core.policy.motion import stopping_distance_m
from fractus_core.policy.values import (
    Airframe,
    Call,
    CaptureArgs,
    Filter,
    GotoArgs,
    Home,
    PointGimbalArgs,
    SetSpeedArgs,
    TakeoffArgs,
)
from policy_world import (
    CAMERA,
    FRAME,
    HOME,
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
    speed,
    target,
    zone,
)

NAN, INF = math.nan, math.inf


def test_a_plain_request_is_allowed_as_asked() -> None:
    verdict = ask(compiled(), goto(50, 60, 20))
    assert (verdict.action, verdict.code, verdict.policies) == ("allow", "", ())
    assert target(verdict) == pytest.approx((50, 60), abs=1e-3)
    assert verdict.args.alt == 20


# Method access


def test_a_method_that_is_not_granted_is_denied() -> None:
    grant = compiled(services=[{"service": "mobility", "methods": ["GetPosition"]}])
    assert ask(grant, Call("Hover")).code == "MethodNotGranted"
    assert ask(grant, Call("GetPosition")).action == "allow"
    assert ask(grant, Call("GetControl")).action == "allow", "a driver may always ask for control"
    passenger = compiled(services=[{"service": "mobility", "methods": ["GetPosition"]}], **{"class": "passenger"})
    assert ask(passenger, Call("GetControl")).code == "MethodNotGranted"
    assert ask(grant, Call("Explode")).code == "MethodNotGranted"


def test_denial_holds_in_its_zone_and_window_only() -> None:
    denial = policy("quiet", "AccessControl", "denial", [zone("q", box(10, 10, 30, 30))], methods=["Hover"])
    grant = compiled(denial)
    assert ask(grant, Call("Hover"), at(20, 20)).code == "MethodDenied"
    assert ask(grant, Call("Hover"), at(20, 20)).policies == ("quiet",)
    assert ask(grant, Call("Hover"), at(9, 20)).code == "MethodDenied", "inside the position error"
    assert ask(grant, Call("Hover"), at(0, 0)).action == "allow"
    assert ask(grant, Call("GetSpeed"), at(20, 20)).action == "allow"
    assert ask(grant, Call("Hover"), _lost()).code == "MethodDenied", "unknown may be inside"
    late = {**denial, "spec": {**denial["spec"], "validFrom": "2026-06-01T13:00:00Z"}}
    assert ask(compiled(late), Call("Hover"), at(20, 20)).action == "allow"
    over = {**denial, "spec": {**denial["spec"], "validUntil": "2026-06-01T12:00:00Z"}}
    assert ask(compiled(over), Call("Hover"), at(20, 20)).action == "allow", "until is exclusive"


def _lost() -> Any:
    from dataclasses import replace

    return replace(at(), lat=None, lon=None)


def test_denial_respects_its_altitude_band() -> None:
    banded = policy(
        "quiet", "AccessControl", "denial", [zone("q", box(-9, -9, 9, 9), lower=30, upper=50)], methods=["Hover"]
    )
    grant = compiled(banded)
    assert ask(grant, Call("Hover"), at(alt=10)).action == "allow"
    assert ask(grant, Call("Hover"), at(alt=40)).code == "MethodDenied"
    assert ask(grant, Call("Hover"), at(alt=29.5)).code == "MethodDenied", "inside the altitude error"


def test_a_grant_policy_says_where_a_method_is_granted() -> None:
    grant = compiled(policy("here", "AccessControl", "grant", [zone("h", box(10, 10, 30, 30))], methods=["Hover"]))
    assert ask(grant, Call("Hover"), at(20, 20)).action == "allow"
    assert ask(grant, Call("Hover"), at(0, 0)).code == "MethodNotGrantedHere"
    assert ask(grant, Call("Hover"), _lost()).code == "MethodNotGrantedHere"
    assert ask(grant, Call("GetSpeed"), at(0, 0)).action == "allow"


def test_denial_beats_grant_whatever_the_priority() -> None:
    both = (
        policy("yes", "AccessControl", "grant", methods=["Hover"], priority=1000),
        policy("no", "AccessControl", "denial", methods=["Hover"], priority=-1000),
    )
    assert ask(compiled(*both), Call("Hover")).code == "MethodDenied"


def test_higher_priority_is_named_first_among_equals() -> None:
    two = (
        policy("b-second", "AccessControl", "denial", methods=["Hover"], priority=1),
        policy("a-third", "AccessControl", "denial", methods=["Hover"]),
        policy("z-first", "AccessControl", "denial", methods=["Hover"], priority=5),
    )
    assert ask(compiled(*two), Call("Hover")).policies == ("z-first", "b-second", "a-third")


# Arguments


@pytest.mark.parametrize(
    "args",
    [
        GotoArgs(NAN, 0, 10), GotoArgs(0, INF, 10), GotoArgs(91, 0, 10), GotoArgs(0, -181, 10), GotoArgs(39.36, 22.95, NAN),
        GotoArgs(39.36, 22.95, -INF), GotoArgs(39.36, 22.95, 30_000), GotoArgs(39.36, 22.95, 10, yaw_deg=NAN),
        GotoArgs(39.36, 22.95, 10, speed_mps=-1), GotoArgs(-39.36, -157.05, 10), GotoArgs(41.36, 22.95, 10), None,
    ],
)  # fmt: skip
def test_goto_with_impossible_arguments(args: GotoArgs | None) -> None:
    for operation in ([box(-200, -200, 200, 200)], []):
        verdict = ask(compiled(operationArea=operation), Call("Goto", args))
        assert (verdict.action, verdict.code) == ("deny", "InvalidArgument")


@pytest.mark.parametrize(
    "call",
    [
        Call("Takeoff", TakeoffArgs(NAN)), Call("Takeoff", TakeoffArgs(-5)), Call("Takeoff", TakeoffArgs(INF)), Call("Takeoff"),
        Call("SetSpeed", SetSpeedArgs(NAN)), Call("SetSpeed", SetSpeedArgs(0)), Call("SetSpeed", SetSpeedArgs(-3)),
        Call("PointGimbal"), Call("PointGimbal", PointGimbalArgs(NAN)), Call("PointGimbal", PointGimbalArgs(-91)),
        Call("PointGimbal", PointGimbalArgs(0, 181)), Call("SetSpeed"), Call("CaptureImage", CaptureArgs(-1, 0)), Call("CaptureImage", CaptureArgs(0, 10**9)),
    ],
)  # fmt: skip
def test_other_impossible_arguments(call: Call) -> None:
    assert ask(compiled(), call).code == "InvalidArgument"


def test_without_position_nothing_moves() -> None:
    for call in (
        goto(5, 5),
        Call("Takeoff", TakeoffArgs(10)),
        Call("Arm"),
        Call("Land"),
        Call("SetSpeed", SetSpeedArgs(3)),
    ):
        assert ask(compiled(), call, _lost()).code == "PositionUnknown"
        assert ask(compiled(), call, at(north_mps=NAN)).code == "PositionUnknown"
    assert ask(compiled(), Call("Hover"), _lost()).action == "allow"
    down = Call("PointGimbal", PointGimbalArgs(-90))
    assert (ask(compiled(), down, _lost()).action, ask(compiled(), down, _lost()).args) == ("allow", down.args)
    assert ask(compiled(), goto(5, 5), at(home=None)).code == "HomeUnknown"


# Limits


def test_altitudes_are_clamped_to_the_limit() -> None:
    grant = compiled(altitude(upperLimit=15, lowerLimit=5, action="enforce"))
    high, low = ask(grant, goto(10, 10, 20)), ask(grant, goto(10, 10, 4))
    assert (high.action, high.code, high.args.alt, high.policies) == (
        "correct",
        "AltitudeAboveLimit",
        15,
        ("altitudes",),
    )
    assert (low.action, low.code, low.args.alt) == ("correct", "AltitudeBelowLimit", 5)
    assert "20.0" in high.reason
    assert "15.0" in high.reason
    assert ask(grant, Call("Takeoff", TakeoffArgs(40))).args == TakeoffArgs(15)
    assert ask(grant, goto(10, 10, 15)).action == "allow"


def test_a_limit_may_refuse() -> None:
    grant = compiled(altitude(upperLimit=15, action="refuse"), altitude("lax", upperLimit=10, action="enforce"))
    assert ask(grant, goto(10, 10, 20)).action == "deny"
    assert ask(grant, goto(10, 10, 20)).policies == ("altitudes",)
    assert ask(grant, goto(10, 10, 12)).args.alt == 10


def test_the_most_restrictive_limit_wins() -> None:
    grant = compiled(altitude("a", upperLimit=30), altitude("b", upperLimit=12), altitude("c", upperLimit=20))
    verdict = ask(grant, goto(10, 10, 50))
    assert verdict.args.alt == 12
    assert verdict.policies == ("b", "c", "a")


def test_the_drone_has_its_own_limits() -> None:
    assert ask(compiled(), goto(10, 10, 500)).args.alt == 120
    assert ask(compiled(), Call("SetSpeed", SetSpeedArgs(99))).args == SetSpeedArgs(15)


def test_limits_that_contradict_each_other_deny() -> None:
    grant = compiled(altitude("low", upperLimit=10), altitude("high", lowerLimit=20))
    verdict = ask(grant, goto(10, 10, 15))
    assert verdict.action == "deny"
    assert set(verdict.policies) <= {"low", "high"}


def test_a_limit_in_a_zone_holds_for_every_leg_that_touches_it() -> None:
    grant = compiled(altitude(zones=[zone("low", box(40, -20, 60, 20))], upperLimit=15))
    assert ask(grant, goto(0, 100, 50)).action == "allow"
    assert ask(grant, goto(100, 0, 50)).args.alt == 15
    high = ask(grant, goto(50, 0, 10), at(alt=30))
    assert (high.action, high.code) == ("deny", "AltitudeAboveLimit"), "it would enter at 30 m"
    assert ask(grant, goto(45, 0, 10), at(50, 0, alt=30)).action == "allow", "already inside: leading back"


def test_limits_above_sea_level() -> None:
    grant = compiled(altitude(upperLimit=130, altitudeReference="amsl"))
    assert ask(grant, goto(10, 10, 50)).args.alt == pytest.approx(30)
    amsl = ask(grant, goto(10, 10, 120, reference="amsl"))
    assert amsl.action == "allow"
    assert (amsl.args.alt, amsl.args.reference) == (pytest.approx(20), "home")


def test_terrain_is_unknown_unless_it_is_taken_for_flat() -> None:
    limit = altitude(upperLimit=15, altitudeReference="terrain")
    assert ask(compiled(limit), goto(10, 10, 10)).code == "TerrainUnknown"
    assert ask(compiled(limit, flat_terrain=True), goto(10, 10, 20)).args.alt == 15
    assert ask(compiled(), goto(10, 10, 10, reference="terrain")).code == "TerrainUnknown"
    flat = ask(compiled(flat_terrain=True), goto(10, 10, 10, reference="terrain"))
    assert flat.action == "allow"
    assert "level with home" in flat.reason


def test_speeds() -> None:
    grant = compiled(speed(upperLimit=8, lowerLimit=2), speed("slow", [zone("s", box(40, -20, 60, 20))], upperLimit=3))
    assert ask(grant, Call("SetSpeed", SetSpeedArgs(10))).args == SetSpeedArgs(8)
    assert ask(grant, Call("SetSpeed", SetSpeedArgs(1))).args == SetSpeedArgs(2)
    assert ask(grant, Call("SetSpeed", SetSpeedArgs(7)), at(50, 0)).args == SetSpeedArgs(3)
    leg = ask(grant, goto(100, 0))
    assert (leg.action, leg.code, leg.args.speed_mps) == ("correct", "SpeedAboveLimit", 3)
    assert ask(grant, goto(0, 100)).args.speed_mps is None
    assert ask(compiled(speed(upperLimit=4, action="refuse")), goto(0, 100)).code == "SpeedAboveLimit"


# Fences


def test_targets_outside_the_operation_area_are_refused() -> None:
    verdict = ask(compiled(), goto(0, 230))
    assert (verdict.action, verdict.code, verdict.takeover) == ("deny", "OutsideOperationArea", None)
    assert "30.0 m outside" in verdict.reason
    assert ask(compiled(), goto(0, 198)).code == "OutsideOperationArea", "within the margin of the border"
    assert ask(compiled(), goto(0, 197)).action == "allow"
    assert ask(compiled(operationArea=[]), goto(0, 230)).action == "allow"


def test_a_leg_that_cuts_a_corner_of_the_operation_area_is_refused() -> None:
    corner = [ring([(-20, -20), (100, -20), (100, 20), (20, 20), (20, 100), (-20, 100)])]
    grant = compiled(operationArea=corner)
    assert ask(grant, goto(0, 90), at(0, 0)).action == "allow"
    assert ask(grant, goto(90, 0), at(0, 90)).code == "OutsideOperationArea"


def test_the_way_to_the_operation_area_and_home() -> None:
    grant = compiled(operationArea=[box(50, -20, 150, 20)], corridor=[box(-30, -30, 150, 30)])
    assert ask(grant, goto(100, 0), at(0, 0)).action == "allow"
    assert ask(grant, goto(20, 0), at(0, 0)).code == "OutsideOperationArea", "the way is not a place to work"
    assert ask(grant, goto(0, 0), at(100, 0)).action == "allow", "home"
    assert ask(grant, Call("Takeoff", TakeoffArgs(10)), at(0, 0, 0)).action == "allow"
    partial = compiled(operationArea=[box(50, -20, 150, 20)], corridor=[box(-30, -30, 150, 30)], control="partial")
    assert ask(partial, goto(100, 0), at(0, 0)).action == "allow", "leading in"
    assert ask(partial, Call("Arm"), at(0, 0, 0)).code == "OutsideOperationArea"


def test_the_way_from_home_is_not_bound_to_an_operation_area_that_home_happens_to_lie_in() -> None:
    bend = ring([(-10, -5), (60, -5), (60, 60), (50, 60), (50, 5), (-10, 5)])
    grant = compiled(operationArea=[bend], corridor=[box(-30, -30, 100, 100)])
    assert ask(grant, goto(55, 50), at(0, 0)).action == "allow"
    assert ask(grant, goto(55, 50), at(20, 0)).code == "OutsideOperationArea", "at work it stays inside"
    partial = compiled(operationArea=[bend], corridor=[box(-30, -30, 100, 100)], control="partial")
    assert ask(partial, goto(55, 50), at(0, 0)).code == "OutsideOperationArea", "the system flies there"


def test_a_driver_with_partial_control_works_where_the_system_can_fly_home_around_a_zone() -> None:
    fields = {"operationArea": [box(50, -20, 150, 20)], "corridor": [box(-30, -60, 150, 60)], "control": "partial"}
    retracing = at(60, 0, airframe=Airframe(retraces=True))
    beside, across = exclusion(box(20, -10, 40, 10)), exclusion(box(20, -70, 40, 70))
    assert ask(compiled(beside, **fields), goto(100, 0), retracing).action == "allow"
    assert ask(compiled(across, **fields), goto(100, 0), retracing).code == "WayHomeBlocked"
    assert ask(compiled(beside, **fields), goto(100, 0), at(60, 0)).code == "WayHomeBlocked", "it flies home straight"


def test_exclusion_zones() -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20)))
    inside, through, near = ask(grant, goto(60, 0)), ask(grant, goto(150, 0)), ask(grant, goto(48, 0))
    assert (inside.action, inside.code) == ("deny", "InsideExclusionZone")
    assert "10.0 m inside" in inside.reason
    assert through.code == "LegThroughExclusionZone"
    assert "30.0 m" in through.reason
    assert near.code == "TooCloseToExclusionZone"
    assert ask(grant, goto(47, 0)).action == "allow"
    assert ask(grant, goto(47, 0), at(position_error_m=3)).code == "TooCloseToExclusionZone"


def test_distances_that_round_to_nothing_are_told_as_such() -> None:
    zone_at = exclusion(box(50, -20, 80, 20))
    told = [
        ask(compiled(exclusion(ring([(50, 0.01), (40, -20), (60, -20)]))), goto(100, 0)),
        ask(compiled(zone_at), goto(50.01, 0)),
        ask(compiled(zone_at), goto(49.99, 0)),
        ask(compiled(inclusion(box(-50, -50, 50, 50))), goto(50.01, 0)),
        ask(compiled(inclusion(box(-50, -50, 50, 50))), goto(49.99, 0)),
        ask(compiled(), goto(0, 199.99)),
        ask(compiled(), goto(0, 200.01)),
        ask(compiled(), Call("CaptureImage"), at(0, 200.01)),
    ]
    for verdict in told:
        assert not verdict.permits
        assert " 0.0 m" not in verdict.reason, verdict
    assert "touches zone no-fly-zone" in told[0].reason
    assert "less than 0.1 m inside zone no-fly-zone" in told[1].reason
    assert "comes within 0.1 m of zone no-fly-zone" in told[2].reason


def test_a_turn_that_sweeps_a_zone_beside_the_leg_is_told_apart() -> None:
    verdict = ask(compiled(exclusion(box(1, 5, 3, 9))), goto(0, 60), at(east_mps=5.0, north_mps=0.0))
    assert verdict.code == "LegThroughExclusionZone"
    assert "turn onto the leg touches zone no-fly-zone" in verdict.reason


def test_a_zone_in_a_band_of_altitudes_may_be_overflown() -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20), upper=20))
    assert ask(grant, goto(150, 0, 30), at(alt=30)).action == "allow"
    assert ask(grant, goto(150, 0, 30), at(alt=10)).code == "LegThroughExclusionZone", "it may climb too late"
    assert ask(grant, goto(150, 0, 21), at(alt=21)).code == "LegThroughExclusionZone", "within the altitude margin"
    high = compiled(exclusion(box(50, -20, 80, 20), lower=140, reference="amsl"))
    assert ask(high, goto(60, 0, 20)).action == "allow"
    assert ask(high, goto(60, 0, 39)).code == "InsideExclusionZone"
    unknown = compiled(exclusion(box(50, -20, 80, 20), upper=20, reference="terrain"))
    assert ask(unknown, goto(60, 0, 90), at(alt=90)).code == "InsideExclusionZone", "unknown terrain reaches to the sky"


@pytest.mark.parametrize("action", ["hover", "land", "returnToLaunch", "revoke"])
def test_takeovers(action: str) -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20), action))
    verdict = ask(grant, goto(60, 0))
    assert (verdict.action, verdict.takeover, verdict.policies) == ("takeover", action, ("no-fly",))
    assert ask(grant, goto(150, 0)).takeover == action, "a leg through it breaks it too"
    assert ask(grant, goto(48, 0)).action == "deny", "coming close costs no more than the request"


def test_the_strictest_fence_decides() -> None:
    actions = ("adjust", "hover", "ignore", "land", "returnToLaunch")
    zones = [exclusion(box(50, -20, 80, 20), a, f"p-{a.lower()}") for a in actions]
    verdict = ask(compiled(*zones), goto(60, 0))
    assert (verdict.action, verdict.takeover) == ("takeover", "land")
    assert verdict.policies == ("p-land", "p-returntolaunch", "p-hover", "p-ignore", "p-adjust")


def test_adjusting_shortens_the_leg() -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20), "adjust"))
    verdict = ask(grant, goto(150, 0))
    assert (verdict.action, verdict.code) == ("correct", "LegShortened")
    x, y = target(verdict)
    assert y == pytest.approx(0, abs=1e-3)
    assert 46.5 < x < 47.5
    assert ask(grant, Call("Goto", verdict.args)).action == "allow", "what is corrected is legal by itself"
    assert ask(grant, goto(150, 0), at(47, 0)).action == "deny", "nothing is left of the leg"
    both = compiled(exclusion(box(50, -20, 80, 20), "adjust"), exclusion(box(20, -20, 30, 20), "ignore", "other"))
    assert ask(both, goto(150, 0)).action == "deny"


def test_adjusting_inside_an_inclusion_zone() -> None:
    grant = compiled(inclusion(box(-30, -30, 60, 60), "adjust"))
    verdict = ask(grant, goto(0, 100))
    assert verdict.action == "correct"
    assert 56 < target(verdict)[1] < 57.5
    assert ask(compiled(inclusion(box(-30, -30, 60, 60))), goto(0, 100)).code == "OutsideInclusionZone"
    assert ask(compiled(inclusion(box(-30, -30, 60, 60), "land")), goto(0, 100)).takeover == "land"
    assert ask(compiled(inclusion(box(-30, -30, 60, 60))), goto(0, 59)).code == "TooCloseToInclusionBorder"


def test_inclusion_is_the_union_of_a_policys_zones() -> None:
    two = policy(
        "keep-in", "GeofenceControl", "inclusion",
        [zone("a", box(-30, -30, 50, 30)), zone("b", box(49, -30, 120, 30))],
    )  # fmt: skip
    assert ask(compiled(two), goto(100, 0)).action == "allow"
    apart = (inclusion(box(-30, -30, 50, 30), name="a"), inclusion(box(49, -30, 120, 30), name="b"))
    assert ask(compiled(*apart), goto(100, 0)).action == "deny", "two policies hold both"


def test_a_moving_drone_needs_room_to_turn() -> None:
    grant = compiled(exclusion(box(10, 15, 30, 30)))
    assert ask(grant, goto(0, 60), at(0, 0)).action == "allow"
    assert ask(grant, goto(0, 60), at(0, 0, east_mps=9)).code == "LegThroughExclusionZone"
    ahead = compiled(exclusion(box(15, -20, 30, 20)))
    assert ask(ahead, goto(0, 60), at(0, 0, east_mps=9)).action == "allow", "it leads away from what cannot be avoided"
    assert ask(ahead, goto(60, 60), at(0, 0, east_mps=9)).action == "deny"
    assert stopping_distance_m(9, 2.5, 1.0) == pytest.approx(2.5 / 2 + 81 / 5)
    assert stopping_distance_m(2, 2.5, 1.0) == pytest.approx(2.0)


def test_from_inside_a_zone_only_out() -> None:
    grant = compiled(exclusion(box(50, -50, 90, 50), "land"))
    inside = at(60, 0)
    assert ask(grant, goto(40, 0), inside).action == "allow"
    assert ask(grant, goto(80, 0), inside).action != "allow"
    assert ask(grant, goto(100, 0), inside).action != "allow", "the long way out leads deeper first"
    assert ask(grant, goto(49, 0), inside).action != "allow", "out, but not far enough"
    assert ask(grant, goto(80, 0), inside).action == "deny", "no second takeover for what the monitor handles"


def test_from_outside_only_in() -> None:
    grant = compiled(operationArea=[box(50, -50, 150, 50)])
    outside = at(20, 0)
    assert ask(grant, goto(100, 0), outside).action == "allow"
    assert ask(grant, goto(10, 0), outside).action == "deny"
    keep = compiled(inclusion(box(-5, -50, 150, 50)), operationArea=[])
    assert ask(keep, goto(50, 0), at(-20, 0)).action == "allow"
    assert ask(keep, goto(-10, 0), at(-20, 0)).action == "deny"


def test_the_way_home_must_stay_legal() -> None:
    wall = exclusion(box(-100, 40, 60, 50), name="wall")
    grant = compiled(wall)
    behind = at(100, 60)
    assert ask(grant, goto(0, 80), behind).code == "WayHomeBlocked"
    assert ask(grant, goto(150, 60), behind).action == "allow"
    low = compiled(exclusion(box(-100, 40, 60, 50), name="wall", upper=12))
    assert ask(low, goto(0, 80, 10), behind).action == "allow", "it returns at 15 m, above the wall"
    assert ask(compiled(inclusion(box(20, -50, 150, 150))), goto(100, 50), at(80, 50)).code == "WayHomeBlocked"


def test_vertical_motions_respect_fences() -> None:
    grant = compiled(exclusion(box(-10, -10, 10, 10), "land", lower=20))
    assert ask(grant, Call("Takeoff", TakeoffArgs(10)), at(alt=0)).action == "allow"
    assert ask(grant, Call("Takeoff", TakeoffArgs(30)), at(alt=0)).action == "deny"
    ground = compiled(exclusion(box(40, -10, 60, 10), upper=30))
    assert ask(ground, Call("Land"), at(50, 0, alt=50)).code == "InsideExclusionZone"
    assert ask(ground, Call("Land"), at(30, 0, east_mps=8)).action == "deny", "it would come down inside"
    assert ask(ground, Call("Land"), at(0, 0)).action == "allow"
    assert ask(ground, Call("Arm"), at(50, 0, alt=0)).action == "deny"


@pytest.mark.parametrize(("lower", "upper", "away", "closer"), [(12.0, 60.0, 9.0, 10.5), (-5.0, 8.0, 11.0, 9.5)])
def test_from_too_close_below_or_above_a_zone_a_leg_may_sink_or_climb_away(
    lower: float, upper: float, away: float, closer: float
) -> None:
    grant = compiled(exclusion(box(-40, -40, 40, 40), lower=lower, upper=upper))
    for x in (0.0, 39.9, 40.5):
        beside = at(x, 0, 10.0)
        assert ask(grant, goto(x, 0, away), beside).action == "allow"
        assert ask(grant, goto(x, 0, closer), beside).action == "deny"
        assert ask(grant, goto(x, 0, 10.0), beside).action == "deny", "it stays too close"
        assert ask(grant, goto(x - 20, 0, away), beside).action == "deny", "it may be over or under it first"
    moving = at(x=40.5, alt=10.0, east_mps=-8.0)
    assert ask(grant, goto(40.5, 0, away), moving).action == "deny"


def test_motors_do_not_stop_in_the_air() -> None:
    assert ask(compiled(), Call("Disarm"), at()).code == "InAir"
    assert ask(compiled(), Call("Disarm"), at(in_air=False)).action == "allow"


# Pictures


def test_pictures_are_taken_in_the_operation_area() -> None:
    assert ask(compiled(), Call("CaptureImage", CaptureArgs())).action == "allow"
    assert ask(compiled(), Call("CaptureImage", CaptureArgs()), at(0, 250)).code == "OutsideOperationArea"
    assert ask(compiled(), Call("CaptureImage", CaptureArgs()), _lost()).code == "PositionUnknown"


def test_privacy_refuses_or_names_its_filters() -> None:
    def private(name: str, action: str, *area: float) -> dict[str, Any]:
        return policy(name, "PrivacyControl", "camera", [zone(name, box(*area))], action=action)

    grant = compiled(private("faces", "blurFaces", 10, 10, 50, 50), private("never", "refuse", 30, 30, 50, 50))
    for method in CAMERA:
        assert ask(grant, Call(method), at(alt=5)).filters == ()
        assert ask(grant, Call(method), at(20, 20, alt=5)).filters == (Filter("blurFaces"),)
        assert ask(grant, Call(method), at(40, 40)).code == "PrivacyZone"


# Schedules


def test_a_zone_counts_while_it_is_active() -> None:
    def at_night(kind: str, *area: float) -> dict[str, Any]:
        scheduled = {**zone("z", box(*area)), "schedule": [{"start": "22:00", "end": "06:00"}]}
        return policy("night", "GeofenceControl", kind, [scheduled])

    noon, midnight = at(), at(time_s=NOW + 12 * 3600)
    shut = compiled(at_night("exclusion", 50, -20, 80, 20))
    assert ask(shut, goto(60, 0), noon).action == "allow"
    assert ask(shut, goto(60, 0), midnight).code == "InsideExclusionZone"
    kept = compiled(at_night("inclusion", -100, -100, 100, 100))
    assert ask(kept, goto(60, 0), midnight).action == "allow"
    assert ask(kept, goto(60, 0), noon).action == "deny", "a zone that is not active allows nothing"


# Geometry far away


def test_zones_on_the_other_side_of_the_globe_do_not_matter() -> None:
    far = [{"lat": lat, "lon": lon} for lat, lon in ((-39.3, -157.1), (-39.4, -157.1), (-39.4, -157.0))]
    grant = compiled(exclusion({"polygon": {"exterior": far}}))
    assert ask(grant, goto(50, 0)).action == "allow"


def test_the_antimeridian_is_nothing_special() -> None:
    from fractus_core.geo import LocalFrame
    from fractus_core.policy.engine import judge
    from fractus_core.policy.values import Situation

    frame = LocalFrame(-17.0, 179.9999)
    corners = [
        dict(zip(("lat", "lon"), frame.latlon(x, y), strict=True))
        for x, y in ((50, -20), (80, -20), (80, 20), (50, 20))
    ]
    grant = compiled(
        exclusion({"polygon": {"exterior": corners}}), operationArea=[],
        home={"lat": -17.0, "lon": 179.9999, "alt": 0, "altitudeReference": "amsl"},
    )  # fmt: skip
    now = Situation(time_s=0, lat=-17.0, lon=179.9999, altitude_m=10, home=Home(-17.0, 179.9999, 0), in_air=True)
    for x, code in ((60, "InsideExclusionZone"), (150, "LegThroughExclusionZone"), (40, "")):
        assert judge(Call("Goto", GotoArgs(*frame.latlon(x, 0), 10)), now, grant).code == code


def test_verdicts_are_the_same_every_time() -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20), "adjust"), altitude(upperLimit=15))
    assert len({repr(ask(grant, goto(150, 0, 30))) for _ in range(5)}) == 1
    assert FRAME.lat == HOME.lat
