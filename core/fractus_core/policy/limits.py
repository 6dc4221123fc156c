"""Limits on altitude and speed.

Enforced limits correct a value, and other limits deny it. A corrected value is judged again until no further correction
is needed.

The autopilot overshoots a commanded speed or altitude. The command therefore stays inside a limit by the overshoot. A
requested value between this command and the limit breaks no limit: the call is allowed with the value of the command.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.api.policies import LimitAction
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.compiled_grant import (
    AirVolume,
    CompiledGrant,
    PolicyIndex,
    PolicyZone,
    Rule,
    altitude_above_home_m,
    band_limits_m,
    band_may_overlap,
)
from fractus_core.policy.decision_types import Args, Call, Situation, Verdict, deny, distinct
from fractus_core.policy.geofences import comes_level
from fractus_core.policy.kinematics import altitude_range_to_stop_m

ROUNDING_SLACK = 1e-6
"""Tolerance of limits. With it, a value that was corrected to a limit does not break the limit because of rounding."""
MIN_LEG_ALTITUDE_M = 2.0
"""Lowest altitude above home at the end of a motion other than landing, unless an altitude limit permits less."""


_REFUSES: dict[LimitAction, bool] = exhaustive(LimitAction, {"enforce": False, "refuse": True})


@dataclass(frozen=True, slots=True)
class Bound:
    """A limit in force: altitudes above home, or speeds.

    Attributes:
        name: Policy; empty for a limit of the drone.
        priority: Priority of the policy.
        lower: Lower limit of the actual value.
        upper: Upper limit of the actual value.
        refuses: True if the limit denies a value instead of correcting it.
        shape: Ground of the zone in which the limit applies. None means everywhere.
        band_m: Floor and ceiling of this zone above home, infinite if missing or unknown.
        lowest: Lowest value to command.
        highest: Highest value to command.
    """

    name: str
    priority: int
    lower: float | None
    upper: float | None
    refuses: bool
    shape: BaseGeometry | None = None
    band_m: tuple[float, float] = (-math.inf, math.inf)
    lowest: float | None = None
    highest: float | None = None


def altitude_bound(
    name: str, priority: int, lower: float | None, upper: float | None, now: Situation, *, refuses: bool
) -> Bound:
    """Return an altitude limit. Commands stay inside it by the drone's overshoot."""
    room_m = now.airframe.overshoot_m
    lowest = None if lower is None else lower + room_m
    highest = None if upper is None else upper - room_m
    return Bound(name, priority, lower, upper, refuses, lowest=lowest, highest=highest)


def speed_bound(
    name: str, priority: int, lower: float | None, upper: float | None, now: Situation, *, refuses: bool
) -> Bound:
    """Return a speed limit. A lower limit applies to the commanded speed, because each drone starts and stops."""
    highest = None if upper is None else now.airframe.highest_command_mps(upper)
    return Bound(name, priority, lower, upper, refuses, lowest=lower, highest=highest)


@dataclass(frozen=True, slots=True)
class Correction:
    """A value that satisfies all limits. Code, reason and policies are set if the value was changed."""

    value: float
    code: str = ""
    reason: str = ""
    policies: tuple[str, ...] = ()


def correction_verdict(args: Args, corrections: Sequence[Correction]) -> Verdict:
    """Return the verdict on a call that is carried out with the given arguments, which result from the corrections."""
    steps = [note for note in corrections if note.code]
    if not steps:
        return Verdict("allow", args)
    names = distinct(name for note in steps for name in note.policies)
    return Verdict("correct", args, steps[0].code, "; ".join(note.reason for note in steps), names)


def altitude_bounds(
    grant: CompiledGrant, now: Situation, air: AirVolume, height_margin_m: float = 0.0
) -> tuple[list[Bound], list[Rule]]:
    """Return the altitude limits that apply in a volume, or within a margin above and below it.

    Returns:
        The limits in metres above home, and the rules whose datum has an unknown height.
    """
    bounds = []
    unknown = list[Rule]()
    if grant.max_altitude_m is not None:
        bounds.append(altitude_bound("", 0, None, grant.max_altitude_m, now, refuses=False))
    limits = grant.altitude_limits
    for rule, zone in _in_force(limits, now, limiting_zones(limits, grant, now, air, height_margin_m)):
        spec = rule.spec
        edges = []
        for edge in (spec.lower_limit, spec.upper_limit):
            height = (
                None
                if edge is None
                else altitude_above_home_m(edge, spec.altitude_reference, now.home, grant.flat_terrain)
            )
            if edge is not None and height is None:
                unknown.append(rule)
                break
            edges.append(height)
        else:
            refuses = _REFUSES[spec.limit_action]
            bound = altitude_bound(rule.name, spec.priority, edges[0], edges[1], now, refuses=refuses)
            if zone is not None:
                band_m = band_limits_m(zone.band, now.home, grant.flat_terrain)
                bound = replace(bound, shape=zone.shape, band_m=band_m)
            bounds.append(bound)
    return bounds, unknown


def lowest_ceiling_m(bounds: Sequence[Bound], unknown: Sequence[Rule], present_m: float) -> float:
    """Return the highest altitude above home to command under upper limits.

    If an upper limit has a datum of unknown height, the result is at most `present_m`, so the drone does not climb.
    """
    ceiling = min((bound.highest for bound in bounds if bound.highest is not None), default=math.inf)
    return min(ceiling, present_m) if any(rule.spec.upper_limit is not None for rule in unknown) else ceiling


def deny_unknown_datum(rule: Rule) -> Verdict:
    """Return the denial of a motion under an altitude limit whose datum has an unknown height."""
    terrain = rule.spec.altitude_reference == "terrain"
    subject, code = ("no terrain model is loaded", "TerrainUnknown") if terrain else ("home is unknown", "HomeUnknown")
    return deny(
        code,
        f"policy {rule.name} limits altitude above {rule.spec.altitude_reference} level, and {subject}",
        (rule.name,),
    )


def limit_forbids_altitudes(zone: PolicyZone, lower_m: float, upper_m: float, now: Situation, flat: bool) -> bool:
    """Return True if the altitude limit of a zone forbids any altitude from `lower_m` to `upper_m` above home."""
    spec = zone.rule.spec
    highest, lowest = (
        edge if edge is None else altitude_above_home_m(edge, spec.altitude_reference, now.home, flat)
        for edge in (spec.upper_limit, spec.lower_limit)
    )
    if (highest is None) != (spec.upper_limit is None) or (lowest is None) != (spec.lower_limit is None):
        return True
    return (highest is not None and upper_m > highest) or (lowest is not None and lower_m < lowest)


def speed_bounds(grant: CompiledGrant, now: Situation, air: AirVolume, height_margin_m: float = 0.0) -> list[Bound]:
    """Return the speed limits, in metres per second, that apply in a volume, or within a margin above and below it."""
    bounds = []
    if grant.max_speed_mps is not None:
        bounds.append(speed_bound("", 0, None, grant.max_speed_mps, now, refuses=False))
    # No drone is trapped by a speed limit, so the limit applies even if the drone is already too close to the zone.
    zones = grant.speed_limits.near(air.extended(height_margin_m), now, grant.flat_terrain)
    for rule, _ in _in_force(grant.speed_limits, now, zones):
        spec = rule.spec
        refuses = _REFUSES[spec.limit_action]
        bounds.append(speed_bound(rule.name, spec.priority, spec.lower_limit, spec.upper_limit, now, refuses=refuses))
    return bounds


def _in_force(
    index: PolicyIndex, now: Situation, zones: Iterable[PolicyZone]
) -> Iterator[tuple[Rule, PolicyZone | None]]:
    for rule in index.everywhere:
        if rule.in_force(now.time_s):
            yield rule, None
    for zone in zones:
        yield zone.rule, zone


def limiting_zones(
    limits: PolicyIndex, grant: CompiledGrant, now: Situation, air: AirVolume, height_margin_m: float
) -> Iterator[PolicyZone]:
    """Yield the zones of altitude limits that a leg touches or passes within its margins.

    A drone that is already too close above or below a zone may continue at its altitude, or leave.

    Args:
        limits: Policies with the zones.
        grant: Permissions and restrictions that apply.
        now: State of the drone.
        air: Volume of the leg, with its horizontal margin.
        height_margin_m: Distance to keep from floors and ceilings of zones.
    """
    position = grant.locate(now)
    present = None if position is None else shapely.points(position)
    flat = grant.flat_terrain
    for zone in limits.near(air.extended(height_margin_m), now, flat):
        beside = present is None or not zone.shape.dwithin(present, air.margin_m)
        if (
            beside
            or band_may_overlap(zone.band, *altitude_range_to_stop_m(now), now.home, flat)
            or comes_level(zone.band, air.lower_m, air.upper_m, now, height_margin_m=height_margin_m, flat=flat)
        ):
            yield zone


def clamp(quantity: str, unit: str, value: float, bounds: list[Bound]) -> Correction | Verdict:
    """Correct a value to all limits.

    Args:
        quantity: "Altitude" or "Speed", for codes and sentences.
        unit: Unit of the value, for sentences.
        value: Requested value.
        bounds: Limits in force.

    Returns:
        The nearest value to command, or a denial. The correction has a code only if the requested value breaks a limit. A
        denial results from a limit that refuses, from limits that contradict each other, and from limits that no motion can keep.
    """
    # Negated `<=` and `>=`, so that a limit that is NaN counts as broken.
    above = sorted(
        (b for b in bounds if b.upper is not None and not value <= b.upper + ROUNDING_SLACK), key=_strictest_upper
    )
    below = sorted(
        (b for b in bounds if b.lower is not None and not value >= b.lower - ROUNDING_SLACK), key=_strictest_lower
    )
    if not above and not below:
        return Correction(commanded_value(value, bounds))
    violated, side = (above, "Above") if above else (below, "Below")
    code = f"{quantity}{side}Limit"
    names = distinct(b.name for b in violated)
    refusing = [b for b in (*above, *below) if b.refuses]
    if refusing:
        bound = refusing[0]
        limit = bound.upper if bound in above else bound.lower
        code = f"{quantity}{'Above' if bound in above else 'Below'}Limit"
        return deny(
            code,
            f"{quantity.lower()} {value:.1f} {unit} breaks the limit of {limit:.1f} {unit} of {_source(bound)} (action refuse)",
            distinct(b.name for b in refusing),
        )
    for bound in (*above, *below):
        limit = bound.upper if bound in above else bound.lower
        if not is_achievable(quantity, limit):
            reason = f"{quantity.lower()} {value:.1f} {unit} breaks the limit of {limit} {unit} of {_source(bound)}"
            return deny(code, f"{reason}; no motion can comply with this limit, so correct it", distinct((bound.name,)))
    problem = check_contradiction(quantity, unit, bounds)
    if problem is not None:
        return problem
    corrected_value = commanded_value(value, bounds)
    word = "above" if above else "below"
    room = _describe_room(corrected_value, _highest(bounds) if above else _lowest(bounds))
    reason = (
        f"{quantity.lower()} {value:.1f} {unit} is {word} the limit of {_source(violated[0])};"
        f" corrected to {corrected_value:.1f} {unit}{room}"
    )
    return Correction(corrected_value, code, reason, names)


def _describe_room(value: float, limit: float) -> str:
    if abs(value - limit) <= ROUNDING_SLACK:
        return ""
    return f" (limit {limit:.1f} {'less' if value < limit else 'plus'} {abs(limit - value):.1f} for overshoot)"


def command_range(bounds: Sequence[Bound]) -> tuple[float, float]:
    """Return the lowest and the highest value to command under limits.

    Altitude limits that are closer to each other than the overshoot leave only their middle. Such speed limits leave only
    the lower one, which applies to the commanded speed.
    """
    lowest = max((b.lowest for b in bounds if b.lowest is not None), default=-math.inf)
    highest = min((b.highest for b in bounds if b.highest is not None), default=math.inf)
    if lowest > highest and _lowest(bounds) <= _highest(bounds):
        only = min(lowest, (_lowest(bounds) + _highest(bounds)) / 2)
        return only, only
    return lowest, highest


def commanded_value(value: float, bounds: Sequence[Bound]) -> float:
    """Return the value to command that is nearest to a requested value."""
    lowest, highest = command_range(bounds)
    if lowest - ROUNDING_SLACK <= value <= highest + ROUNDING_SLACK:
        return value
    return min(max(value, lowest), highest)


def is_achievable(quantity: str, limit: float | None) -> bool:
    """Return True if a value may be corrected to a limit.

    The limit must be finite. A speed limit must also be above zero.
    """
    return limit is not None and math.isfinite(limit) and (quantity != "Speed" or limit > 0)


def check_contradiction(quantity: str, unit: str, bounds: list[Bound]) -> Verdict | None:
    """Return a denial if no value satisfies both the lower and the upper limits, or None if a value does."""
    highest = _highest(bounds)
    lowest = _lowest(bounds)
    if lowest <= highest + ROUNDING_SLACK:
        return None
    high = [b for b in bounds if b.upper == highest]
    low = [b for b in bounds if b.lower == lowest]
    return deny(
        "ConflictingLimits",
        f"no {quantity.lower()} is at least {lowest:.1f} ({_sources(low)}) and at most {highest:.1f} {unit}"
        f" ({_sources(high)}); choose another position",
        distinct(b.name for b in bounds if b in low or b in high),
    )


def _highest(bounds: Sequence[Bound]) -> float:
    return min((b.upper for b in bounds if b.upper is not None), default=float("inf"))


def _lowest(bounds: Sequence[Bound]) -> float:
    return max((b.lower for b in bounds if b.lower is not None), default=float("-inf"))


def strictest_bound(bounds: list[Bound], *, above: bool) -> Bound | None:
    """Return the bound with the lowest upper limit, or with the highest lower limit."""
    if above:
        return min((b for b in bounds if b.upper is not None), key=_strictest_upper, default=None)
    return min((b for b in bounds if b.lower is not None), key=_strictest_lower, default=None)


def allows_low_altitude(bounds: list[Bound]) -> bool:
    """Return True if an altitude limit in force permits or requires altitudes below `MIN_LEG_ALTITUDE_M`."""
    return any(
        edge is not None and edge < MIN_LEG_ALTITUDE_M for bound in bounds for edge in (bound.lower, bound.highest)
    )


def check_altitude_on_entry(
    start: BaseGeometry, heights_m: tuple[float, float], bounds: list[Bound], slack_m: float
) -> Verdict | None:
    """Return the denial of a leg that would enter a zone at an altitude that the zone does not permit, or None.

    A drone enters a zone from the side at its present altitude, and from above or below at the ceiling or the floor.

    Args:
        start: Start of the leg.
        heights_m: Present altitude, and the altitude at which a climbing or sinking drone comes to rest.
        bounds: Altitude limits along the leg.
        slack_m: Permitted deviation from the limits.
    """
    for bound in bounds:
        floor_m, ceiling_m = bound.band_m
        outside = min(heights_m) > ceiling_m or max(heights_m) < floor_m
        if bound.shape is None or (bound.shape.intersects(start) and not outside):
            continue
        low = min(max(min(heights_m), floor_m), ceiling_m)
        high = min(max(*heights_m, floor_m), ceiling_m)
        if bound.upper is not None and high > bound.upper + slack_m:
            return deny(
                "AltitudeAboveLimit",
                f"the leg enters the zone of policy {bound.name} at {high:.1f} m, above its limit of"
                f" {bound.upper:.1f} m; descend first",
                (bound.name,),
            )
        if bound.lower is not None and low < bound.lower - slack_m:
            return deny(
                "AltitudeBelowLimit",
                f"the leg enters the zone of policy {bound.name} at {low:.1f} m, below its limit of"
                f" {bound.lower:.1f} m; climb first",
                (bound.name,),
            )
    return None


def _strictest_upper(bound: Bound) -> tuple[float, int, str]:
    return (bound.upper if bound.upper is not None else float("inf"), -bound.priority, bound.name)


def _strictest_lower(bound: Bound) -> tuple[float, int, str]:
    return (-(bound.lower if bound.lower is not None else float("-inf")), -bound.priority, bound.name)


def _sources(bounds: list[Bound]) -> str:
    return " and ".join(dict.fromkeys(_source(bound) for bound in bounds))


def _source(bound: Bound) -> str:
    return f"policy {bound.name}" if bound.name else "the drone"


# Corrections of corrections

MAX_ROUNDS = 8
"""Maximum number of successive corrections. A corrected altitude may violate the limits of further zones, but few zones
overlap."""


def settle_correction(call: Call, first: Verdict, judge: Callable[[Call], Verdict]) -> Verdict:
    """Judge a correction again until no further correction is needed.

    A corrected altitude may lie in the band of another zone whose limits were not considered before. So each correction
    is judged like a call that requests it.

    Args:
        call: Requested call.
        first: Its correction.
        judge: Judgement of a call in the same situation and under the same grant.

    Returns:
        A correction to arguments that are permitted unchanged, or the denial of limits that cannot be met together. It
        is never a takeover, because the application did not request the corrected arguments.
    """
    steps = [first]
    for _ in range(MAX_ROUNDS):
        verdict = judge(replace(call, args=steps[-1].args))
        if verdict.action == "allow":
            return _summed_up(steps, verdict)
        if verdict.action != "correct":
            return deny_conflict(steps, verdict)
        steps.append(verdict)
    return deny_conflict(steps[:-1], steps[-1])


def _summed_up(steps: Sequence[Verdict], allowed: Verdict) -> Verdict:
    return replace(
        steps[0],
        args=allowed.args,
        reason="; ".join(step.reason for step in steps),
        policies=distinct(name for step in steps for name in step.policies),
        brake_first=allowed.brake_first or any(step.brake_first for step in steps),
    )


def choose_objection(problem: Verdict, requested: Verdict | None, correction: Verdict) -> Verdict:
    """Return the verdict on a corrected call that is not permitted.

    Args:
        problem: Objection to the corrected arguments.
        requested: Objection to the requested arguments, or None.
        correction: Correction of the call.
    """
    if requested is None:
        return deny_conflict((correction,), problem) if correction.code else problem
    # A drone is taken over for requested arguments only, never for corrected ones.
    return requested if problem.action == "takeover" else problem


def deny_conflict(steps: Sequence[Verdict], problem: Verdict) -> Verdict:
    """Return the denial of a call whose corrections lead to another objection."""
    names = distinct(name for step in (*steps, problem) for name in step.policies)
    if len(names) > 1:
        subject = f"policies {', '.join(names)}"
    else:
        subject = f"the limits of policy {names[0]}" if names else "limits"
    # The objection concerns the last correction.
    reason = f"{subject} cannot be met together: {steps[-1].reason}, and then {problem.reason}; change the request"
    return deny("ConflictingLimits", reason, names)
