"""What is not known counts against the request: figures that are no numbers, doubtful clocks, what a picture shows."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from fractus_core.policy.decision_types import Airframe, Call, CaptureArgs, Home, Lens, Situation, UncertainTime
from fractus_core.policy.engine import judge
from fractus_core.policy.monitoring import monitor
from policy_world import HOME, NOW, altitude, ask, at, box, compiled, exclusion, goto, inclusion, policy, zone

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
def test_a_state_that_is_no_number_refuses_motion_and_stops_the_drone(odd: dict[str, Any]) -> None:
    grant = compiled(exclusion(box(-20, 20, 20, 60)))
    now = replace(at(north_mps=5.0), **odd)
    assert ask(grant, goto(0, -50), now).code == "PositionUnknown"
    assert ask(grant, Call("Land"), now).action == "deny"
    assert ask(grant, Call("Hover"), now).action == "allow"
    assert ask(grant, Call("ReturnToLaunch"), now).action == "allow"
    assert ask(grant, CAPTURE, now).action == "deny"
    found = monitor(now, grant)
    assert found is not None
    assert (found.action, found.takeover) == ("takeover", "hover")


def test_a_time_that_is_no_number_is_an_error() -> None:
    now = replace(at(), time_s=math.nan)
    with pytest.raises(ValueError, match="time"):
        judge(goto(0, 50), now, compiled())
    with pytest.raises(ValueError, match="time"):
        monitor(now, compiled())


def test_a_leg_keeps_off_the_ground_unless_a_limit_speaks_of_lower() -> None:
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


def test_restrictions_hold_at_either_reading_of_the_clock_and_permissions_at_both() -> None:
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


def test_a_zone_to_stay_in_must_be_active_at_both_readings() -> None:
    body = inclusion(box(-80, -80, 80, 80))
    body["zones"][0]["schedule"] = [{"start": "11:00", "end": "13:00"}]
    grant = compiled(body)
    assert ask(grant, goto(0, 50)).action == "allow"
    assert ask(grant, goto(0, 50), replace(at(), time_s=UncertainTime(NOW, NOW - 6 * 3600))).action == "deny"
    assert ask(grant, goto(0, 50), replace(at(), time_s=UncertainTime(NOW + 6 * 3600, NOW))).action == "deny"


@pytest.mark.parametrize(
    ("x", "height_m", "seen"),
    [(0, 20, True), (0, 35, True), (23, 20, True), (45, 20, True), (53, 20, False), (80, 70, True)],
)
def test_privacy_is_judged_by_what_a_picture_shows(x: float, height_m: float, seen: bool) -> None:
    private = policy("p", "PrivacyControl", "camera", [zone("z", box(-20, -20, 20, 20), upper=30)], action="refuse")
    verdict = ask(compiled(private), CAPTURE, at(x, 0, alt=height_m))
    assert verdict.code == ("PrivacyZone" if seen else "")


def test_a_denial_of_the_camera_counts_for_what_it_would_see() -> None:
    denial = policy("d", "AccessControl", "denial", [zone("z", box(-20, -20, 20, 20))], methods=["CaptureImage"])
    assert ask(compiled(denial), CAPTURE, at(35, 0, alt=20)).code == "MethodDenied"
    narrow = replace(at(35, 0, alt=20), lens=Lens(30.0, 20.0, stabilised=True))
    assert ask(compiled(denial), CAPTURE, narrow).action == "allow"


def test_a_picture_from_nowhere_is_not_taken() -> None:
    assert ask(compiled(operationArea=[]), CAPTURE, Situation(time_s=NOW)).code == "PositionUnknown"
