"""Rules for SetSpeed and SetVelocity: values are scaled or denied."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import shapely

from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant
from fractus_core.policy.decision_types import (
    DENY_NO_ARGUMENTS,
    DENY_POSITION_UNKNOWN,
    Call,
    SetSpeedArgs,
    Situation,
    VelocityArgs,
    Verdict,
    deny,
    distinct,
)
from fractus_core.policy.geofences import Breach, breach_verdict, find_breaches
from fractus_core.policy.goto_rules import check_return
from fractus_core.policy.kinematics import XY, Leg, stop_altitude_m, velocity_leg
from fractus_core.policy.limits import (
    MIN_LEG_ALTITUDE_M,
    ROUNDING_SLACK,
    Bound,
    Correction,
    allows_low_altitude,
    altitude_bounds,
    check_altitude_on_entry,
    check_contradiction,
    choose_objection,
    clamp,
    command_range,
    correction_verdict,
    deny_unknown_datum,
    speed_bounds,
    strictest_bound,
)

RETURN_CLIMB_MPS = 1.0
"""Vertical speed at which a drone that violates an altitude limit returns to the limit."""

MIN_SCALED_MPS = 0.3
"""A velocity that would be scaled below this speed is denied."""

_HALVINGS = 8
"""Bisection steps for the largest legal fraction of a velocity. The result is accurate to 0.4 %."""


def judge_speed(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge a change of the speed of legs."""
    args = call.args
    position = grant.locate(now)
    if not isinstance(args, SetSpeedArgs):
        return DENY_NO_ARGUMENTS
    if position is None:
        return DENY_POSITION_UNKNOWN
    air = AirVolume(shapely.points(position), now.margin_m, now.altitude_m, now.altitude_m)
    bounds = speed_bounds(grant, now, air, now.height_margin_m)
    clamped = clamp("Speed", "m/s", args.speed_mps, bounds)
    return clamped if isinstance(clamped, Verdict) else correction_verdict(SetSpeedArgs(clamped.value), [clamped])


@dataclass(slots=True)
class _Setpoint:
    """A velocity setpoint during its correction to limits and fences."""

    args: VelocityArgs
    now: Situation
    grant: CompiledGrant
    position: XY
    notes: list[Correction] = field(default_factory=list)
    _legs: dict[VelocityArgs, Leg] = field(default_factory=dict)

    @property
    def leg(self) -> Leg:
        """Leg that results from the present arguments."""
        return self.sweep(self.args)

    def sweep(self, args: VelocityArgs) -> Leg:
        """Return the leg that results from a velocity."""
        if args not in self._legs:
            self._legs[args] = velocity_leg(self.now, self.position, args)
        return self._legs[args]

    @property
    def air(self) -> AirVolume:
        """Volume in which limits may apply."""
        leg = self.leg
        return AirVolume(leg.ground, _margin_m(self.now), leg.lower_m, leg.upper_m)


def judge_velocity(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge a velocity setpoint by everything the drone sweeps until it stops after the hold time.

    Enforced limits scale the horizontal or the vertical part. Fences with action adjust scale the whole velocity. A
    drone beyond an altitude limit is led back regardless of the requested vertical speed. Lower speed limits do not
    apply, because hovering is always permitted.
    """
    args = call.args
    position = grant.locate(now)
    if not isinstance(args, VelocityArgs):
        return DENY_NO_ARGUMENTS
    if position is None:
        return DENY_POSITION_UNKNOWN
    setpoint = _Setpoint(args, now, grant, position)
    problem = _correct_speed(setpoint) or _correct_altitude(setpoint)
    if problem is not None:
        return problem
    limits = len(setpoint.notes)
    problem = _correct_to_fences(setpoint) or _return_problem(setpoint)
    if problem is None:
        return correction_verdict(setpoint.args, setpoint.notes)
    if not limits:
        return problem
    setpoint.args = args
    breaches = _setpoint_breaches(setpoint, args)
    return choose_objection(
        problem,
        breach_verdict(breaches) if breaches else _return_problem(setpoint),
        correction_verdict(None, setpoint.notes[:limits]),
    )


def _return_problem(setpoint: _Setpoint) -> Verdict | None:
    leg = setpoint.leg
    return check_return(leg.target, leg.upper_m, setpoint.now, setpoint.grant)


def _correct_speed(setpoint: _Setpoint) -> Verdict | None:
    args = setpoint.args
    requested = math.hypot(args.north_mps, args.east_mps)
    now = setpoint.now
    limits = speed_bounds(setpoint.grant, now, setpoint.air, _height_margin_m(now))
    bounds = [replace(b, lower=None, lowest=None) for b in limits]
    speed = clamp("Speed", "m/s", requested, bounds)
    if isinstance(speed, Verdict):
        return speed
    if speed.value < requested:
        share = max(speed.value, 0.0) / requested
        setpoint.args = replace(args, north_mps=args.north_mps * share, east_mps=args.east_mps * share)
    if speed.code:
        setpoint.notes.append(speed)
    return None


def _correct_altitude(setpoint: _Setpoint) -> Verdict | None:
    """Correct the vertical part to the altitude limits, or return a denial."""
    now = setpoint.now
    grant = setpoint.grant
    bounds, unknown = altitude_bounds(grant, now, setpoint.air, _height_margin_m(now))
    if unknown:
        return deny_unknown_datum(unknown[0])
    problem = check_contradiction("Altitude", "m", bounds) or check_altitude_on_entry(
        shapely.points(setpoint.position), (now.altitude_m, stop_altitude_m(now)), bounds, now.height_margin_m
    )
    if problem is not None:
        return problem
    floor = -math.inf if allows_low_altitude(bounds) else min(MIN_LEG_ALTITUDE_M, now.altitude_m)
    ground = Bound("", 0, floor, None, refuses=False, lowest=floor)
    for above in (True, False):
        every = bounds if above else [*bounds, ground]
        bound = strictest_bound(every, above=above)
        if bound is not None:
            requested = setpoint.args
            problem = _lead_back(setpoint, bound, command_range(every)[above], above=above)
            if problem is None and not above and setpoint.args != requested:
                problem = _no_room(setpoint, bound, strictest_bound(bounds, above=True))
            if problem is not None:
                return problem
    return None


def _no_room(setpoint: _Setpoint, lower: Bound, upper: Bound | None) -> Verdict | None:
    """Return a denial if a vertical speed corrected to stay above one limit would exceed another."""
    edge = math.inf if upper is None or upper.upper is None else upper.upper
    if upper is None or not _exceeds_limit(setpoint, setpoint.args, edge, above=True):
        return None
    names = distinct((upper.name, lower.name))
    reason = f"at this vertical speed the drone comes to rest neither below {edge:.1f} m nor above {lower.lower or 0.0:.1f} m"
    return deny("AltitudeAboveLimit", f"{reason}; stop it first, then use Goto", names)


def _lead_back(setpoint: _Setpoint, bound: Bound, edge: float, *, above: bool) -> Verdict | None:
    """Scale the vertical part so that the drone comes to rest within a limit, or turn it back toward the limit.

    Args:
        setpoint: Setpoint to correct.
        bound: Strictest limit.
        edge: Altitude to command at the limit, which is inside the limit by the overshoot.
        above: True for an upper limit.
    """
    limit = (bound.upper if above else bound.lower) or 0.0
    args = setpoint.args
    if not _exceeds_limit(setpoint, args, edge, above=above):
        return None
    breaks = _exceeds_limit(setpoint, args, limit, above=above)
    word, side = ("Above", "above") if above else ("Below", "below")
    default_source = "the drone" if above else "the ground"
    source = f"policy {bound.name}" if bound.name else default_source
    names = (bound.name,) if bound.name else ()
    toward = args.down_mps < 0 if above else args.down_mps > 0
    reason = f"the drone would come {side} the limit of {limit:.1f} m of {source}"
    if bound.refuses and toward and breaks:
        return deny(f"Altitude{word}Limit", f"{reason} (action refuse)", names)
    back = RETURN_CLIMB_MPS if above else -RETURN_CLIMB_MPS
    strays_m = setpoint.now.airframe.tracking_m
    near = edge + strays_m if above else edge - strays_m
    if not toward and (abs(args.down_mps) >= RETURN_CLIMB_MPS or not _exceeds_limit(setpoint, args, near, above=above)):
        return None
    level = replace(args, down_mps=0.0)
    if not bound.name and not above:
        new = (
            level if _exceeds_limit(setpoint, level, edge, above=above) else _scaled_climb(setpoint, edge, above=above)
        )
    elif _exceeds_limit(setpoint, level, limit, above=above):
        new = replace(args, down_mps=back)
    elif _exceeds_limit(setpoint, level, edge, above=above):
        new = level
    else:
        new = _scaled_climb(setpoint, edge, above=above)
    if new.down_mps != args.down_mps:
        setpoint.args = new
    if breaks and new.down_mps != args.down_mps:
        note = f"{reason}; its vertical speed is corrected from {args.down_mps:.1f} to {new.down_mps:.1f} m/s down"
        setpoint.notes.append(Correction(new.down_mps, f"Altitude{word}Limit", note, names))
    return None


def _exceeds_limit(setpoint: _Setpoint, args: VelocityArgs, edge: float, *, above: bool) -> bool:
    leg = setpoint.sweep(args)
    return leg.upper_m > edge + ROUNDING_SLACK if above else leg.lower_m < edge - ROUNDING_SLACK


def _scaled_climb(setpoint: _Setpoint, edge: float, *, above: bool) -> VelocityArgs:
    """Return the largest fraction of the vertical part with which the drone stays within a limit, or zero."""
    args = setpoint.args
    best = replace(args, down_mps=0.0)
    low = 0.0
    high = 1.0
    for _ in range(_HALVINGS):
        share = (low + high) / 2
        scaled = replace(args, down_mps=args.down_mps * share)
        if _exceeds_limit(setpoint, scaled, edge, above=above):
            high = share
        else:
            low = share
            best = scaled
    return best


def _correct_to_fences(setpoint: _Setpoint) -> Verdict | None:
    breaches = _setpoint_breaches(setpoint, setpoint.args)
    if not breaches:
        return None
    args = setpoint.args
    requested = math.hypot(args.north_mps, args.east_mps, args.down_mps)
    if any(b.action != "adjust" for b in breaches) or requested < MIN_SCALED_MPS:
        return breach_verdict(breaches)
    best = None
    low = MIN_SCALED_MPS / requested
    high = 1.0
    for _ in range(_HALVINGS):
        share = (low + high) / 2
        scaled = _scaled(args, share)
        if _setpoint_breaches(setpoint, scaled):
            high = share
        else:
            low = share
            best = scaled
    if best is None:
        return breach_verdict(breaches)
    setpoint.args = best
    names = distinct(b.policy for b in breaches)
    setpoint.notes.append(Correction(low, "VelocityScaled", f"{breaches[0].reason}; scaled to {low:.0%}", names))
    return None


def _scaled(args: VelocityArgs, share: float) -> VelocityArgs:
    return replace(
        args, north_mps=args.north_mps * share, east_mps=args.east_mps * share, down_mps=args.down_mps * share
    )


def _setpoint_breaches(setpoint: _Setpoint, args: VelocityArgs) -> list[Breach]:
    now = setpoint.now
    return find_breaches(setpoint.sweep(args), now, setpoint.grant, _margin_m(now), _height_margin_m(now))


def _margin_m(now: Situation) -> float:
    """Return the margin that a velocity keeps from fences.

    A velocity starts at a position displaced by wind and leads to no fixed point, so the tracking error counts twice.
    """
    return now.margin_m + now.airframe.tracking_m


def _height_margin_m(now: Situation) -> float:
    """Return the vertical margin that a velocity keeps from floors and ceilings of zones. See `_margin_m`."""
    return now.height_margin_m + now.airframe.tracking_m
