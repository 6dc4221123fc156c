"""The policy engine: a call in a situation under a grant becomes a verdict that explains itself (thesis 8.7).

Deny by default; the most restrictive policy wins, and among equals the one of higher priority.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import shapely

from fractus_core.policy.access import judge_access, judge_privacy
from fractus_core.policy.compiled import Air, CompiledGrant, height_m
from fractus_core.policy.fences import Breach, breaches, last_legal
from fractus_core.policy.limits import SLACK, Bound, Clamped, altitude_bounds, clamp, speed_bounds
from fractus_core.policy.motion import (
    XY,
    Leg,
    height_margin_m,
    margin_m,
    standing,
    stop_altitude_m,
    stop_point,
    turn_point,
)
from fractus_core.policy.returning import straight_home_blocked
from fractus_core.policy.routes import route
from fractus_core.policy.values import (
    Call,
    CaptureArgs,
    GotoArgs,
    SetSpeedArgs,
    Situation,
    TakeoffArgs,
    Takeover,
    Verdict,
    deny,
)

MAX_RANGE_M = 100_000.0
MAX_ALTITUDE_M = 20_000.0
MAX_SPEED_MPS = 100.0
MAX_PIXELS = 20_000
LEAST_ALTITUDE_M = 0.5
"""A takeoff goes at least this high."""
LEAST_LEG_M = 2.0
"""A goto ends at least this high above home, where no altitude limit says that lower is fine."""


def judge(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Decide on a call.

    Args:
        call: method and arguments as the component gave them.
        now: state of drone and node.
        grant: what the component may do.

    Returns:
        The verdict; an internal error is the caller's to turn into refusal and hover.
    """
    if not now.sound:
        now = _unsound(now)
    problem = _check_arguments(call) or judge_access(call, now, grant)
    if problem is not None:
        return problem
    rule = _RULES.get(call.method)
    if rule is not None:
        return rule(call, now, grant)
    if call.method in _ACCESS_ONLY:
        return Verdict("allow", call.args)
    return deny("MethodUnknown", f"the policy engine has no rule for {call.method}")


def _unsound(now: Situation) -> Situation:
    """A state with a figure that is no number: nothing is known of where the drone is and how it moves.

    Raises:
        ValueError: not even the time is known.
    """
    if not math.isfinite(now.time_s):
        raise ValueError("the time is not a number")
    return Situation(time_s=now.time_s, armed=now.armed, in_air=now.in_air, vertical=now.vertical)


# Arguments


def _check_arguments(call: Call) -> Verdict | None:
    args = call.args
    expected = _ARGS.get(call.method)
    if expected is not None and not isinstance(args, expected):
        return deny("InvalidArgument", f"{call.method} needs its arguments")
    if isinstance(args, TakeoffArgs):
        return _within("altitude", args.altitude_m, LEAST_ALTITUDE_M, MAX_ALTITUDE_M, "m above home")
    if isinstance(args, SetSpeedArgs):
        return _within("speed", args.speed_mps, 0.1, MAX_SPEED_MPS, "m/s")
    if isinstance(args, GotoArgs):
        return (
            _within("latitude", args.lat, -90, 90, "degrees")
            or _within("longitude", args.lon, -180, 180, "degrees")
            or (None if args.alt is None else _within("altitude", args.alt, -1000, MAX_ALTITUDE_M, "m"))
            or (None if args.yaw_deg is None else _within("yaw", args.yaw_deg, -360, 360, "degrees"))
            or (None if args.speed_mps is None else _within("speed", args.speed_mps, 0.1, MAX_SPEED_MPS, "m/s"))
        )
    if isinstance(args, CaptureArgs):
        return _within("width", args.width, 0, MAX_PIXELS, "pixels") or _within(
            "height", args.height, 0, MAX_PIXELS, "pixels"
        )
    return None


_ARGS: dict[str, type] = {"Takeoff": TakeoffArgs, "Goto": GotoArgs, "SetSpeed": SetSpeedArgs}


def _within(what: str, value: float, lower: float, upper: float, unit: str) -> Verdict | None:
    if math.isfinite(value) and lower <= value <= upper:
        return None
    return deny("InvalidArgument", f"{what} must be {lower:g} to {upper:g} {unit}, not {value:g}")


# Motion


def _judge_goto(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    args = call.args
    if not isinstance(args, GotoArgs):
        return deny("InvalidArgument", "Goto needs its arguments")
    where = _located(now, grant)
    if isinstance(where, Verdict):
        return where
    target = grant.frame.xy(args.lat, args.lon)
    if not math.hypot(target[0] - where[0], target[1] - where[1]) <= MAX_RANGE_M or _beyond(args, grant):
        return deny("InvalidArgument", f"the target is more than {MAX_RANGE_M / 1000:.0f} km away")
    altitude = now.altitude_m if args.alt is None else height_m(args.alt, args.reference, now.home, grant.flat_terrain)
    if altitude is None:
        return deny(
            "TerrainUnknown", "the target is given above terrain, and no terrain model is loaded; use home or amsl"
        )
    notes: list[Clamped] = []
    if args.alt is not None and args.reference == "terrain":
        reason = "no terrain model is loaded; the ground is taken as level with home"
        notes.append(Clamped(altitude, "TerrainAssumedFlat", reason))
    request = _Request(args, now, grant, where)
    flown = _fly_leg(request, _Aim(target, altitude), notes, adjusting=True)
    return flown if isinstance(flown, Verdict) else _outcome(args, flown, notes, grant)


@dataclass(frozen=True, slots=True)
class _Request:
    """A goto, by whom and from where."""

    args: GotoArgs
    now: Situation
    grant: CompiledGrant
    at: XY


@dataclass(frozen=True, slots=True)
class _Aim:
    """Where a leg goes; speed None keeps the one in force."""

    target: XY
    altitude_m: float
    speed_mps: float | None = None


def _beyond(args: GotoArgs, grant: CompiledGrant) -> bool:
    """Whether the target lies on the far side of the globe, where the frame folds over."""
    x, y = grant.frame.xy(args.lat, args.lon)
    lat, lon = grant.frame.latlon(x, y)
    return abs(lat - args.lat) > 1e-6 or abs((lon - args.lon + 180.0) % 360.0 - 180.0) > 1e-5


def _fly_leg(request: _Request, aim: _Aim, notes: list[Clamped], adjusting: bool) -> _Aim | Verdict:
    """What may be flown of a leg, or the verdict that forbids it."""
    now, grant = request.now, request.grant
    leg = _leg(request.at, aim.target, now, aim.altitude_m)
    within = _within_limits(request, leg, aim, notes)
    if isinstance(within, Verdict):
        return within
    leg = _leg(request.at, aim.target, now, within.altitude_m)
    found = breaches(leg, now, grant, margin_m(now), height_margin_m(now))
    if not found:
        return _way_home_blocked(aim.target, within.altitude_m, now, grant) or within
    shorter = last_legal(leg, found) if adjusting and all(b.action == "adjust" for b in found) else None
    if shorter is None:
        return _broken(found)
    names = tuple(dict.fromkeys(b.policy for b in found))
    notes.append(Clamped(0.0, "LegShortened", f"{found[0].reason}; the leg ends at the last legal point", names))
    return _fly_leg(request, replace(within, target=shorter), notes, adjusting=False)


def _within_limits(request: _Request, leg: Leg, aim: _Aim, notes: list[Clamped]) -> _Aim | Verdict:
    """The aim inside the limits of altitude and speed, or the verdict that forbids it."""
    now, grant = request.now, request.grant
    air = Air(leg.ground, margin_m(now), leg.lower_m, leg.upper_m)
    bounds = altitude_bounds(grant, now, air)
    if isinstance(bounds, Verdict):
        return bounds
    height = clamp("Altitude", "m above home", aim.altitude_m, bounds)
    if isinstance(height, Verdict):
        return height
    if height.value < LEAST_LEG_M - SLACK and not _lower_is_fine(bounds):
        return deny(
            "AltitudeTooLow",
            f"a leg ends at least {LEAST_LEG_M:.0f} m above home, not at {height.value:.1f} m; use land to come down",
        )
    asked = request.args.speed_mps if aim.speed_mps is None else aim.speed_mps
    speed = clamp("Speed", "m/s", now.speed_setpoint_mps if asked is None else asked, speed_bounds(grant, now, air))
    problem = _altitude_on_entry(request.at, now, bounds, height_margin_m(now))
    if problem is not None:
        return problem
    if isinstance(speed, Verdict):
        return speed
    notes.extend(note for note in (height, speed) if note.code)
    return _Aim(aim.target, height.value, speed.value if speed.code or asked is not None else None)


def _lower_is_fine(bounds: list[Bound]) -> bool:
    """Whether an altitude limit in force speaks of heights below the least that a leg has otherwise."""
    return any(edge is not None and edge < LEAST_LEG_M for bound in bounds for edge in (bound.lower, bound.upper))


def _leg(at: XY, target: XY, now: Situation, altitude_m: float) -> Leg:
    heights = (now.altitude_m, stop_altitude_m(now), altitude_m)
    return Leg(at, stop_point(now, at), turn_point(now, at, target), target, min(heights), max(heights))


def _broken(found: list[Breach]) -> Verdict:
    worst = found[0]
    names = tuple(dict.fromkeys(b.policy for b in found))
    takeover = _TAKEOVERS.get(worst.action) if worst.enters else None
    if takeover is None:
        return deny(worst.code, worst.reason, names)
    return Verdict("takeover", None, worst.code, f"{worst.reason}; {_DOES[takeover]}", names, takeover)


_TAKEOVERS: dict[str, Takeover] = {
    "hover": "hover",
    "land": "land",
    "returnToLaunch": "returnToLaunch",
    "revoke": "revoke",
}
_DOES: dict[Takeover, str] = {
    "hover": "the system takes the drone and hovers",
    "land": "the system takes the drone and lands it",
    "returnToLaunch": "the system takes the drone and flies it home",
    "revoke": "access is revoked and the system flies the drone home",
}


def _altitude_on_entry(at: XY, now: Situation, bounds: list[Bound], slack_m: float) -> Verdict | None:
    """The denial of a leg that would carry the present altitude into a zone where it is not allowed."""
    here = shapely.Point(at)
    for bound in bounds:
        if bound.shape is None or bound.shape.intersects(here):
            continue
        if bound.upper is not None and now.altitude_m > bound.upper + slack_m:
            return deny(
                "AltitudeAboveLimit",
                f"the leg enters the zone of policy {bound.name} at {now.altitude_m:.1f} m, above its limit of"
                f" {bound.upper:.1f} m; descend first",
                (bound.name,),
            )
        if bound.lower is not None and now.altitude_m < bound.lower - slack_m:
            return deny(
                "AltitudeBelowLimit",
                f"the leg enters the zone of policy {bound.name} at {now.altitude_m:.1f} m, below its limit of"
                f" {bound.lower:.1f} m; climb first",
                (bound.name,),
            )
    return None


def _way_home_blocked(target: XY, altitude_m: float, now: Situation, grant: CompiledGrant) -> Verdict | None:
    """The denial of a target from which the autopilot's way home is not legal."""
    problem = straight_home_blocked(target, altitude_m, now, grant, margin=margin_m(now), slack=height_margin_m(now))
    if problem is None or now.home is None or not now.airframe.retraces:
        return problem
    home = grant.frame.xy(now.home.lat, now.home.lon)
    if route(target, home, now, grant, altitude_m) is not None:
        return None
    return replace(problem, reason=f"{problem.reason}, and no legal way leads around it")


def _outcome(args: GotoArgs, flown: _Aim, notes: list[Clamped], grant: CompiledGrant) -> Verdict:
    moved = any(note.code == "LegShortened" for note in notes)
    lat, lon = grant.frame.latlon(*flown.target) if moved else (args.lat, args.lon)
    new = replace(args, lat=lat, lon=lon, alt=flown.altitude_m, reference="home", speed_mps=flown.speed_mps)
    if not notes:
        return Verdict("allow", new)
    ordered = sorted(notes, key=lambda n: n.code == "TerrainAssumedFlat")
    names = tuple(dict.fromkeys(name for note in ordered for name in note.policies))
    action: str = "allow" if all(n.code == "TerrainAssumedFlat" for n in notes) else "correct"
    reason = "; ".join(note.reason for note in ordered)
    if action == "allow":
        return Verdict("allow", new, ordered[0].code, reason, names)
    return Verdict("correct", new, ordered[0].code, reason, names)


def _located(now: Situation, grant: CompiledGrant) -> XY | Verdict:
    if now.lat is None or now.lon is None:
        return deny("PositionUnknown", "the drone's position is unknown; wait for a fix")
    return grant.frame.xy(now.lat, now.lon)


def _judge_takeoff(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    args, at = call.args, _located(now, grant)
    if isinstance(at, Verdict) or not isinstance(args, TakeoffArgs):
        return at if isinstance(at, Verdict) else deny("InvalidArgument", "Takeoff needs its arguments")
    lower, upper = sorted((now.altitude_m, args.altitude_m))
    bounds = altitude_bounds(grant, now, Air(shapely.Point(at), margin_m(now), lower, upper))
    clamped = bounds if isinstance(bounds, Verdict) else clamp("Altitude", "m above home", args.altitude_m, bounds)
    if isinstance(clamped, Verdict):
        return clamped
    problem = _column(at, now, grant, now.altitude_m, clamped.value) or _way_home_blocked(at, clamped.value, now, grant)
    if problem is not None:
        return problem
    if not clamped.code:
        return Verdict("allow", args)
    return Verdict("correct", TakeoffArgs(clamped.value), clamped.code, clamped.reason, clamped.policies)


def _judge_arm(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    at = _located(now, grant)
    if isinstance(at, Verdict):
        return at
    return _column(at, now, grant, now.altitude_m, now.altitude_m) or Verdict("allow", call.args)


def _judge_land(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    at = _located(now, grant)
    if isinstance(at, Verdict):
        return at
    ground = stop_point(now, at)
    return _column(ground, now, grant, 0.0, now.altitude_m) or Verdict("allow", call.args)


def _column(at: XY, now: Situation, grant: CompiledGrant, lower_m: float, upper_m: float) -> Verdict | None:
    """The denial of a vertical motion, or of standing, where fences forbid it; no such request is a takeover."""
    leg = standing(at, min(lower_m, upper_m), max(lower_m, upper_m))
    found = breaches(leg, now, grant, margin_m(now), height_margin_m(now))
    if not found:
        return None
    return deny(found[0].code, found[0].reason, tuple(dict.fromkeys(b.policy for b in found)))


def _judge_disarm(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    if now.in_air:
        return deny("InAir", f"the drone is in the air at {now.altitude_m:.1f} m; land before disarming")
    return Verdict("allow", call.args)


def _judge_speed(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    args = call.args
    if not isinstance(args, SetSpeedArgs):
        return deny("InvalidArgument", "SetSpeed needs its arguments")
    at = _located(now, grant)
    if isinstance(at, Verdict):
        return at
    bounds = speed_bounds(grant, now, Air(shapely.Point(at), margin_m(now), now.altitude_m, now.altitude_m))
    clamped = clamp("Speed", "m/s", args.speed_mps, bounds)
    if isinstance(clamped, Verdict):
        return clamped
    if not clamped.code:
        return Verdict("allow", args)
    return Verdict("correct", SetSpeedArgs(clamped.value), clamped.code, clamped.reason, clamped.policies)


def _judge_picture(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    if call.method == "CaptureImage" and (now.lat is None or now.lon is None):
        return deny(
            "PositionUnknown", "nobody knows what the camera sees while its position is unknown; wait for a fix"
        )
    verdict = judge_privacy(now, grant)
    return verdict if verdict.action == "deny" else replace(verdict, args=call.args)


_ACCESS_ONLY = frozenset(
    {"Hover", "GetSpeed", "GetPosition", "ReturnToLaunch", "ListImages", "DeleteImage", "GetControl", "ReturnControl"}
)
"""Methods that may be used by who has access: they stop the drone, bring it home, or move nothing."""

_RULES: dict[str, Callable[[Call, Situation, CompiledGrant], Verdict]] = {
    "Arm": _judge_arm,
    "Disarm": _judge_disarm,
    "Takeoff": _judge_takeoff,
    "Land": _judge_land,
    "Goto": _judge_goto,
    "SetSpeed": _judge_speed,
    "CaptureImage": _judge_picture,
    "RetrieveImage": _judge_picture,
}
