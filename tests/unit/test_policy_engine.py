"""Single rules of the policy engine."""

from __future__ import annotations

import math
from typing import Any, get_args

import pytest
from fractus_core.api.methods import Method
from fractus_core.policy.decision_types import (
    Call,
    CaptureArgs,
    Filter,
    GotoArgs,
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
    policy,
    speed,
    target,
    zone,
)

NAN = math.nan
INF = math.inf


def test_plain_request_is_allowed_unchanged() -> None:
    verdict = ask(compiled(), goto(50, 60, 20))
    assert (verdict.action, verdict.code, verdict.policies) == ("allow", "", ())
    assert target(verdict) == pytest.approx((50, 60), abs=1e-3)
    assert verdict.args.alt == 20


# Method access


def test_method_that_is_not_granted_is_denied() -> None:
    grant = compiled(services=[{"service": "mobility", "methods": ["GetPosition"]}])
    assert ask(grant, Call("Hover")).code == "MethodNotGranted"
    assert ask(grant, Call("GetPosition")).action == "allow"
    assert ask(grant, Call("GetControl")).action == "allow", "a driver may always request control"
    passenger = compiled(services=[{"service": "mobility", "methods": ["GetPosition"]}], **{"class": "passenger"})
    assert ask(passenger, Call("GetControl")).code == "MethodNotGranted"
    assert ask(grant, Call("Explode")).code == "MethodNotGranted"


def test_denial_holds_only_in_its_zone_and_validity_window() -> None:
    denial = policy("quiet", "AccessControl", "denial", [zone("q", box(10, 10, 30, 30))], methods=["Hover"])
    grant = compiled(denial)
    assert ask(grant, Call("Hover"), at(20, 20)).code == "MethodDenied"
    assert ask(grant, Call("Hover"), at(20, 20)).policies == ("quiet",)
    assert ask(grant, Call("Hover"), at(9, 20)).code == "MethodDenied", (
        "the drone may be in the zone because of the position error"
    )
    assert ask(grant, Call("Hover"), at(0, 0)).action == "allow"
    assert ask(grant, Call("GetSpeed"), at(20, 20)).action == "allow"
    assert ask(grant, Call("Hover"), _unknown_position()).code == "MethodDenied", (
        "a drone at an unknown position may be in the zone"
    )
    late = {**denial, "spec": {**denial["spec"], "validFrom": "2026-06-01T13:00:00Z"}}
    assert ask(compiled(late), Call("Hover"), at(20, 20)).action == "allow"
    over = {**denial, "spec": {**denial["spec"], "validUntil": "2026-06-01T12:00:00Z"}}
    assert ask(compiled(over), Call("Hover"), at(20, 20)).action == "allow", "validUntil is exclusive"


def _unknown_position() -> Any:
    from dataclasses import replace

    return replace(at(), lat=None, lon=None)


def test_denial_holds_only_in_its_altitude_band() -> None:
    banded = policy(
        "quiet", "AccessControl", "denial", [zone("q", box(-9, -9, 9, 9), lower=30, upper=50)], methods=["Hover"]
    )
    grant = compiled(banded)
    assert ask(grant, Call("Hover"), at(alt=10)).action == "allow"
    assert ask(grant, Call("Hover"), at(alt=40)).code == "MethodDenied"
    assert ask(grant, Call("Hover"), at(alt=29.5)).code == "MethodDenied", (
        "the drone may be in the band because of the altitude error"
    )


def test_grant_policy_limits_method_to_its_zone() -> None:
    grant = compiled(policy("here", "AccessControl", "grant", [zone("h", box(10, 10, 30, 30))], methods=["Hover"]))
    assert ask(grant, Call("Hover"), at(20, 20)).action == "allow"
    assert ask(grant, Call("Hover"), at(0, 0)).code == "MethodNotGrantedHere"
    assert ask(grant, Call("Hover"), _unknown_position()).code == "MethodNotGrantedHere"
    assert ask(grant, Call("GetSpeed"), at(0, 0)).action == "allow"


def test_denial_overrides_grant_regardless_of_priority() -> None:
    both = (
        policy("yes", "AccessControl", "grant", methods=["Hover"], priority=1000),
        policy("no", "AccessControl", "denial", methods=["Hover"], priority=-1000),
    )
    assert ask(compiled(*both), Call("Hover")).code == "MethodDenied"


def test_verdict_names_higher_priority_policy_first() -> None:
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
def test_goto_with_invalid_arguments_is_denied(args: GotoArgs | None) -> None:
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
def test_calls_with_invalid_arguments_are_denied(call: Call) -> None:
    assert ask(compiled(), call).code == "InvalidArgument"


@pytest.mark.parametrize(
    "method", [method for method in get_args(Method) if method not in {"GetControl", "ReturnControl"}]
)
def test_reason_of_a_call_without_arguments_does_not_repeat_the_method(method: Method) -> None:
    assert not ask(compiled(), Call(method), at(0, 0)).reason.startswith(method)


def test_motion_is_denied_when_position_is_unknown() -> None:
    for call in (
        goto(5, 5),
        Call("Takeoff", TakeoffArgs(10)),
        Call("Arm"),
        Call("Land"),
        Call("SetSpeed", SetSpeedArgs(3)),
    ):
        assert ask(compiled(), call, _unknown_position()).code == "PositionUnknown"
        assert ask(compiled(), call, at(north_mps=NAN)).code == "PositionUnknown"
    assert ask(compiled(), Call("Hover"), _unknown_position()).action == "allow"
    down = Call("PointGimbal", PointGimbalArgs(-90))
    assert (ask(compiled(), down, _unknown_position()).action, ask(compiled(), down, _unknown_position()).args) == (
        "allow",
        down.args,
    )
    assert ask(compiled(), goto(5, 5), at(home=None)).code == "HomeUnknown"


# Limits


def test_altitude_is_corrected_to_enforced_limit() -> None:
    grant = compiled(altitude(upperLimit=15, lowerLimit=5, action="enforce"))
    high = ask(grant, goto(10, 10, 20))
    low = ask(grant, goto(10, 10, 4))
    assert (high.action, high.code, high.args.alt, high.policies) == (
        "correct",
        "AltitudeAboveLimit",
        14.8,
        ("altitudes",),
    )
    assert (low.action, low.code, low.args.alt) == ("correct", "AltitudeBelowLimit", 5.2)
    assert "20.0" in high.reason
    assert "15.0" in high.reason
    assert ask(grant, Call("Takeoff", TakeoffArgs(40))).args == TakeoffArgs(14.8)


@pytest.mark.parametrize("action", ["enforce", "refuse"])
def test_value_at_limit_is_allowed_and_flown_inside_it_by_the_overshoot(action: str) -> None:
    grant = compiled(altitude(upperLimit=15, lowerLimit=5, action=action), speed(upperLimit=10, action=action))
    requests: list[tuple[Call, Any]] = [
        (goto(10, 10, 15, speed_mps=10), (14.8, 9.5)),
        (goto(10, 10, 5, speed_mps=9.6), (5.2, 9.5)),
        (Call("Takeoff", TakeoffArgs(15)), 14.8),
        (Call("SetSpeed", SetSpeedArgs(10)), 9.5),
    ]
    for call, commanded in requests:
        verdict = ask(grant, call)
        assert (verdict.action, verdict.code, verdict.reason) == ("allow", "", "")
        match verdict.args:
            case GotoArgs():
                assert (verdict.args.alt, verdict.args.speed_mps) == commanded
            case TakeoffArgs(altitude_m):
                assert altitude_m == commanded
            case SetSpeedArgs(speed_mps):
                assert speed_mps == commanded


def test_leg_without_speed_is_flown_inside_the_limit_of_its_speed_setpoint() -> None:
    grant = compiled(speed(upperLimit=10))
    verdict = ask(grant, goto(50, 0, 10), at(speed_setpoint_mps=10.0))
    assert (verdict.action, verdict.args.speed_mps) == ("allow", 9.5)


def test_correction_explains_the_distance_from_the_limit() -> None:
    verdict = ask(compiled(speed(upperLimit=10)), Call("SetSpeed", SetSpeedArgs(12)))
    assert verdict.reason == (
        "speed 12.0 m/s is above the limit of policy speeds; corrected to 9.5 m/s (limit 10.0 less 0.5 for overshoot)"
    )


def test_altitude_between_close_limits_is_their_middle() -> None:
    grant = compiled(altitude(upperLimit=15.2, lowerLimit=15))
    for requested_m in (10, 15, 15.1, 15.2, 30):
        assert ask(grant, goto(10, 10, requested_m)).args.alt == pytest.approx(15.1)


def test_altitude_beyond_refusing_limit_is_denied() -> None:
    grant = compiled(altitude(upperLimit=15, action="refuse"), altitude("lax", upperLimit=10, action="enforce"))
    assert ask(grant, goto(10, 10, 20)).action == "deny"
    assert ask(grant, goto(10, 10, 20)).policies == ("altitudes",)
    assert ask(grant, goto(10, 10, 12)).args.alt == 9.8


def test_altitude_is_corrected_to_most_restrictive_limit() -> None:
    grant = compiled(altitude("a", upperLimit=30), altitude("b", upperLimit=12), altitude("c", upperLimit=20))
    verdict = ask(grant, goto(10, 10, 50))
    assert verdict.args.alt == 11.8
    assert verdict.policies == ("b", "c", "a")


def test_limits_of_the_drone_are_enforced() -> None:
    assert ask(compiled(), goto(10, 10, 500)).args.alt == 119.8
    assert ask(compiled(), Call("SetSpeed", SetSpeedArgs(99))).args == SetSpeedArgs(14.25)


def test_contradicting_limits_deny() -> None:
    grant = compiled(altitude("low", upperLimit=10), altitude("high", lowerLimit=20))
    verdict = ask(grant, goto(10, 10, 15))
    assert verdict.action == "deny"
    assert set(verdict.policies) <= {"low", "high"}


def test_zone_limit_applies_to_every_leg_that_touches_the_zone() -> None:
    grant = compiled(altitude(zones=[zone("low", box(40, -20, 60, 20))], upperLimit=15))
    assert ask(grant, goto(0, 100, 50)).action == "allow"
    assert ask(grant, goto(100, 0, 50)).args.alt == 14.8
    high = ask(grant, goto(50, 0, 10), at(alt=30))
    assert (high.action, high.code) == ("deny", "AltitudeAboveLimit"), "the drone would enter the zone at 30 m"
    assert ask(grant, goto(45, 0, 10), at(50, 0, alt=30)).action == "allow", (
        "the drone is already inside, and the leg leads to a permitted altitude"
    )


def test_altitude_limit_above_sea_level_is_converted() -> None:
    grant = compiled(altitude(upperLimit=130, altitudeReference="amsl"))
    assert ask(grant, goto(10, 10, 50)).args.alt == pytest.approx(29.8)
    amsl = ask(grant, goto(10, 10, 120, reference="amsl"))
    assert amsl.action == "allow"
    assert (amsl.args.alt, amsl.args.reference) == (pytest.approx(20), "home")


def test_terrain_altitude_is_unknown_without_flat_terrain() -> None:
    limit = altitude(upperLimit=15, altitudeReference="terrain")
    assert ask(compiled(limit), goto(10, 10, 10)).code == "TerrainUnknown"
    assert ask(compiled(limit, flat_terrain=True), goto(10, 10, 20)).args.alt == 14.8
    assert ask(compiled(), goto(10, 10, 10, reference="terrain")).code == "TerrainUnknown"
    flat = ask(compiled(flat_terrain=True), goto(10, 10, 10, reference="terrain"))
    assert flat.action == "allow"
    assert "level with home" in flat.reason


def test_speed_is_corrected_or_denied_by_limits() -> None:
    grant = compiled(speed(upperLimit=8, lowerLimit=2), speed("slow", [zone("s", box(40, -20, 60, 20))], upperLimit=3))
    assert ask(grant, Call("SetSpeed", SetSpeedArgs(10))).args == SetSpeedArgs(7.5)
    assert ask(grant, Call("SetSpeed", SetSpeedArgs(1))).args == SetSpeedArgs(2)
    assert ask(grant, Call("SetSpeed", SetSpeedArgs(7)), at(50, 0)).args.speed_mps == pytest.approx(2.55)
    leg = ask(grant, goto(100, 0))
    assert (leg.action, leg.code, leg.args.speed_mps) == ("correct", "SpeedAboveLimit", pytest.approx(2.55))
    assert ask(grant, goto(0, 100)).args.speed_mps is None
    assert ask(compiled(speed(upperLimit=4, action="refuse")), goto(0, 100)).code == "SpeedAboveLimit"


@pytest.mark.parametrize("requested_mps", [1.0, 4.6, 5.0, 9.0])
def test_minimum_speed_is_commanded_if_the_maximum_leaves_no_room_above_it(requested_mps: float) -> None:
    verdict = ask(compiled(speed(upperLimit=5, lowerLimit=4.6)), Call("SetSpeed", SetSpeedArgs(requested_mps)))
    assert verdict.args == SetSpeedArgs(4.6)


# Pictures


def test_capture_is_denied_outside_the_operation_area() -> None:
    assert ask(compiled(), Call("CaptureImage", CaptureArgs())).action == "allow"
    assert ask(compiled(), Call("CaptureImage", CaptureArgs()), at(0, 250)).code == "OutsideOperationArea"
    assert ask(compiled(), Call("CaptureImage", CaptureArgs()), _unknown_position()).code == "PositionUnknown"


def test_privacy_policy_denies_or_returns_filters() -> None:
    def private(name: str, action: str, *area: float) -> dict[str, Any]:
        return policy(name, "PrivacyControl", "camera", [zone(name, box(*area))], action=action)

    grant = compiled(private("faces", "blurFaces", 10, 10, 50, 50), private("never", "refuse", 30, 30, 50, 50))
    for method in CAMERA:
        assert ask(grant, Call(method), at(alt=5)).filters == ()
        assert ask(grant, Call(method), at(20, 20, alt=5)).filters == (Filter("blurFaces"),)
        assert ask(grant, Call(method), at(40, 40)).code == "PrivacyZone"


# Schedules


def test_zone_applies_only_while_its_schedule_is_active() -> None:
    def at_night(kind: str, *area: float) -> dict[str, Any]:
        scheduled = {**zone("z", box(*area)), "schedule": [{"start": "22:00", "end": "06:00"}]}
        return policy("night", "GeofenceControl", kind, [scheduled])

    noon = at()
    midnight = at(time_s=NOW + 12 * 3600)
    shut = compiled(at_night("exclusion", 50, -20, 80, 20))
    assert ask(shut, goto(60, 0), noon).action == "allow"
    assert ask(shut, goto(60, 0), midnight).code == "InsideExclusionZone"
    inclusion_grant = compiled(at_night("inclusion", -100, -100, 100, 100))
    assert ask(inclusion_grant, goto(60, 0), midnight).action == "allow"
    assert ask(inclusion_grant, goto(60, 0), noon).action == "deny", "an inactive inclusion zone permits nothing"


def test_verdicts_are_deterministic() -> None:
    grant = compiled(exclusion(box(50, -20, 80, 20), "adjust"), altitude(upperLimit=15))
    assert len({repr(ask(grant, goto(150, 0, 30))) for _ in range(5)}) == 1
    assert FRAME.lat == HOME.lat
