"""The continuous check of a flying drone's present state, with a look ahead to where it can stop."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.api.policies import GeofenceAction
from fractus_core.policy.altitude import altitude_above_home_m, band_depth_m, band_may_overlap
from fractus_core.policy.compiled_grant import OPERATION_AREA, AirVolume, CompiledGrant, Inclusion, PolicyZone
from fractus_core.policy.decision_types import GotoArgs, SetSpeedArgs, Situation, Verdict
from fractus_core.policy.geofences import SEVERITY, TAKEOVERS, find_breaches, signed_depth_m
from fractus_core.policy.kinematics import (
    XY,
    is_moving,
    margin_m,
    pending_outcomes,
    reaction_s,
    stop_altitude_m,
    stop_point,
    vertical_leg,
)
from fractus_core.policy.limits import (
    Bound,
    altitude_bounds,
    deny_unknown_datum,
    is_achievable,
    speed_bounds,
    strictest_bound,
)

TRACKING_SHARE = 0.3
"""Share of the tracking margin of accepted legs that the monitor keeps as well."""

AIM_SHARE = 0.1
"""A drone flies to a target that it would miss by no more than this share of its distance: gusts turn its velocity."""

SINKING_MPS = 0.5
"""A drone that climbs no faster than this may go on while its altitude limits cannot be worked out; one that the system
flies, and that sinks faster, is on its way back under a limit."""

CLIMBING_MPS = 0.2
"""A drone that holds its height climbs no faster than this."""

DEEPER_M = 0.6
"""A drone on the wrong side of a fence is stopped again only when it moves this much further in."""


def monitor(
    now: Situation,
    grant: CompiledGrant,
    *,
    leaving: bool = False,
    changed: bool = False,
    bound_for: GotoArgs | None = None,
) -> Verdict | None:
    """What the system must do about a flying drone at this moment.

    Judged is the way from the present position to where the drone comes to rest if it is told to stop now, with the
    position error around it: a smaller margin than that of accepted legs, so that a leg flown as accepted never triggers it.

    Args:
        now: the state of the drone.
        grant: whose fences.
        leaving: whether the system flies the drone already, or the autopilot by itself, so that only what gets worse
            counts: where it is on the wrong side of a fence, or above a limit, the system's way leads back.
        changed: whether other fences may have been in force when the drone's way was judged. A drone that speeds up is
            faster before it hears of a stop, and whether there is room for that has not been judged: it is stopped in time;
            and so is a leg whose rest is not legal any more.
        bound_for: the leg under way, when it was accepted under this grant: the autopilot brakes for its end by itself,
            before it would hear of a stop.

    Returns:
        None when all is well; a takeover; a denial with `hover`, when the motion is to be stopped and the application
        keeps control; or a correction, with the arguments to carry out.
    """
    if not now.in_air:
        return None
    if not now.is_plausible and not math.isfinite(now.time_s):
        raise ValueError("the time is not a number")
    lat, lon = now.lat, now.lon
    if lat is None or lon is None or not now.is_plausible:
        return Verdict("takeover", None, "PositionUnknown", "the drone's position is unknown", (), "hover")
    start, margin = grant.frame.xy(lat, lon), now.position_error_m + TRACKING_SHARE * now.airframe.tracking_m
    surging = [(start, now), *pending_outcomes(now, start)] if changed else []
    # A drone that speeds up does so on a way that was judged with room for it, and brakes at its end in time.
    now = replace(now, forward_mps2=min(now.forward_mps2 or 0.0, 0.0))
    stop = stop_point(now, start)
    ahead = stop if bound_for is None else _arrival(now, start, stop, grant.frame.xy(bound_for.lat, bound_for.lon))
    level_m = _level_m(now, bound_for, grant)
    worst = _worst(_fences(now, grant, _look_ahead(now, start, ahead, margin, level_m), leaving=leaving))
    if worst is not None:
        return replace(worst, brake_first=worst.action == "takeover" and is_moving(now))
    for begin, then in surging:
        # Its way may end before the fence: it is stopped, and taken over only if it really goes too far.
        further = _look_ahead(then, begin, stop_point(then, begin), margin, _level_m(then, bound_for, grant))
        worst = _worst(_fences(then, grant, further, leaving=True))
        if worst is not None:
            return replace(worst, action="deny", takeover="hover")
    if changed and bound_for is not None:
        # A leg that is illegal by now is stopped at once: to stop it when it has to be takes a link at that moment.
        worst = _worst(_fences(now, grant, _rest_of_leg(now, grant, start, bound_for, margin), leaving=leaving))
        if worst is not None:
            return replace(worst, brake_first=worst.action == "takeover" and is_moving(now))
    rest_m = _told_m(now, level_m)
    # A climb of the autopilot's own was never judged and may end anywhere, so less than the whole slack is left to it.
    unasked = leaving and bound_for is None and now.down_mps < -CLIMBING_MPS
    found = _heights(now, grant, start, stop, rest_m, sinks_back=leaving, share=0.5 if unasked else 1.0)
    return found or _speeds(now, grant, start)


def _worst(found: list[tuple[int, Verdict]]) -> Verdict | None:
    """What takes most from the application; of equals what has the highest priority."""
    ranked = [
        (-SEVERITY[v.takeover] if v.action == "takeover" and v.takeover is not None else 0, -priority, i)
        for i, (priority, v) in enumerate(found)
    ]
    return found[min(ranked)[2]][1] if ranked else None


def _arrival(now: Situation, start: XY, stop: XY, target: XY) -> XY:
    """Where a drone comes to rest that flies to a target: there, while it can still brake for it as it was going to.

    Told to stop now it flies on for its reaction; that it brakes for the target it knows already. So no further than that,
    and as it strays from its leg, may the way to rest lead beyond the target.
    """
    (dx, dy), (tx, ty) = ((x - start[0], y - start[1]) for x, y in (stop, target))
    run = math.hypot(dx, dy)
    if run == 0.0:
        return stop
    along, aside = (dx * tx + dy * ty) / run, abs(dx * ty - dy * tx) / run
    late = math.hypot(now.north_mps, now.east_mps) * reaction_s(now, now.airframe.accel_mps2)
    strays = now.airframe.tracking_m
    aims = aside <= strays + AIM_SHARE * max(along, 0.0)
    arrives = aims and -strays <= along < run <= along + late + strays
    return target if arrives else stop


def _level_m(now: Situation, bound_for: GotoArgs | None, grant: CompiledGrant) -> float:
    """The altitude at which a drone comes to rest that climbs or sinks to that of its leg; see `_arrival`."""
    rest_m, climb = stop_altitude_m(now), -now.down_mps
    if bound_for is None or bound_for.alt is None or climb == 0.0:
        return rest_m
    target_m = altitude_above_home_m(bound_for.alt, bound_for.reference, now.home, grant.flat_terrain)
    if target_m is None:
        return rest_m
    up, strays = math.copysign(1.0, climb), now.airframe.tracking_m
    late = abs(climb) * reaction_s(now, now.airframe.climb_accel_mps2)
    ahead, beyond = (target_m - now.altitude_m) * up, (rest_m - target_m) * up
    return target_m if ahead >= -strays and 0.0 < beyond <= late + strays else rest_m


def _told_m(now: Situation, rest_m: float) -> float:
    """The altitude at which a drone comes to rest that was told already to climb or sink no further.

    It reacts to that from then on; a correction to a limit that it was permitted to come to rest at would come later still.
    Zones get no such allowance: they are judged by where it rests if it is told only now.
    """
    climb = -now.down_mps
    if not now.pending or -now.pending[-1][2] * climb > 0.0:
        return rest_m
    late_m = min(abs(climb) * now.latency_s, abs(rest_m - now.altitude_m))
    return rest_m - math.copysign(late_m, climb)


def must_stop_first(now: Situation, grant: CompiledGrant) -> bool:
    """Whether a moving drone must come to rest before it begins anything else, legal though that is.

    Its way to rest comes so near to a fence that the monitor may stop it on the new course, too: with the margin of legs,
    and without the braking that has begun already, which a new command may interrupt.
    """
    at = grant.locate(now)
    if at is None or not now.in_air or not is_moving(now):
        return False
    ways = [(at, replace(now, forward_mps2=0.0)), *pending_outcomes(now, at)]
    return any(
        _fences(
            then,
            grant,
            _look_ahead(then, begin, stop_point(then, begin), margin_m(then), stop_altitude_m(then)),
            leaving=True,
        )
        for begin, then in ways
    )


def _look_ahead(now: Situation, start: XY, stop: XY, margin: float, rest_m: float) -> _Ahead:
    way = shapely.points(start) if start == stop else shapely.linestrings((start, stop))
    lower = min(now.altitude_m, rest_m) - now.altitude_error_m
    upper = max(now.altitude_m, rest_m) + now.altitude_error_m
    # Who lands is not kept in the air by what is below.
    ends_m = max(rest_m, now.altitude_m) if now.vertical else rest_m
    return _Ahead(
        AirVolume(way, margin, lower, upper), shapely.points(start), shapely.points(stop), now.altitude_m, ends_m
    )


def _rest_of_leg(now: Situation, grant: CompiledGrant, start: XY, leg: GotoArgs, margin: float) -> _Ahead:
    level_m = None if leg.alt is None else altitude_above_home_m(leg.alt, leg.reference, now.home, grant.flat_terrain)
    end = grant.frame.xy(leg.lat, leg.lon)
    return _look_ahead(now, start, end, margin, now.altitude_m if level_m is None else level_m)


@dataclass(frozen=True, slots=True)
class _Ahead:
    """The way to where the drone can stop, with its ends, and their altitudes above home."""

    air: AirVolume
    here: BaseGeometry
    rest: BaseGeometry
    here_m: float
    rest_m: float


@dataclass(frozen=True, slots=True)
class _Fence:
    """What a fence is called, what its policy does, and how its breach is called once it is there and before."""

    policy: str
    action: GeofenceAction
    name: str
    broken: str
    ahead: str


@dataclass(frozen=True, slots=True)
class _Finding:
    """What a drone does to a fence: it is on the wrong side, or its motion makes things worse, or both."""

    fence: _Fence
    broken: bool
    worse: bool
    what: str


def _fences(now: Situation, grant: CompiledGrant, ahead: _Ahead, *, leaving: bool) -> list[tuple[int, Verdict]]:
    """What fences ask for, each with its policy's priority."""
    found: list[tuple[int, _Finding | None]] = [
        (zone.rule.spec.priority, _kept_out(zone, ahead, now, grant.flat_terrain))
        for zone in grant.exclusions.near(ahead.air, now, grant.flat_terrain)
    ]
    if grant.flight_area is not None and grant.flight_area_border is not None:
        area = _Fence(
            OPERATION_AREA, "ignore", "the operation area", "OutsideOperationArea", "OperationAreaBorderAhead"
        )
        found.append((0, _kept_in(grant.flight_area, grant.flight_area_border, ahead, area, leaves=False)))
    for inclusion in grant.inclusions:
        if inclusion.rule.in_force(now.time_s):
            shape, border = inclusion.at(ahead.air.lower_m, ahead.air.upper_m, now, grant.flat_terrain)
            zones = ", ".join(dict.fromkeys(p.name for p in inclusion.zones)) or "its zones"
            rule = inclusion.rule
            name = f"{zones} of policy {rule.name}"
            fence = _Fence(rule.name, rule.spec.geofence_action, name, "OutsideInclusionZone", "InclusionBorderAhead")
            leaves = inclusion.banded and _leaves_by_height(inclusion, ahead, now, grant.flat_terrain)
            found.append((rule.spec.priority, _kept_in(shape, border, ahead, fence, leaves=leaves)))
    reactions = [(priority, _reaction(f, leaving=leaving)) for priority, f in found if f is not None]
    return [(priority, verdict) for priority, verdict in reactions if verdict is not None]


def _kept_out(zone: PolicyZone, ahead: _Ahead, now: Situation, flat: bool) -> _Finding:
    shape, border = zone.shape, zone.shape.boundary
    around, crosses = bool(shape.intersects(ahead.here)), bool(shape.intersects(ahead.air.ground))
    error_m = now.altitude_error_m
    inside = around and band_may_overlap(zone.band, ahead.here_m - error_m, ahead.here_m + error_m, now.home, flat)
    rest_m, here_m = (signed_depth_m(shape, border, point) for point in (ahead.rest, ahead.here))
    worse = rest_m > here_m + DEEPER_M or (crosses and not around)
    if crosses and zone.band is not None:
        # From above or from below; where it is in the zone as seen from above, the lesser depth counts.
        rest_m, here_m = (
            min(depth_m, band_depth_m(zone.band, altitude_m, now.home, flat))
            for depth_m, altitude_m in ((rest_m, ahead.rest_m), (here_m, ahead.here_m))
        )
        worse = worse or here_m < 0.0 <= rest_m or (rest_m > here_m + DEEPER_M and rest_m > -error_m)
    name = f"zone {zone.name} of policy {zone.rule.name}"
    fence = _Fence(zone.rule.name, zone.rule.spec.geofence_action, name, "InsideExclusionZone", "ExclusionZoneAhead")
    return _Finding(fence, inside, worse, "is inside" if inside else "is about to enter")


def _leaves_by_height(fence: Inclusion, ahead: _Ahead, now: Situation, flat: bool) -> bool:
    """Whether a drone above or below the zones to stay in, or about to be, gets further from all of them by its height."""
    around = [zone.band for zone in fence.zones if zone.shape.intersects(ahead.here)]
    rest_m, here_m = (
        max((band_depth_m(band, m, now.home, flat) for band in around), default=math.inf)
        for m in (ahead.rest_m, ahead.here_m)
    )
    return rest_m < 0.0 <= here_m or (rest_m < here_m - DEEPER_M and rest_m < now.altitude_error_m)


def _kept_in(
    shape: BaseGeometry, border: BaseGeometry, ahead: _Ahead, fence: _Fence, *, leaves: bool
) -> _Finding | None:
    way = ahead.air.ground
    if shape.covers(way) and not border.dwithin(way, ahead.air.margin_m):
        return None
    outside = not shape.covers(ahead.here)
    worse = leaves
    if not shape.is_empty:
        deep_m = signed_depth_m(shape, border, ahead.here)
        worse = worse or signed_depth_m(shape, border, ahead.rest) < deep_m - DEEPER_M
    worse = worse or (not outside and not shape.covers(way))
    return _Finding(fence, outside, worse, "is outside" if outside else "is about to leave")


def _reaction(found: _Finding, *, leaving: bool) -> Verdict | None:
    """What follows from a fence that is broken or about to be.

    A policy that takes the drone over does so for both; one that ignores requests only stops the motion that makes
    things worse.
    """
    fence = found.fence
    takeover = TAKEOVERS[fence.action]
    code = fence.broken if found.broken else fence.ahead
    reason = f"the drone {found.what} {fence.name}"
    if takeover is not None and (found.worse or (found.broken and not leaving)):
        return Verdict("takeover", None, code, reason, (fence.policy,), takeover)
    if found.worse:
        return Verdict("deny", None, code, f"{reason}; the motion is stopped", (fence.policy,), "hover")
    return None


def _heights(
    now: Situation, grant: CompiledGrant, start: XY, stop: XY, rest_m: float, *, sinks_back: bool, share: float
) -> Verdict | None:
    """The correction of an altitude that breaks limits, when the drone has come to rest at `stop` and `rest_m`.

    Lower limits do not hold for a drone that takes off or lands; `sinks_back`: nor upper ones for one that sinks. `share`: how
    much of its slack a drone may come to rest above an upper limit by.
    """
    if grant.max_altitude_m is None and not grant.altitude_limits:
        return None
    bounds, unknown = altitude_bounds(grant, now, AirVolume(shapely.points(start), 0.0, now.altitude_m, now.altitude_m))
    slack = now.altitude_error_m + now.airframe.tracking_m
    sinks_back = sinks_back and now.down_mps > SINKING_MPS
    over, under = strictest_bound(bounds, above=True), strictest_bound(bounds, above=False)
    high, low = max(now.altitude_m, rest_m), min(now.altitude_m, rest_m)
    if over is not None and over.upper is not None and high > over.upper + share * slack and not sinks_back:
        reason = f"the drone climbs to {high:.1f} m, above the limit of {over.upper:.1f} m"
        return _changed_height(_Trespass(over, over.upper, "AltitudeAboveLimit", reason), now, grant, stop)
    if unknown:
        sinking = now.down_mps > -SINKING_MPS
        return None if sinking else replace(deny_unknown_datum(unknown[0]), takeover="hover")
    if under is not None and under.lower is not None and low < under.lower - slack and not now.vertical:
        if over is not None and over.upper is not None and over.upper < under.lower:
            return None
        reason = f"the drone sinks to {low:.1f} m, below the limit of {under.lower:.1f} m"
        return _changed_height(_Trespass(under, under.lower, "AltitudeBelowLimit", reason), now, grant, stop)
    return None


@dataclass(frozen=True, slots=True)
class _Trespass:
    """A limit of altitude that is broken, and the height that keeps it."""

    bound: Bound
    height_m: float
    code: str
    reason: str


def _changed_height(found: _Trespass, now: Situation, grant: CompiledGrant, stop: XY) -> Verdict:
    """The correction to a height, or a stop where zones leave no way to it."""
    names = (found.bound.name,) if found.bound.name else ()
    column = vertical_leg(stop, min(now.altitude_m, found.height_m), max(now.altitude_m, found.height_m))
    if find_breaches(column, now, grant, 0.0, 0.0):
        reason = f"{found.reason}; zones leave no way back, so it stays"
        return Verdict("deny", None, found.code, reason, names, "hover")
    lat, lon = grant.frame.latlon(*stop)
    return Verdict("correct", GotoArgs(lat, lon, found.height_m), found.code, found.reason, names)


def _speeds(now: Situation, grant: CompiledGrant, start: XY) -> Verdict | None:
    """The correction of a speed that breaks limits."""
    if grant.max_speed_mps is None and not grant.speed_limits:
        return None
    speed = math.hypot(now.north_mps, now.east_mps)
    bounds = speed_bounds(grant, now, AirVolume(shapely.points(start), 0.0, now.altitude_m, now.altitude_m))
    over = strictest_bound(bounds, above=True)
    # Gusts push a drone that keeps its setpoint beyond it for a moment: a tenth and 1 m/s are not its doing.
    if over is None or over.upper is None or speed <= over.upper * 1.1 + 1.0:
        return None
    reason = f"the drone flies at {speed:.1f} m/s, above the limit of {over.upper:.1f} m/s"
    names = (over.name,) if over.name else ()
    if not is_achievable("Speed", over.upper):
        return Verdict("deny", None, "SpeedAboveLimit", f"{reason}; the motion is stopped", names, "hover")
    return Verdict("correct", SetSpeedArgs(over.upper), "SpeedAboveLimit", reason, names)
