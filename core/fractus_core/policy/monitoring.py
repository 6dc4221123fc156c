"""Continuous check of a flying drone: its state, and the path on which the drone comes to rest after a stop."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.api.policies import GeofenceAction
from fractus_core.policy.compiled_grant import (
    OPERATION_AREA,
    AirVolume,
    CompiledGrant,
    Inclusion,
    PolicyZone,
    altitude_above_home_m,
    band_depth_m,
    band_may_overlap,
)
from fractus_core.policy.decision_types import GotoArgs, SetSpeedArgs, Situation, Verdict
from fractus_core.policy.geofences import SEVERITY, TAKEOVERS, find_breaches, signed_depth_m
from fractus_core.policy.kinematics import (
    XY,
    pending_outcomes,
    reaction_s,
    stop_altitude_m,
    stop_point,
    vertical_leg,
)
from fractus_core.policy.limits import (
    Bound,
    altitude_bounds,
    command_range,
    deny_unknown_datum,
    is_achievable,
    speed_bounds,
    strictest_bound,
)

TRACKING_SHARE = 0.3
"""Tracking margin of the monitor, as a fraction of the tracking margin of permitted legs."""

AIM_SHARE = 0.1
"""A drone counts as flying to a target if its course misses the target by at most this fraction of the distance. Gusts
may turn the drone's course."""

SINKING_MPS = 0.5
"""Vertical speed of two rules, in m/s.

While its altitude limits are unknown, a drone may continue if it climbs more slowly. In a system flight, a drone above an upper
limit that sinks faster counts as returning below the limit.
"""

CLIMBING_MPS = 0.2
"""Maximum climb or sink rate of a drone that holds its altitude."""

DEEPER_M = 0.6
"""A drone on the wrong side of a fence is stopped again only if it moves this much farther onto that side."""


def monitor(
    now: Situation,
    grant: CompiledGrant,
    *,
    system_flies: bool = False,
    fences_changed: bool = False,
    current_leg: GotoArgs | None = None,
) -> Verdict | None:
    """Return what the system must do about a flying drone now.

    The check covers the path from the present position to the point where the drone comes to rest if it is commanded to
    stop now, with the position error around the path. This margin is smaller than the margin of permitted legs, so that a leg
    flown as permitted never triggers the monitor.

    Args:
        now: State of the drone.
        grant: Permissions and restrictions that apply.
        system_flies: True if the system or the autopilot already flies the drone. Only a deterioration counts then, because
            the system's route leads back from the wrong side of a fence or from above a limit.
        fences_changed: True if other fences may have been in force when the drone's motion was judged. An accelerating drone
            is faster when it receives a stop, and its longer stopping path has not been judged, so it is stopped early.
            A leg whose remaining part is no longer legal is stopped too.
        current_leg: Leg under way if it was permitted under this grant. The autopilot then brakes for its end without a
            command.

    Returns:
        None if nothing must be done. A takeover. A denial with `hover`, if the motion must stop and the application
        keeps control. Or a correction with the arguments to carry out.
    """
    if not now.in_air:
        return None
    if not now.is_plausible and not math.isfinite(now.time_s):
        raise ValueError("the time is not a number")
    lat = now.lat
    lon = now.lon
    if lat is None or lon is None or not now.is_plausible:
        return Verdict("takeover", None, "PositionUnknown", "the drone's position is unknown", (), "hover")
    start = grant.frame.xy(lat, lon)
    margin = now.position_error_m + TRACKING_SHARE * now.airframe.tracking_m
    outlooks = [(start, now), *pending_outcomes(now, start)] if fences_changed else []
    # Ignore acceleration, because the judgement of the current leg considered it, and the drone brakes in time for the
    # end of the leg.
    now = replace(now, forward_mps2=min(now.forward_mps2 or 0.0, 0.0))
    stop = stop_point(now, start)
    ahead = (
        stop
        if current_leg is None
        else _rest_position(now, start, stop, grant.frame.xy(current_leg.lat, current_leg.lon))
    )
    level_m = _rest_altitude_m(now, current_leg, grant)
    worst = _worst(
        _fence_reactions(now, grant, _stopping_path(now, start, ahead, margin, level_m), system_flies=system_flies)
    )
    if worst is not None:
        return replace(worst, brake_first=worst.action == "takeover" and now.is_moving)
    for outcome_position, outcome in outlooks:
        # The drone may still come to rest before the fence. Stop it now. The system takes it over only if it passes the
        # fence.
        further = _stopping_path(
            outcome,
            outcome_position,
            stop_point(outcome, outcome_position),
            margin,
            _rest_altitude_m(outcome, current_leg, grant),
        )
        worst = _worst(_fence_reactions(outcome, grant, further, system_flies=True))
        if worst is not None:
            return replace(worst, action="deny", takeover="hover")
    if fences_changed and current_leg is not None:
        # Stop a leg that has become illegal at once, because the link to the autopilot may fail later.
        worst = _worst(
            _fence_reactions(
                now, grant, _rest_of_leg(now, grant, start, current_leg, margin), system_flies=system_flies
            )
        )
        if worst is not None:
            return replace(worst, brake_first=worst.action == "takeover" and now.is_moving)
    rest_m = _altitude_after_stop_m(now, level_m)
    # No rule has checked a climb that the autopilot started, and the final altitude is unknown. So the tolerance is
    # smaller.
    unjudged_climb = system_flies and current_leg is None and now.down_mps < -CLIMBING_MPS
    correction = _check_altitude(
        now, grant, start, stop, rest_m, sinks_back=system_flies, share=0.5 if unjudged_climb else 1.0
    )
    return correction or _check_speed(now, grant, start)


def _worst(findings: list[tuple[int, Verdict]]) -> Verdict | None:
    """Return the verdict that takes most control from the application. Equal verdicts are ordered by priority."""
    ranked = [
        (-SEVERITY[v.takeover] if v.action == "takeover" and v.takeover is not None else 0, -priority, i)
        for i, (priority, v) in enumerate(findings)
    ]
    return findings[min(ranked)[2]][1] if ranked else None


def _rest_position(now: Situation, start: XY, stop: XY, target: XY) -> XY:
    """Return the point where a drone that flies to a target comes to rest.

    The result is the target while the drone can brake for it as planned. A drone commanded to stop flies on for its
    reaction time, but it already brakes for the target. So it overshoots the target at most by the distance covered in
    the reaction time plus its tracking error.
    """
    (dx, dy), (tx, ty) = ((x - start[0], y - start[1]) for x, y in (stop, target))
    run = math.hypot(dx, dy)
    if run == 0.0:
        return stop
    along = (dx * tx + dy * ty) / run
    aside = abs(dx * ty - dy * tx) / run
    late = math.hypot(now.north_mps, now.east_mps) * reaction_s(now, now.airframe.accel_mps2)
    strays = now.airframe.tracking_m
    aims = aside <= strays + AIM_SHARE * max(along, 0.0)
    arrives = aims and -strays <= along < run <= along + late + strays
    return target if arrives else stop


def _rest_altitude_m(now: Situation, current_leg: GotoArgs | None, grant: CompiledGrant) -> float:
    """Return the altitude above home at which a climbing or sinking drone comes to rest.

    The result is the altitude of the drone's leg if the drone can brake for it as planned, as in `_rest_position`.
    """
    rest_m = stop_altitude_m(now)
    climb = -now.down_mps
    if current_leg is None or current_leg.alt is None or climb == 0.0:
        return rest_m
    target_m = altitude_above_home_m(current_leg.alt, current_leg.reference, now.home, grant.flat_terrain)
    if target_m is None:
        return rest_m
    up = math.copysign(1.0, climb)
    strays = now.airframe.tracking_m
    late = abs(climb) * reaction_s(now, now.airframe.climb_accel_mps2)
    ahead = (target_m - now.altitude_m) * up
    beyond = (rest_m - target_m) * up
    return target_m if ahead >= -strays and 0.0 < beyond <= late + strays else rest_m


def _altitude_after_stop_m(now: Situation, rest_m: float) -> float:
    """Return the altitude at which the drone comes to rest, considering a pending command that already stops its climb.

    `rest_m` assumes that the command is sent now. If a pending command already ends the climb or descent, the drone
    comes to rest earlier by the distance that it covers during the latency. Only altitude limits use this result.
    Zones are judged with `rest_m`.
    """
    climb = -now.down_mps
    if not now.pending or -now.pending[-1][2] * climb > 0.0:
        return rest_m
    late_m = min(abs(climb) * now.latency_s, abs(rest_m - now.altitude_m))
    return rest_m - math.copysign(late_m, climb)


def must_stop_first(now: Situation, grant: CompiledGrant) -> bool:
    """Return True if a moving drone must come to rest before it begins another motion.

    The drone must come to rest if its stopping path comes closer to a fence than the margin of legs. Otherwise, the
    monitor could interrupt the next motion, even a legal one. Braking that has begun is ignored, because a new command
    may interrupt it.
    """
    position = grant.locate(now)
    if position is None or not now.in_air or not now.is_moving:
        return False
    outlooks = [(position, replace(now, forward_mps2=0.0)), *pending_outcomes(now, position)]
    return any(
        _fence_reactions(
            outcome,
            grant,
            _stopping_path(
                outcome,
                outcome_position,
                stop_point(outcome, outcome_position),
                outcome.margin_m,
                stop_altitude_m(outcome),
            ),
            system_flies=True,
        )
        for outcome_position, outcome in outlooks
    )


def _stopping_path(now: Situation, start: XY, stop: XY, margin: float, rest_m: float) -> _StoppingPath:
    path = shapely.points(start) if start == stop else shapely.linestrings((start, stop))
    lower = min(now.altitude_m, rest_m) - now.altitude_error_m
    upper = max(now.altitude_m, rest_m) + now.altitude_error_m
    # A landing drone may descend into a fence below it, so ignore its descent.
    ends_m = max(rest_m, now.altitude_m) if now.vertical else rest_m
    return _StoppingPath(
        AirVolume(path, margin, lower, upper), shapely.points(start), shapely.points(stop), now.altitude_m, ends_m
    )


def _rest_of_leg(now: Situation, grant: CompiledGrant, start: XY, leg: GotoArgs, margin: float) -> _StoppingPath:
    level_m = None if leg.alt is None else altitude_above_home_m(leg.alt, leg.reference, now.home, grant.flat_terrain)
    end = grant.frame.xy(leg.lat, leg.lon)
    return _stopping_path(now, start, end, margin, now.altitude_m if level_m is None else level_m)


@dataclass(frozen=True, slots=True)
class _StoppingPath:
    """Path on which a drone comes to rest after a stop, with its ends and their altitudes above home."""

    air: AirVolume
    present: BaseGeometry
    rest: BaseGeometry
    present_m: float
    rest_m: float


@dataclass(frozen=True, slots=True)
class _Fence:
    """A fence, with the texts for verdicts on it.

    Attributes:
        policy: Name of the policy.
        action: Action of the policy.
        name: Name of the fence in messages.
        broken: Verdict code if the drone is on the wrong side.
        ahead: Verdict code if the drone is about to reach the wrong side.
    """

    policy: str
    action: GeofenceAction
    name: str
    broken: str
    ahead: str


@dataclass(frozen=True, slots=True)
class _Finding:
    """Violation of a fence by a drone.

    Attributes:
        broken: True if the drone is on the wrong side.
        worse: True if its motion leads to the wrong side, or farther into it.
        description: Relation of the drone to the fence, for the reason.
    """

    fence: _Fence
    broken: bool
    worse: bool
    description: str


def _fence_reactions(
    now: Situation, grant: CompiledGrant, ahead: _StoppingPath, *, system_flies: bool
) -> list[tuple[int, Verdict]]:
    """Return the verdicts that fences require, each with the priority of its policy."""
    findings: list[tuple[int, _Finding | None]] = [
        (zone.rule.spec.priority, _check_exclusion(zone, ahead, now, grant.flat_terrain))
        for zone in grant.exclusions.near(ahead.air, now, grant.flat_terrain)
    ]
    if grant.flight_area is not None and grant.flight_area_border is not None:
        area = _Fence(
            OPERATION_AREA, "ignore", "the operation area", "OutsideOperationArea", "OperationAreaBorderAhead"
        )
        findings.append((0, _check_inclusion(grant.flight_area, grant.flight_area_border, ahead, area, leaves=False)))
    for inclusion in grant.inclusions:
        if inclusion.rule.in_force(now.time_s):
            shape, border = inclusion.at(ahead.air.lower_m, ahead.air.upper_m, now, grant.flat_terrain)
            zones = ", ".join(dict.fromkeys(p.name for p in inclusion.zones)) or "its zones"
            rule = inclusion.rule
            name = f"{zones} of policy {rule.name}"
            fence = _Fence(rule.name, rule.spec.geofence_action, name, "OutsideInclusionZone", "InclusionBorderAhead")
            leaves = inclusion.banded and _leaves_altitudes(inclusion, ahead, now, grant.flat_terrain)
            findings.append((rule.spec.priority, _check_inclusion(shape, border, ahead, fence, leaves=leaves)))
    reactions = [(priority, _reaction(f, system_flies=system_flies)) for priority, f in findings if f is not None]
    return [(priority, verdict) for priority, verdict in reactions if verdict is not None]


def _check_exclusion(zone: PolicyZone, ahead: _StoppingPath, now: Situation, flat: bool) -> _Finding:
    shape = zone.shape
    border = zone.shape.boundary
    around = bool(shape.intersects(ahead.present))
    crosses = bool(shape.intersects(ahead.air.ground))
    error_m = now.altitude_error_m
    inside = around and band_may_overlap(
        zone.band, ahead.present_m - error_m, ahead.present_m + error_m, now.home, flat
    )
    rest_m, depth_now_m = (signed_depth_m(shape, border, point) for point in (ahead.rest, ahead.present))
    worse = rest_m > depth_now_m + DEEPER_M or (crosses and not around)
    if crosses and zone.band is not None:
        # The drone may also enter the zone from above or below. Its depth in the zone is the smaller one of its
        # horizontal and its vertical depth.
        rest_m, depth_now_m = (
            min(depth_m, band_depth_m(zone.band, altitude_m, now.home, flat))
            for depth_m, altitude_m in ((rest_m, ahead.rest_m), (depth_now_m, ahead.present_m))
        )
        worse = worse or depth_now_m < 0.0 <= rest_m or (rest_m > depth_now_m + DEEPER_M and rest_m > -error_m)
    name = f"zone {zone.name} of policy {zone.rule.name}"
    fence = _Fence(zone.rule.name, zone.rule.spec.geofence_action, name, "InsideExclusionZone", "ExclusionZoneAhead")
    return _Finding(fence, inside, worse, "is inside" if inside else "is about to enter")


def _leaves_altitudes(fence: Inclusion, ahead: _StoppingPath, now: Situation, flat: bool) -> bool:
    """Return True if a drone that must stay in one of several zones moves farther away from the altitudes of all."""
    around = [zone.band for zone in fence.zones if zone.shape.intersects(ahead.present)]
    rest_m, depth_now_m = (
        max((band_depth_m(band, m, now.home, flat) for band in around), default=math.inf)
        for m in (ahead.rest_m, ahead.present_m)
    )
    return rest_m < 0.0 <= depth_now_m or (rest_m < depth_now_m - DEEPER_M and rest_m < now.altitude_error_m)


def _check_inclusion(
    shape: BaseGeometry, border: BaseGeometry, ahead: _StoppingPath, fence: _Fence, *, leaves: bool
) -> _Finding | None:
    path = ahead.air.ground
    if shape.covers(path) and not border.dwithin(path, ahead.air.margin_m):
        return None
    outside = not shape.covers(ahead.present)
    worse = leaves
    if not shape.is_empty:
        depth_now_m = signed_depth_m(shape, border, ahead.present)
        worse = worse or signed_depth_m(shape, border, ahead.rest) < depth_now_m - DEEPER_M
    worse = worse or (not outside and not shape.covers(path))
    return _Finding(fence, outside, worse, "is outside" if outside else "is about to leave")


def _reaction(finding: _Finding, *, system_flies: bool) -> Verdict | None:
    """Return the verdict on a fence that is broken or about to be broken.

    A policy that takes over the drone does so in both cases. A policy with action ignore only stops motion that makes
    things worse.
    """
    fence = finding.fence
    takeover = TAKEOVERS[fence.action]
    code = fence.broken if finding.broken else fence.ahead
    reason = f"the drone {finding.description} {fence.name}"
    if takeover is not None and (finding.worse or (finding.broken and not system_flies)):
        return Verdict("takeover", None, code, reason, (fence.policy,), takeover)
    if finding.worse:
        return Verdict("deny", None, code, f"{reason}; the motion is stopped", (fence.policy,), "hover")
    return None


def _check_altitude(
    now: Situation, grant: CompiledGrant, start: XY, stop: XY, rest_m: float, *, sinks_back: bool, share: float
) -> Verdict | None:
    """Return the correction of an altitude that breaks limits, or None.

    Args:
        now: State of the drone.
        grant: Permissions and restrictions that apply.
        start: Present position.
        stop: Point where the drone comes to rest.
        rest_m: Altitude at which the drone comes to rest.
        sinks_back: True if a sinking drone is exempt from upper limits. Lower limits do not apply during takeoff and
            landing.
        share: Fraction of the tolerance by which a drone may come to rest above an upper limit.
    """
    if grant.max_altitude_m is None and not grant.altitude_limits:
        return None
    bounds, unknown = altitude_bounds(grant, now, AirVolume(shapely.points(start), 0.0, now.altitude_m, now.altitude_m))
    slack = now.altitude_error_m + now.airframe.tracking_m
    sinks_back = sinks_back and now.down_mps > SINKING_MPS
    over = strictest_bound(bounds, above=True)
    under = strictest_bound(bounds, above=False)
    high = max(now.altitude_m, rest_m)
    low = min(now.altitude_m, rest_m)
    if over is not None and over.upper is not None and high > over.upper + share * slack and not sinks_back:
        moves = "climbs to" if now.down_mps < -CLIMBING_MPS else "is at"
        reason = f"the drone {moves} {high:.1f} m, above the limit of {over.upper:.1f} m"
        target_m = command_range(bounds)[1]
        return _altitude_correction(_LimitViolation(over, target_m, "AltitudeAboveLimit", reason), now, grant, stop)
    if unknown:
        sinking = now.down_mps > -SINKING_MPS
        return None if sinking else replace(deny_unknown_datum(unknown[0]), takeover="hover")
    if under is not None and under.lower is not None and low < under.lower - slack and not now.vertical:
        if over is not None and over.upper is not None and over.upper < under.lower:
            return None
        moves = "sinks to" if now.down_mps > CLIMBING_MPS else "is at"
        reason = f"the drone {moves} {low:.1f} m, below the limit of {under.lower:.1f} m"
        target_m = command_range(bounds)[0]
        return _altitude_correction(_LimitViolation(under, target_m, "AltitudeBelowLimit", reason), now, grant, stop)
    return None


@dataclass(frozen=True, slots=True)
class _LimitViolation:
    """A broken altitude limit, and the altitude that complies with it."""

    bound: Bound
    height_m: float
    code: str
    reason: str


def _altitude_correction(violation: _LimitViolation, now: Situation, grant: CompiledGrant, stop: XY) -> Verdict:
    """Return the correction to an altitude, or a stop if zones block the way to this altitude."""
    names = (violation.bound.name,) if violation.bound.name else ()
    column = vertical_leg(stop, min(now.altitude_m, violation.height_m), max(now.altitude_m, violation.height_m))
    if find_breaches(column, now, grant, 0.0, 0.0):
        reason = f"{violation.reason}; zones block the way back, so the drone hovers"
        return Verdict("deny", None, violation.code, reason, names, "hover")
    lat, lon = grant.frame.latlon(*stop)
    return Verdict("correct", GotoArgs(lat, lon, violation.height_m), violation.code, violation.reason, names)


def _check_speed(now: Situation, grant: CompiledGrant, start: XY) -> Verdict | None:
    """Return the correction of a speed that breaks limits, or None."""
    if grant.max_speed_mps is None and not grant.speed_limits:
        return None
    speed = math.hypot(now.north_mps, now.east_mps)
    bounds = speed_bounds(grant, now, AirVolume(shapely.points(start), 0.0, now.altitude_m, now.altitude_m))
    over = strictest_bound(bounds, above=True)
    # Gusts push a drone beyond its speed setpoint for a moment, so a tenth and 1 m/s are tolerated.
    if over is None or over.upper is None or over.highest is None or speed <= over.upper * 1.1 + 1.0:
        return None
    reason = f"the drone flies at {speed:.1f} m/s, above the limit of {over.upper:.1f} m/s"
    names = (over.name,) if over.name else ()
    if not is_achievable("Speed", over.upper):
        return Verdict("deny", None, "SpeedAboveLimit", f"{reason}; the motion is stopped", names, "hover")
    return Verdict("correct", SetSpeedArgs(over.highest), "SpeedAboveLimit", reason, names)
