"""Rules for Goto: the leg to the target against limits, fences and the return route."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import shapely

from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant, altitude_above_home_m
from fractus_core.policy.decision_types import (
    DENY_NO_ARGUMENTS,
    DENY_POSITION_UNKNOWN,
    Call,
    GotoArgs,
    Situation,
    Verdict,
    deny,
    distinct,
)
from fractus_core.policy.geofences import BISECTION_STEPS, Breach, breach_verdict, check_straight_return, find_breaches
from fractus_core.policy.kinematics import (
    XY,
    Leg,
    goto_leg,
    pending_outcomes,
    situation_at_rest,
    stop_altitude_m,
    stop_point,
    vertical_leg,
)
from fractus_core.policy.limits import (
    MIN_LEG_ALTITUDE_M,
    ROUNDING_SLACK,
    Correction,
    allows_low_altitude,
    altitude_bounds,
    check_altitude_on_entry,
    choose_objection,
    clamp,
    correction_verdict,
    deny_unknown_datum,
    speed_bounds,
)
from fractus_core.policy.route_search import route_exists

MAX_RANGE_M = 100_000.0
"""Largest distance of a target. No drone flies farther, and the grant's frame is accurate up to this distance."""
MIN_LEG_M = 0.5
"""Shortest leg to which a longer leg is shortened."""
NEAR_DEG = 30.0
"""A target within this difference of latitude and longitude certainly lies on the frame's side of the globe."""


def judge_goto(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge a Goto.

    A moving drone may be unable to begin a leg because its turn is too wide. The leg is then permitted after a stop if
    the stop is legal, and the leg from the point where the drone comes to rest is legal: see `Verdict.brake_first`.
    """
    args = call.args
    position = grant.locate(now)
    if not isinstance(args, GotoArgs):
        return DENY_NO_ARGUMENTS
    if position is None:
        return DENY_POSITION_UNKNOWN
    target = grant.frame.xy(args.lat, args.lon)
    if not math.dist(target, position) <= MAX_RANGE_M or _is_beyond_frame(args, grant):
        return deny("InvalidArgument", f"the target is more than {MAX_RANGE_M / 1000:.0f} km away")
    if args.speed_mps is not None and args.speed_mps > now.speed_setpoint_mps:
        now = replace(now, speed_setpoint_mps=args.speed_mps)
    verdict = _judge_from(_Request(args, now, grant, position), target)
    if verdict.action == "allow" or not now.is_moving or not _turns_too_wide(verdict, args):
        return verdict
    stopped = _judge_after_stop(_Request(args, now, grant, position), target)
    return stopped if stopped is not None and stopped.permits and not _shortened(stopped, args) else verdict


def _turns_too_wide(verdict: Verdict, args: GotoArgs) -> bool:
    """Return True if a stop before the leg may lead to a better verdict."""
    return not verdict.permits or _shortened(verdict, args)


def _shortened(verdict: Verdict, args: GotoArgs) -> bool:
    result = verdict.args
    return isinstance(result, GotoArgs) and (result.lat, result.lon) != (args.lat, args.lon)


def _judge_after_stop(request: _Request, target: XY) -> Verdict | None:
    """Judge a leg that begins with a stop. Return None if the stop itself breaks a fence or an altitude limit."""
    now = request.now
    grant = request.grant
    position = request.position
    stop = stop_point(now, position)
    altitudes = [now.altitude_m, stop_altitude_m(now)]
    corners = list[XY]()
    for outcome_position, outcome in pending_outcomes(now, position):
        corners += (outcome_position, stop_point(outcome, outcome_position))
        altitudes += (outcome.altitude_m, stop_altitude_m(outcome))
    braking = Leg(position, stop, stop, stop, min(altitudes), max(altitudes), tuple(corners))
    transit_grant = replace(grant, operation_area=grant.flight_area, operation_area_border=grant.flight_area_border)
    if find_breaches(braking, now, transit_grant, now.margin_m, now.height_margin_m):
        return None
    # The leg begins where the drone comes to rest, so a zone entered while braking would count as already entered.
    air = AirVolume(braking.ground, now.margin_m, braking.lower_m, braking.upper_m)
    bounds, unknown = altitude_bounds(grant, now, air, now.height_margin_m)
    reach = braking.lower_m, braking.upper_m
    if unknown or check_altitude_on_entry(shapely.points(position), reach, bounds, now.height_margin_m) is not None:
        return None
    verdict = _judge_from(replace(request, now=situation_at_rest(now, grant.frame, position), position=stop), target)
    return replace(verdict, brake_first=True)


def _judge_from(request: _Request, target: XY) -> Verdict:
    """Judge the leg from the drone's position in a request to a target."""
    args = request.args
    now = request.now
    grant = request.grant
    altitude = (
        now.altitude_m
        if args.alt is None
        else altitude_above_home_m(args.alt, args.reference, now.home, grant.flat_terrain)
    )
    if altitude is None:
        return deny(
            "TerrainUnknown", "the target is given above terrain, and no terrain model is loaded; use home or amsl"
        )
    notes: list[Correction] = []
    if args.alt is not None and args.reference == "terrain":
        reason = "no terrain model is loaded; the ground is assumed to be level with home"
        notes.append(Correction(altitude, "TerrainAssumedFlat", reason))
    permitted = _permitted_leg(request, _Aim(target, altitude), notes, adjusting=True)
    if isinstance(permitted, Verdict):
        return permitted
    corrected = replace(args, alt=permitted.altitude_m, reference="home", speed_mps=permitted.speed_mps)
    if any(note.code == "LegShortened" for note in notes):
        lat, lon = grant.frame.latlon(*permitted.target)
        corrected = replace(corrected, lat=lat, lon=lon)
    verdict = correction_verdict(corrected, sorted(notes, key=lambda note: note.code == "TerrainAssumedFlat"))
    # Flat terrain is mentioned in the reason, but it changes none of the requested arguments.
    return replace(verdict, action="allow") if verdict.code == "TerrainAssumedFlat" else verdict


@dataclass(frozen=True, slots=True)
class _Request:
    """A Goto with the situation, the grant and the start of its leg."""

    args: GotoArgs
    now: Situation
    grant: CompiledGrant
    position: XY


@dataclass(frozen=True, slots=True)
class _Aim:
    """End of a leg. Speed None keeps the current speed setpoint."""

    target: XY
    altitude_m: float
    speed_mps: float | None = None


def _is_beyond_frame(args: GotoArgs, grant: CompiledGrant) -> bool:
    """Return True if the target lies on the far side of the globe, which the frame cannot represent."""
    frame = grant.frame
    if abs(args.lat - frame.lat) < NEAR_DEG and abs(args.lon - frame.lon) < NEAR_DEG:
        return False
    x, y = frame.xy(args.lat, args.lon)
    lat, lon = grant.frame.latlon(x, y)
    return abs(lat - args.lat) > 1e-6 or abs((lon - args.lon + 180.0) % 360.0 - 180.0) > 1e-5


def _permitted_leg(request: _Request, aim: _Aim, notes: list[Correction], adjusting: bool) -> _Aim | Verdict:
    """Return the permitted part of a leg, or the verdict that forbids the leg."""
    now = request.now
    grant = request.grant
    leg = goto_leg(now, request.position, aim.target, aim.altitude_m)
    limited = _within_limits(request, leg, aim, notes)
    if isinstance(limited, Verdict):
        return limited
    leg = goto_leg(now, request.position, aim.target, limited.altitude_m)
    breaches = find_breaches(leg, now, grant, now.margin_m, now.height_margin_m)
    adjustable = adjusting and bool(breaches) and all(b.action == "adjust" for b in breaches)
    shorter = _last_legal_point(leg, breaches) if adjustable else None
    if shorter is None:
        problem = breach_verdict(breaches) if breaches else check_return(aim.target, limited.altitude_m, now, grant)
        if problem is None or limited.altitude_m == aim.altitude_m:
            return problem or limited
        return choose_objection(problem, _objection(request, aim), correction_verdict(None, notes))
    names = distinct(b.policy for b in breaches)
    notes.append(Correction(0.0, "LegShortened", f"{breaches[0].reason}; the leg ends at the last legal point", names))
    return _permitted_leg(request, replace(limited, target=shorter), notes, adjusting=False)


def _objection(request: _Request, aim: _Aim) -> Verdict | None:
    """Return the objection to a leg because of fences or the return route.

    Altitude and speed limits are not checked.
    """
    now = request.now
    grant = request.grant
    leg = goto_leg(now, request.position, aim.target, aim.altitude_m)
    breaches = find_breaches(leg, now, grant, now.margin_m, now.height_margin_m)
    return breach_verdict(breaches) if breaches else check_return(aim.target, aim.altitude_m, now, grant)


def _within_limits(request: _Request, leg: Leg, aim: _Aim, notes: list[Correction]) -> _Aim | Verdict:
    """Return the end of a leg corrected to the limits of altitude and speed, or the verdict that forbids the leg."""
    now = request.now
    grant = request.grant
    air = AirVolume(leg.ground, now.margin_m, leg.lower_m, leg.upper_m)
    bounds, unknown = altitude_bounds(grant, now, air, now.height_margin_m)
    if unknown:
        return deny_unknown_datum(unknown[0])
    height = clamp("Altitude", "m above home", aim.altitude_m, bounds)
    if isinstance(height, Verdict):
        return height
    if height.value < MIN_LEG_ALTITUDE_M - ROUNDING_SLACK and not allows_low_altitude(bounds):
        return deny(
            "AltitudeTooLow",
            f"a leg ends at least {MIN_LEG_ALTITUDE_M:.0f} m above home, not at {height.value:.1f} m; use Land to descend",
        )
    requested_mps = request.args.speed_mps if aim.speed_mps is None else aim.speed_mps
    unchanged_mps = now.speed_setpoint_mps if requested_mps is None else requested_mps
    speed = clamp("Speed", "m/s", unchanged_mps, speed_bounds(grant, now, air, now.height_margin_m))
    altitudes = (now.altitude_m, stop_altitude_m(now))
    problem = check_altitude_on_entry(shapely.points(request.position), altitudes, bounds, now.height_margin_m)
    if problem is not None:
        return problem
    if isinstance(speed, Verdict):
        return speed
    notes.extend(note for note in (height, speed) if note.code)
    keeps_speed = requested_mps is None and speed.value == unchanged_mps
    return _Aim(aim.target, height.value, None if keeps_speed else speed.value)


def check_return(target: XY, altitude_m: float, now: Situation, grant: CompiledGrant) -> Verdict | None:
    """Return the denial of a target from which the return is not legal, or None.

    A drone on the wrong side of a fence may leave it regardless of the position of its home.
    """
    problem = check_straight_return(target, altitude_m, now, grant, margin=now.margin_m, slack=now.height_margin_m)
    position = grant.locate(now)
    if problem is None or now.home is None or position is None:
        return problem
    stationary_leg = vertical_leg(position, now.altitude_m, now.altitude_m)
    if find_breaches(stationary_leg, now, grant, now.margin_m, now.height_margin_m):
        return None
    if not now.airframe.retraces:
        return problem
    home = grant.frame.xy(now.home.lat, now.home.lon)
    system = replace(grant, flight_area=grant.return_area, flight_area_border=grant.return_area_border)
    if route_exists(target, home, now, system, altitude_m):
        return None
    return replace(problem, reason=f"{problem.reason}, and no legal route around it was found")


def _last_legal_point(leg: Leg, breaches: list[Breach]) -> XY | None:
    """Return the farthest point of a leg that no breached fence forbids, or None if that leg is too short."""
    length_m = math.dist(leg.stop, leg.target)
    x, y = leg.stop
    tx, ty = leg.target

    def along(share: float) -> XY:
        return x + (tx - x) * share, y + (ty - y) * share

    low = 0.0
    high = 1.0
    for _ in range(BISECTION_STEPS):
        share = (low + high) / 2
        part = shapely.linestrings((leg.stop, along(share)))
        low, high = (share, high) if all(breach.permits(part) for breach in breaches) else (low, share)
    return along(low - 0.01 / length_m) if low * length_m >= MIN_LEG_M else None
