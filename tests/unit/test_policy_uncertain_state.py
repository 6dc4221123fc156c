"""Uncertain state: the engine denies a request if non-finite numbers, the clock or the footprint allow no decision."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from fractus_core.policy.decision_types import Airframe, Call, CaptureArgs, Home, Lens, Situation, UncertainTime
from fractus_core.policy.engine import judge
from fractus_core.policy.monitoring import monitor
from policy_world import HOME, NOW, altitude, ask, at, box, compiled, exclusion, goto, inclusion, policy, speed, zone

CAPTURE = Call("CaptureImage", CaptureArgs())
ODD: tuple[dict[str, Any], ...] = (
    {"airframe": Airframe(accel_mps2=math.nan)},
    {"airframe": Airframe(position_gain=math.nan)},
    {"airframe": Airframe(return_altitude_m=math.inf)},
    {"position_error_m": math.nan},
    {"position_error_m": math.inf},
    {"speed_setpoint_mps": math.nan},
    {"altitude_m": math.nan},
    {"home": Home(math.nan, HOME.lon, HOME.amsl_m)},
)


@pytest.mark.parametrize("odd", ODD)
def test_implausible_state_denies_motion_and_stops_drone(odd: dict[str, Any]) -> None:
    grant = compiled(exclusion(box(-20, 20, 20, 60)))
    now = replace(at(north_mps=5.0), **odd)
    assert ask(grant, goto(0, -50), now).code == "PositionUnknown"
    assert ask(grant, Call("Land"), now).action == "deny"
    assert ask(grant, Call("Hover"), now).action == "allow"
    assert ask(grant, Call("ReturnToLaunch"), now).action == "allow"
    assert ask(grant, CAPTURE, now).action == "deny"
    verdict = monitor(now, grant)
    assert verdict is not None
    assert (verdict.action, verdict.takeover) == ("takeover", "hover")


def test_judge_raises_when_time_is_not_a_number() -> None:
    now = replace(at(), time_s=math.nan)
    with pytest.raises(ValueError, match="time"):
        judge(goto(0, 50), now, compiled())
    with pytest.raises(ValueError, match="time"):
        monitor(now, compiled())


def test_goto_keeps_minimum_altitude_unless_a_limit_permits_less() -> None:
    for low in (-40.0, 0.0, 1.9):
        assert ask(compiled(), goto(0, 50, low)).code == "AltitudeTooLow"
    assert ask(compiled(), goto(0, 50, 2.0)).action == "allow"
    assert ask(compiled(altitude(lowerLimit=1)), goto(0, 50, 1.2)).action == "allow"
    assert ask(compiled(altitude(lowerLimit=1)), goto(0, 50, 0.0)).code == "AltitudeBelowLimit"
    assert ask(compiled(altitude(upperLimit=30)), goto(0, 50, 0.5)).code == "AltitudeTooLow"


def _until(moment_s: float) -> dict[str, Any]:
    return {"validUntil": datetime.fromtimestamp(moment_s, UTC).isoformat()}


def _with(body: dict[str, Any], **spec: Any) -> dict[str, Any]:
    return {**body, "spec": {**body["spec"], **spec}}


def test_uncertain_time_applies_restrictions_of_either_reading_and_permissions_of_both() -> None:
    day = 86_400.0
    doubtful = replace(at(), time_s=UncertainTime(NOW + 3 * day, NOW))
    fence = compiled(_with(exclusion(box(-20, 20, 20, 60)), **_until(NOW + day)))
    assert ask(fence, goto(0, 40), doubtful).action == "deny"
    assert ask(fence, goto(0, 40), replace(at(), time_s=NOW + 3 * day)).action == "allow"
    coming = _with(exclusion(box(-20, 20, 20, 60)), validFrom=_until(NOW + day)["validUntil"])
    assert ask(compiled(coming), goto(0, 40), doubtful).action == "deny"
    assert ask(compiled(coming), goto(0, 40)).action == "allow"
    allowance = policy("here", "AccessControl", "grant", methods=["Hover"], **_until(NOW + day))
    assert ask(compiled(allowance), Call("Hover")).action == "allow"
    assert ask(compiled(allowance), Call("Hover"), doubtful).code == "MethodNotGrantedHere"


def test_inclusion_zone_must_be_active_at_both_readings_of_uncertain_time() -> None:
    body = inclusion(box(-80, -80, 80, 80))
    body["zones"][0]["schedule"] = [{"start": "11:00", "end": "13:00"}]
    grant = compiled(body)
    assert ask(grant, goto(0, 50)).action == "allow"
    assert ask(grant, goto(0, 50), replace(at(), time_s=UncertainTime(NOW, NOW - 6 * 3600))).action == "deny"
    assert ask(grant, goto(0, 50), replace(at(), time_s=UncertainTime(NOW + 6 * 3600, NOW))).action == "deny"


def _hours(body: dict[str, Any], *spans: str) -> dict[str, Any]:
    body["zones"][0]["schedule"] = [dict(zip(("start", "end"), span.split("-"), strict=True)) for span in spans]
    return body


_SIX_HOURS_S = 6 * 3600.0
BETWEEN = replace(at(), time_s=UncertainTime(NOW + _SIX_HOURS_S, NOW - _SIX_HOURS_S))
"""Situation with a clock that was stepped from 06:00 to 18:00, or back."""


@pytest.mark.parametrize("active", ["11:00-13:00", "17:00-23:00", "01:00-07:00", "18:00-19:00", "22:00-07:00"])
@pytest.mark.parametrize(
    ("body", "call"),
    [
        (exclusion(box(-20, 20, 20, 60)), goto(0, 40)),
        (altitude(zones=[zone("z", box(-20, 20, 20, 60))], upperLimit=5, action="refuse"), goto(0, 40)),
        (speed(zones=[zone("z", box(-20, 20, 20, 60))], upperLimit=1, action="refuse"), goto(0, 40, speed_mps=3)),
        (policy("d", "AccessControl", "denial", [zone("z", box(-20, -20, 20, 20))], methods=["Goto"]), goto(0, 40)),
        (policy("p", "PrivacyControl", "camera", [zone("z", box(-20, -20, 20, 20))], action="refuse"), CAPTURE),
    ],
)
def test_uncertain_time_applies_zones_active_at_any_time_between_the_readings(
    body: dict[str, Any], call: Call, active: str
) -> None:
    assert ask(compiled(_hours(body, active)), call, BETWEEN).action == "deny"
    assert ask(compiled(_hours(body, "18:30-05:30")), call, BETWEEN).action == "allow", (
        "the zone is active neither at the two readings of the clock nor between them"
    )
    assert ask(compiled(_hours(body, "18:01-06:00")), call, BETWEEN).action == "allow", "the end is exclusive"


def test_uncertain_time_stops_drone_in_zone_active_between_the_readings() -> None:
    grant = compiled(_hours(exclusion(box(-20, -20, 20, 20), "land"), "11:00-13:00"))
    verdict = monitor(BETWEEN, grant)
    assert verdict is not None
    assert verdict.takeover == "land"


@pytest.mark.parametrize(
    ("spans", "permits"),
    [
        (["05:00-19:00"], True),
        (["05:00-12:00", "12:00-19:00"], True),
        (["00:00-00:00"], True),
        (["12:30-11:30"], False),
        (["05:00-12:00", "12:01-19:00"], False),
        (["05:00-18:00"], False),
    ],
)
def test_uncertain_time_permits_what_is_active_at_all_times_between_the_readings(
    spans: list[str], permits: bool
) -> None:
    fence = compiled(_hours(inclusion(box(-80, -80, 80, 80)), *spans))
    assert ask(fence, goto(0, 50), BETWEEN).permits == permits
    allowance = policy("a", "AccessControl", "grant", [zone("z", box(-20, -20, 20, 20))], methods=["Hover"])
    assert ask(compiled(_hours(allowance, *spans)), Call("Hover"), BETWEEN).permits == permits


def test_uncertain_time_considers_weekdays_between_the_readings() -> None:
    """NOW is a Monday."""
    day = 86_400.0
    body = exclusion(box(-20, 20, 20, 60))
    body["zones"][0]["schedule"] = [{"days": ["Wed"], "start": "23:00", "end": "01:00"}]
    grant = compiled(body)
    for first_s, last_s, denied in (
        (0.0, 1.4 * day, False), (0.0, 2.5 * day, True), (2.53 * day, 2.6 * day, True), (2.55 * day, 9.4 * day, False),
        (2.55 * day, 9.5 * day, True), (0.0, 20_000 * day, True),
    ):  # fmt: skip
        now = replace(at(), time_s=UncertainTime(NOW + last_s, NOW + first_s))
        assert (ask(grant, goto(0, 40), now).action == "deny") == denied, (first_s, last_s)


def test_uncertain_time_ignores_zone_active_outside_the_validity_of_its_policy() -> None:
    body = _hours(_with(exclusion(box(-20, 20, 20, 60)), **_until(NOW - 3600.0)), "12:00-13:00")
    assert ask(compiled(body), goto(0, 40), BETWEEN).action == "allow"


def test_method_is_not_granted_by_zone_with_altitudes_of_unknown_datum() -> None:
    allowance = policy(
        "a", "AccessControl", "grant", [zone("z", box(-9, -9, 9, 9), upper=30, reference="terrain")], methods=["Hover"]
    )
    assert ask(compiled(allowance), Call("Hover"), at()).code == "MethodNotGrantedHere"
    assert ask(compiled(allowance, flat_terrain=True), Call("Hover"), at()).action == "allow"


@pytest.mark.parametrize(
    ("x", "height_m", "shown"),
    [(0, 20, True), (0, 35, True), (23, 20, True), (45, 20, True), (53, 20, False), (80, 70, True)],
)
def test_privacy_is_judged_by_camera_footprint(x: float, height_m: float, shown: bool) -> None:
    private = policy("p", "PrivacyControl", "camera", [zone("z", box(-20, -20, 20, 20), upper=30)], action="refuse")
    verdict = ask(compiled(private), CAPTURE, at(x, 0, alt=height_m))
    assert verdict.code == ("PrivacyZone" if shown else "")


def test_camera_denial_is_judged_by_camera_footprint() -> None:
    denial = policy("d", "AccessControl", "denial", [zone("z", box(-20, -20, 20, 20))], methods=["CaptureImage"])
    assert ask(compiled(denial), CAPTURE, at(35, 0, alt=20)).code == "MethodDenied"
    narrow = replace(at(35, 0, alt=20), lens=Lens(30.0, 20.0, stabilised=True))
    assert ask(compiled(denial), CAPTURE, narrow).action == "allow"


def test_capture_is_denied_when_position_is_unknown() -> None:
    assert ask(compiled(operationArea=[]), CAPTURE, Situation(time_s=NOW)).code == "PositionUnknown"
