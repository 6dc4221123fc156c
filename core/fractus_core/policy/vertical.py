"""Motions up and down: arming, taking off, landing, disarming."""

from __future__ import annotations

import shapely

from fractus_core.policy.compiled import Air, CompiledGrant
from fractus_core.policy.corrections import caused
from fractus_core.policy.fences import breaches
from fractus_core.policy.legs import way_home_blocked
from fractus_core.policy.limits import altitude_bounds, clamp, corrected, datum_unknown
from fractus_core.policy.motion import XY, height_margin_m, margin_m, standing, stop_point
from fractus_core.policy.values import POSITION_UNKNOWN, Call, Situation, TakeoffArgs, Verdict, deny, distinct


def judge_takeoff(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """A climb from the ground."""
    args, at = call.args, grant.locate(now)
    if at is None or not isinstance(args, TakeoffArgs):
        return POSITION_UNKNOWN if at is None else deny("InvalidArgument", "Takeoff needs its arguments")
    lower, upper = sorted((now.altitude_m, args.altitude_m))
    bounds, unknown = altitude_bounds(grant, now, Air(shapely.points(at), margin_m(now), lower, upper))
    if unknown:
        return datum_unknown(unknown[0])
    clamped = clamp("Altitude", "m above home", args.altitude_m, bounds)
    if isinstance(clamped, Verdict):
        return clamped
    correction = corrected(TakeoffArgs(clamped.value), [clamped])
    problem = _climb(at, now, grant, clamped.value)
    if problem is None or not clamped.code:
        return problem or correction
    return caused(problem, _climb(at, now, grant, args.altitude_m), correction)


def _climb(at: XY, now: Situation, grant: CompiledGrant, altitude_m: float) -> Verdict | None:
    """What fences and the way home have against a climb."""
    return _column(at, now, grant, now.altitude_m, altitude_m) or way_home_blocked(at, altitude_m, now, grant)


def judge_arm(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Motors that start where the drone stands."""
    at = grant.locate(now)
    if at is None:
        return POSITION_UNKNOWN
    return _column(at, now, grant, now.altitude_m, now.altitude_m) or Verdict("allow", call.args)


def judge_land(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """A descent to the ground from where the drone comes to rest."""
    at = grant.locate(now)
    if at is None:
        return POSITION_UNKNOWN
    ground = stop_point(now, at)
    return _column(ground, now, grant, 0.0, now.altitude_m) or Verdict("allow", call.args)


def _column(at: XY, now: Situation, grant: CompiledGrant, lower_m: float, upper_m: float) -> Verdict | None:
    """The denial of a vertical motion, or of standing, where fences forbid it; no such request is a takeover."""
    leg = standing(at, min(lower_m, upper_m), max(lower_m, upper_m))
    found = breaches(leg, now, grant, margin_m(now), height_margin_m(now))
    if not found:
        return None
    return deny(found[0].code, found[0].reason, distinct(b.policy for b in found))


def judge_disarm(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Motors that stop."""
    if now.in_air:
        return deny("InAir", f"the drone is in the air at {now.altitude_m:.1f} m; land before disarming")
    return Verdict("allow", call.args)
