"""Limits on altitude and speed: clamp what may be enforced, refuse the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from shapely.geometry.base import BaseGeometry

from fractus_core.api.policies import LimitAction
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.altitude import altitude_above_home_m
from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant, PolicyIndex, PolicyZone, Rule
from fractus_core.policy.decision_types import Args, Call, Situation, Verdict, deny, distinct

ROUNDING_SLACK = 1e-6
"""Rounding of a value that was corrected to a limit exactly must not break that limit."""
MIN_LEG_ALTITUDE_M = 2.0
"""A motion other than landing ends at least this high above home, where no altitude limit says that lower is fine."""


_REFUSES: dict[LimitAction, bool] = exhaustive(LimitAction, {"enforce": False, "refuse": True})


@dataclass(frozen=True, slots=True)
class Bound:
    """One limit in force; heights above home, or speeds."""

    name: str
    priority: int
    lower: float | None
    upper: float | None
    refuses: bool
    shape: BaseGeometry | None = None


@dataclass(frozen=True, slots=True)
class Correction:
    """A value inside all limits, and what had to be done for it."""

    value: float
    code: str = ""
    reason: str = ""
    policies: tuple[str, ...] = ()


def correction_verdict(args: Args, notes: Sequence[Correction]) -> Verdict:
    """The verdict on a call that is carried out with these arguments, after all that had to be done for them."""
    done = [note for note in notes if note.code]
    if not done:
        return Verdict("allow", args)
    names = distinct(name for note in done for name in note.policies)
    return Verdict("correct", args, done[0].code, "; ".join(note.reason for note in done), names)


def altitude_bounds(grant: CompiledGrant, now: Situation, air: AirVolume) -> tuple[list[Bound], list[Rule]]:
    """Altitude limits, in metres above home, in a piece of air; and the rules whose datum lies at no known height."""
    bounds, unknown = [], list[Rule]()
    if grant.max_altitude_m is not None:
        bounds.append(Bound("", 0, None, grant.max_altitude_m, refuses=False))
    for rule, zone in _in_force(grant.altitude_limits, grant, now, air):
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
            shape = zone.shape if zone else None
            bounds.append(Bound(rule.name, spec.priority, edges[0], edges[1], _REFUSES[spec.limit_action], shape))
    return bounds, unknown


def lowest_ceiling_m(bounds: Sequence[Bound], unknown: Sequence[Rule], here_m: float) -> float:
    """The lowest upper limit above home; where one of them lies at no known height, a drone does not climb from `here_m`."""
    ceiling = min((bound.upper for bound in bounds if bound.upper is not None), default=math.inf)
    return min(ceiling, here_m) if any(rule.spec.upper_limit is not None for rule in unknown) else ceiling


def deny_unknown_datum(rule: Rule) -> Verdict:
    """The denial of a motion by a limit of altitude whose datum lies at no known height."""
    terrain = rule.spec.altitude_reference == "terrain"
    what, code = ("no terrain model is loaded", "TerrainUnknown") if terrain else ("home is unknown", "HomeUnknown")
    return deny(
        code,
        f"policy {rule.name} limits altitude above {rule.spec.altitude_reference} level, and {what}",
        (rule.name,),
    )


def limit_forbids_altitudes(zone: PolicyZone, lower_m: float, upper_m: float, now: Situation, flat: bool) -> bool:
    """Whether the altitude limit of a zone does not allow all heights from lower to upper (above home)."""
    spec = zone.rule.spec
    highest, lowest = (
        edge if edge is None else altitude_above_home_m(edge, spec.altitude_reference, now.home, flat)
        for edge in (spec.upper_limit, spec.lower_limit)
    )
    if (highest is None) != (spec.upper_limit is None) or (lowest is None) != (spec.lower_limit is None):
        return True
    return (highest is not None and upper_m > highest) or (lowest is not None and lower_m < lowest)


def speed_bounds(grant: CompiledGrant, now: Situation, air: AirVolume) -> list[Bound]:
    """Speed limits, in metres per second, in a piece of air."""
    bounds = []
    if grant.max_speed_mps is not None:
        bounds.append(Bound("", 0, None, grant.max_speed_mps, refuses=False))
    for rule, _ in _in_force(grant.speed_limits, grant, now, air):
        spec = rule.spec
        bounds.append(Bound(rule.name, spec.priority, spec.lower_limit, spec.upper_limit, _REFUSES[spec.limit_action]))
    return bounds


def _in_force(
    index: PolicyIndex, grant: CompiledGrant, now: Situation, air: AirVolume
) -> Iterator[tuple[Rule, PolicyZone | None]]:
    for rule in index.everywhere:
        if rule.in_force(now.time_s):
            yield rule, None
    for zone in index.near(air, now, grant.flat_terrain):
        yield zone.rule, zone


def clamp(quantity: str, unit: str, value: float, bounds: list[Bound]) -> Correction | Verdict:
    """Bring a value inside every limit.

    Args:
        quantity: "Altitude" or "Speed", for codes and sentences.
        unit: its unit, for sentences.
        value: what was asked for.
        bounds: the limits in force.

    Returns:
        The nearest value that every limit allows, or the denial of a limit that refuses, or that leaves no value, or of
        limits that contradict each other.
    """
    # Not `>` and `<`: a limit that is not a number would never be broken.
    above = sorted(
        (b for b in bounds if b.upper is not None and not value <= b.upper + ROUNDING_SLACK), key=_strictest_upper
    )
    below = sorted(
        (b for b in bounds if b.lower is not None and not value >= b.lower - ROUNDING_SLACK), key=_strictest_lower
    )
    if not above and not below:
        return Correction(value)
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
            f"{quantity.lower()} {value:.1f} {unit} breaks the limit of {limit:.1f} {unit} of {_source(bound)}, which refuses it",
            distinct(b.name for b in refusing),
        )
    for bound in (*above, *below):
        limit = bound.upper if bound in above else bound.lower
        if not is_achievable(quantity, limit):
            reason = f"{quantity.lower()} {value:.1f} {unit} breaks the limit of {limit} {unit} of {_source(bound)}"
            return deny(code, f"{reason}, which no motion can keep; correct the limit", distinct((bound.name,)))
    problem = check_contradiction(quantity, unit, bounds)
    if problem is not None:
        return problem
    highest, lowest = _highest(bounds), _lowest(bounds)
    new = min(max(value, lowest), highest)
    word = "above" if above else "below"
    return Correction(
        new,
        code,
        f"{quantity.lower()} {value:.1f} {unit} is {word} the limit of {_source(violated[0])}; corrected to {new:.1f} {unit}",
        names,
    )


def is_achievable(quantity: str, limit: float | None) -> bool:
    """Whether a value may be corrected to a limit: any altitude that is a number, and any speed that moves a drone."""
    return limit is not None and math.isfinite(limit) and (quantity != "Speed" or limit > 0)


def check_contradiction(quantity: str, unit: str, bounds: list[Bound]) -> Verdict | None:
    """The denial of any value, where limits contradict each other."""
    highest, lowest = _highest(bounds), _lowest(bounds)
    if lowest <= highest + ROUNDING_SLACK:
        return None
    high = [b for b in bounds if b.upper == highest]
    low = [b for b in bounds if b.lower == lowest]
    return deny(
        "ConflictingLimits",
        f"no {quantity.lower()} is at least {lowest:.1f} (as {_sources(low)} asks) and at most {highest:.1f} {unit}"
        f" (as {_sources(high)} asks); ask for another place",
        distinct(b.name for b in bounds if b in low or b in high),
    )


def _highest(bounds: list[Bound]) -> float:
    return min((b.upper for b in bounds if b.upper is not None), default=float("inf"))


def _lowest(bounds: list[Bound]) -> float:
    return max((b.lower for b in bounds if b.lower is not None), default=float("-inf"))


def strictest_bound(bounds: list[Bound], *, above: bool) -> Bound | None:
    """The bound with the lowest upper edge, or the highest lower edge."""
    if above:
        return min((b for b in bounds if b.upper is not None), key=_strictest_upper, default=None)
    return min((b for b in bounds if b.lower is not None), key=_strictest_lower, default=None)


def allows_low_altitude(bounds: list[Bound]) -> bool:
    """Whether an altitude limit in force allows heights below `MIN_LEG_ALTITUDE_M`."""
    return any(
        edge is not None and edge < MIN_LEG_ALTITUDE_M for bound in bounds for edge in (bound.lower, bound.upper)
    )


def check_altitude_on_entry(
    here: BaseGeometry, heights_m: tuple[float, float], bounds: list[Bound], slack_m: float
) -> Verdict | None:
    """The denial of a leg that would carry the present altitude into a zone where it is not allowed.

    Args:
        here: where the leg begins.
        heights_m: the altitude there, and that at which a drone that climbs or sinks comes to rest.
        bounds: limits of altitude along the leg.
        slack_m: how far they may be missed.
    """
    low, high = min(heights_m), max(heights_m)
    for bound in bounds:
        if bound.shape is None or bound.shape.intersects(here):
            continue
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
"""Corrections of a correction at most: each climbs or sinks into the limits of further zones, and few zones are stacked."""


def settle_correction(call: Call, first: Verdict, judge: Callable[[Call], Verdict]) -> Verdict:
    """A correction carried on until nothing is left to correct.

    An altitude that is corrected may lie in the band of another zone, whose limits of altitude and speed were not looked
    at before. So whatever comes out is judged like a call that asks for it.

    Args:
        call: what was asked for.
        first: the correction of it.
        judge: the whole judgement of a call, in the same situation and under the same grant.

    Returns:
        A correction to arguments that are allowed as they are; or the denial of limits that cannot be met together. It is
        never a takeover: the application did not ask for what its call was corrected to.
    """
    done = [first]
    for _ in range(MAX_ROUNDS):
        verdict = judge(replace(call, args=done[-1].args))
        if verdict.action == "allow":
            return _summed_up(done, verdict)
        if verdict.action != "correct":
            return deny_conflict(done, verdict)
        done.append(verdict)
    return deny_conflict(done[:-1], done[-1])


def _summed_up(done: Sequence[Verdict], allowed: Verdict) -> Verdict:
    return replace(
        done[0],
        args=allowed.args,
        reason="; ".join(step.reason for step in done),
        policies=distinct(name for step in done for name in step.policies),
        brake_first=allowed.brake_first or any(step.brake_first for step in done),
    )


def choose_objection(problem: Verdict, asked: Verdict | None, correction: Verdict) -> Verdict:
    """The verdict on a call of which only the correction is objected to, or both it and what was asked for.

    Args:
        problem: the objection to what the call was corrected to.
        asked: the objection to what was asked for; None when there is none.
        correction: what was done to the call.
    """
    if asked is None:
        return deny_conflict((correction,), problem)
    # A drone is taken over for what its application asked for, not for what its call was corrected to.
    return asked if problem.action == "takeover" else problem


def deny_conflict(done: Sequence[Verdict], problem: Verdict) -> Verdict:
    """The denial of a call whose corrections lead to another objection."""
    names = distinct(name for step in (*done, problem) for name in step.policies)
    what = (
        f"policies {', '.join(names)}" if len(names) > 1 else f"the limits of policy {names[0]}" if names else "limits"
    )
    # The last correction is what the objection is about; those before it led there.
    reason = f"{what} cannot be met together: {done[-1].reason}, and then {problem.reason}; ask for something else"
    return deny("ConflictingLimits", reason, names)
