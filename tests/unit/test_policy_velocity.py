"""Velocity setpoints: the engine judges the whole path of the drone until it stops."""

from __future__ import annotations

import math
from typing import Any

import pytest
from fractus_core.policy.decision_types import Airframe, Call, VelocityArgs, Verdict
from policy_world import METHODS, altitude, ask, at, box, exclusion, inclusion, ring, speed
from policy_world import compiled as granted

VELOCITY = [{"service": "mobility", "methods": [*METHODS, "SetVelocity"]}]


def compiled(*policies: dict[str, Any], **changes: Any) -> Any:
    return granted(*policies, services=VELOCITY, **changes)


def fly(north: float = 0.0, east: float = 0.0, down: float = 0.0, hold: float = 0.5) -> Call:
    return Call("SetVelocity", VelocityArgs(north, east, down, hold_s=hold))


def flown(verdict: Verdict) -> VelocityArgs:
    assert verdict.permits, verdict
    assert isinstance(verdict.args, VelocityArgs)
    return verdict.args


def test_velocity_in_free_air_is_allowed_unchanged() -> None:
    verdict = ask(compiled(), fly(5, 3, -1))
    assert (verdict.action, verdict.code, verdict.args) == ("allow", "", VelocityArgs(5, 3, -1))
    assert ask(granted(), fly(1)).code == "MethodNotGranted"


@pytest.mark.parametrize(
    "args",
    [
        VelocityArgs(math.nan, 0), VelocityArgs(0, math.inf), VelocityArgs(0, 0, -math.inf), VelocityArgs(1e9, 0),
        VelocityArgs(0, 0, 1e3), VelocityArgs(1, 0, 0, yaw_deg=math.nan), VelocityArgs(1, 0, hold_s=math.nan),
        VelocityArgs(1, 0, hold_s=0), VelocityArgs(1, 0, hold_s=-1), VelocityArgs(1, 0, hold_s=2.5), None,
    ],
)  # fmt: skip
def test_velocity_with_invalid_arguments_is_denied(args: VelocityArgs | None) -> None:
    assert ask(compiled(), Call("SetVelocity", args)).code == "InvalidArgument"


def test_velocity_is_denied_when_position_is_unknown() -> None:
    from fractus_core.policy.decision_types import Situation

    assert ask(compiled(operationArea=[]), fly(1), Situation(time_s=0)).code == "PositionUnknown"
    assert ask(compiled(), fly(1), at(home=None)).code == "HomeUnknown"


def test_velocity_leg_includes_latency_hold_and_stop() -> None:
    grant = compiled(exclusion(box(-50, 30, 50, 60)), operationArea=[])
    # 5 m/s from standstill: 0.8 s of latency and hold time, in which the drone mostly accelerates, then the stop. The
    # margin is 2.5 m.
    near = [y for y in range(31) if ask(grant, fly(5), at(0, float(y))).permits]
    assert 19 <= max(near) <= 26
    longer = [y for y in range(31) if ask(grant, fly(5, hold=2.0), at(0, float(y))).permits]
    assert max(longer) < max(near) - 3
    already = [y for y in range(31) if ask(grant, fly(5), at(0, float(y), north_mps=5)).permits]
    assert max(already) < max(near) - 3
    stop = 5 * (0.5 + 0.3 + 0.25) + 1.25 + 5
    assert max(already) <= 30 - stop - 2.5


@pytest.mark.parametrize("action", ["ignore", "hover", "land", "returnToLaunch", "abort", "revoke"])
def test_velocity_into_zone_is_denied_or_taken_over(action: str) -> None:
    grant = compiled(exclusion(box(-50, 10, 50, 60), action), operationArea=[])
    verdict = ask(grant, fly(8, hold=2.0))
    assert verdict.action == ("deny" if action == "ignore" else "takeover")
    assert verdict.policies == ("no-fly",)
    assert ask(grant, fly(-8, hold=2.0)).permits


def test_velocity_is_scaled_by_adjusting_fence() -> None:
    grant = compiled(exclusion(box(-50, 14, 50, 60), "adjust"), operationArea=[])
    call = fly(8, 1, hold=2.0)
    verdict = ask(grant, call)
    new = flown(verdict)
    assert (verdict.action, verdict.code, verdict.policies) == ("correct", "VelocityScaled", ("no-fly",))
    assert 1 < new.north_mps < 7
    assert new.east_mps == pytest.approx(new.north_mps / 8)
    assert ask(grant, Call("SetVelocity", new)).action == "allow", "the corrected velocity is legal"
    assert ask(grant, fly(8, hold=2.0), at(0, 11.4)).action == "deny", "the remaining velocity would be too small"


def test_velocity_from_inside_zone_may_only_lead_out() -> None:
    grant = compiled(exclusion(box(-50, -50, 50, 50), "land"), operationArea=[])
    inside = at(0, 45)
    assert ask(grant, fly(9, hold=2.0), inside).permits
    assert not ask(grant, fly(-3), inside).permits
    assert not ask(grant, fly(0, 3), inside).permits


def test_velocity_through_zone_is_denied_when_the_drone_may_stop_before_it() -> None:
    grant = compiled(exclusion(ring([(33.2, 9.5), (25.4, 12.8), (29.3, 5.4)])))
    hot = {"north_mps": 4.9, "east_mps": 3.2, "speed_setpoint_mps": 8.8, "airframe": Airframe(retraces=True)}
    assert ask(grant, fly(7.7, 5.9), at(20.2, -4.8, **hot)).code == "LegThroughExclusionZone"
    assert ask(grant, fly(7.7, 5.9), at(33.2, 14.5, **hot)).action == "allow", "the drone has already passed the zone"


def test_velocity_is_limited_to_operation_area_and_corridor() -> None:
    grant = compiled()
    assert ask(grant, fly(5), at(0, 195)).code == "OutsideOperationArea"
    assert ask(grant, fly(-5), at(0, 195)).permits
    apart = compiled(operationArea=[box(50, -20, 150, 20)], corridor=[box(-30, -30, 150, 30)])
    assert ask(apart, fly(0, 5), at(0, 0)).permits, "the velocity leads toward the operation area"
    assert ask(apart, fly(0, -5), at(-10, 0)).code == "OutsideOperationArea", (
        "the velocity leads away from operation area and home"
    )
    assert ask(apart, fly(0, -5), at(30, 0)).permits, "the velocity leads home"
    assert ask(apart, fly(5, 0), at(40, 22)).code == "OutsideOperationArea", "the velocity leads out of the corridor"


def test_velocity_out_of_inclusion_zone_is_denied() -> None:
    grant = compiled(inclusion(box(-30, -30, 30, 30)), operationArea=[])
    assert ask(grant, fly(5), at(0, 0)).permits
    assert ask(grant, fly(5), at(0, 25)).code in {"OutsideInclusionZone", "TooCloseToInclusionBorder"}


def test_velocity_horizontal_part_is_scaled_to_speed_limit() -> None:
    grant = compiled(speed(upperLimit=4, lowerLimit=2))
    verdict = ask(grant, fly(6, 8, -1))
    new = flown(verdict)
    assert (verdict.action, verdict.code, verdict.policies) == ("correct", "SpeedAboveLimit", ("speeds",))
    assert (new.north_mps, new.east_mps, new.down_mps) == pytest.approx((2.1, 2.8, -1))
    at_limit = ask(grant, fly(4, 0))
    assert (at_limit.action, flown(at_limit).north_mps) == ("allow", pytest.approx(3.5)), (
        "the drone overshoots by 0.5 m/s"
    )
    assert ask(grant, fly(0.1)).action == "allow", (
        "lower speed limits do not apply to velocities, because hovering is permitted"
    )
    assert ask(compiled(speed(upperLimit=4, action="refuse")), fly(6)).code == "SpeedAboveLimit"
    assert ask(compiled(), fly(99)).action == "correct", "the maximum speed of the drone applies"


def test_velocity_vertical_part_is_scaled_to_altitude_limit() -> None:
    grant = compiled(altitude(upperLimit=15, lowerLimit=5))
    climbing = ask(grant, fly(2, 0, -3, hold=2.0), at(alt=12))
    assert (climbing.action, climbing.code, climbing.policies) == ("correct", "AltitudeAboveLimit", ("altitudes",))
    assert -1.5 < flown(climbing).down_mps < 0
    assert flown(climbing).north_mps == 2
    sinking = ask(grant, fly(2, 0, 3, hold=2.0), at(alt=8))
    assert sinking.code == "AltitudeBelowLimit"
    assert 0 < flown(sinking).down_mps < 1.5
    assert ask(grant, fly(2, 0, 0), at(alt=15.3)).action == "allow", (
        "the excess is within the altitude deviation of the autopilot"
    )
    assert ask(compiled(altitude(upperLimit=15, action="refuse")), fly(0, 0, -3, hold=2.0), at(alt=12)).action == "deny"


def test_velocity_leads_drone_back_to_altitude_limits() -> None:
    grant = compiled(altitude(upperLimit=15, lowerLimit=5))
    high = ask(grant, fly(2, 0, -2), at(alt=20))
    assert (high.code, flown(high).down_mps) == ("AltitudeAboveLimit", 1.0)
    assert flown(ask(grant, fly(2), at(alt=20))).down_mps == 1.0
    assert ask(grant, fly(2, 0, 1.5), at(alt=20)).action == "allow"
    low = ask(grant, fly(2), at(alt=3))
    assert (low.code, flown(low).down_mps) == ("AltitudeBelowLimit", -1.0)


def test_velocity_into_the_ground_is_corrected() -> None:
    verdict = ask(compiled(), fly(0, 0, 3, hold=2.0), at(alt=5))
    assert verdict.code == "AltitudeBelowLimit"
    assert 0 < flown(verdict).down_mps < 1.5
    assert flown(ask(compiled(), fly(0, 0, 1), at(alt=1.5))).down_mps == 0.0
    assert ask(compiled(), fly(0, 0, -1), at(alt=1.0)).action == "allow"


def test_velocity_into_zone_with_other_altitude_limits_is_denied() -> None:
    from policy_world import zone

    grant = compiled(altitude(zones=[zone("low", box(-20, 10, 20, 60))], upperLimit=15))
    assert ask(grant, fly(8, hold=2.0), at(alt=30)).code == "AltitudeAboveLimit"
    assert not ask(grant, fly(8, hold=2.0), at(alt=30)).permits
    assert ask(grant, fly(-8, hold=2.0), at(alt=30)).action == "allow"


def test_velocity_is_denied_when_straight_return_is_blocked() -> None:
    wall = exclusion(box(-100, 40, 60, 50), name="wall")
    behind = at(110, 60)
    free = compiled(wall, operationArea=[])
    toward = fly(0, -8, hold=2.0)
    assert ask(free, toward, behind).code == "WayHomeBlocked"
    assert ask(free, fly(0, 5), behind).permits
    assert ask(free, toward, at(110, 60, airframe=Airframe(retraces=True))).permits, (
        "a drone that retraces its path can return"
    )


def test_velocity_is_denied_when_altitude_limits_are_too_close_to_stop() -> None:
    rising = at(alt=30.7, down_mps=-1.5, altitude_error_m=1.0)
    low = ask(compiled(altitude(lowerLimit=31.0)), fly(3, 0, 1.0, hold=1.7), rising)
    assert flown(low).down_mps < 0, "a sinking drone would violate the lower limit"
    band = ask(compiled(altitude(upperLimit=31.2, lowerLimit=31.0)), fly(3, 0, 1.0, hold=1.7), rising)
    assert (band.action, band.code, band.policies) == ("deny", "AltitudeAboveLimit", ("altitudes",))
    assert "Goto" in band.reason
