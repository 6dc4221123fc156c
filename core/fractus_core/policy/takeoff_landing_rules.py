"""Rules for Arm, Takeoff, Land and Disarm."""

from __future__ import annotations

import shapely

from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant
from fractus_core.policy.decision_types import (
    DENY_NO_ARGUMENTS,
    DENY_POSITION_UNKNOWN,
    Call,
    Situation,
    TakeoffArgs,
    Verdict,
    deny,
    distinct,
)
from fractus_core.policy.geofences import find_breaches
from fractus_core.policy.goto_rules import check_return
from fractus_core.policy.kinematics import XY, stop_point, vertical_leg
from fractus_core.policy.limits import altitude_bounds, choose_objection, clamp, correction_verdict, deny_unknown_datum


def judge_takeoff(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge a climb from the ground."""
    args = call.args
    position = grant.locate(now)
    if position is None or not isinstance(args, TakeoffArgs):
        return DENY_POSITION_UNKNOWN if position is None else DENY_NO_ARGUMENTS
    lower, upper = sorted((now.altitude_m, args.altitude_m))
    air = AirVolume(shapely.points(position), now.margin_m, lower, upper)
    bounds, unknown = altitude_bounds(grant, now, air, now.height_margin_m)
    if unknown:
        return deny_unknown_datum(unknown[0])
    clamped = clamp("Altitude", "m above home", args.altitude_m, bounds)
    if isinstance(clamped, Verdict):
        return clamped
    correction = correction_verdict(TakeoffArgs(clamped.value), [clamped])
    problem = _climb_problem(position, now, grant, clamped.value)
    if problem is None or not clamped.code:
        return problem or correction
    return choose_objection(problem, _climb_problem(position, now, grant, args.altitude_m), correction)


def _climb_problem(position: XY, now: Situation, grant: CompiledGrant, altitude_m: float) -> Verdict | None:
    """Return the denial of a climb that breaks a fence or has no legal return route, or None."""
    return _vertical_problem(position, now, grant, now.altitude_m, altitude_m) or check_return(
        position, altitude_m, now, grant
    )


def judge_arm(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge arming at the drone's position."""
    position = grant.locate(now)
    if position is None:
        return DENY_POSITION_UNKNOWN
    return _vertical_problem(position, now, grant, now.altitude_m, now.altitude_m) or Verdict("allow", call.args)


def judge_land(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge a descent to the ground from the point where the drone comes to rest."""
    position = grant.locate(now)
    if position is None:
        return DENY_POSITION_UNKNOWN
    ground = stop_point(now, position)
    return _vertical_problem(ground, now, grant, 0.0, now.altitude_m) or Verdict("allow", call.args)


def _vertical_problem(
    position: XY, now: Situation, grant: CompiledGrant, lower_m: float, upper_m: float
) -> Verdict | None:
    """Return the denial of a vertical motion, or of staying on the ground, that breaks a fence.

    The verdict is never a takeover.
    """
    leg = vertical_leg(position, min(lower_m, upper_m), max(lower_m, upper_m))
    breaches = find_breaches(leg, now, grant, now.margin_m, now.height_margin_m)
    if not breaches:
        return None
    return deny(breaches[0].code, breaches[0].reason, distinct(b.policy for b in breaches))


def judge_disarm(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge disarming."""
    if now.in_air:
        return deny("InAir", f"the drone is in the air at {now.altitude_m:.1f} m; land before disarming")
    return Verdict("allow", call.args)
