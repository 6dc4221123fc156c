"""Whether an instance may use a method here and now."""

from __future__ import annotations

from dataclasses import replace

import shapely

from fractus_core.policy.compiled import OPERATION_AREA, Air, CompiledGrant, PolicyIndex, Rule
from fractus_core.policy.privacy import names, ordered, seen
from fractus_core.policy.values import Call, Situation, Verdict, deny, earliest, metres

SEEING = frozenset({"CaptureImage", "RetrieveImage"})
"""Methods that are denied by what a picture may show, and used only while the drone is where the application works; motion
is judged by its leg."""


def judge_access(call: Call, now: Situation, grant: CompiledGrant) -> Verdict | None:
    """The refusal of a method, or None when it may be used."""
    method = call.method
    if method not in grant.methods:
        return deny(
            "MethodNotGranted",
            f"the grant of {grant.identity} does not include {method}; add it to the component's services",
        )
    denied = judge_denials(method, now, grant)
    if denied is not None:
        return denied
    allowances = grant.allowances.get(method)
    if allowances is not None and not _allowing(allowances, now, grant):
        rules = ordered({p.rule.name: p.rule for p in allowances.zones} | {r.name: r for r in allowances.everywhere})
        return deny("MethodNotGrantedHere", f"{method} is granted elsewhere or at other times only", names(rules))
    if method in SEEING and grant.operation is not None:
        return _outside_operation_area(method, now, grant)
    return None


def judge_denials(method: str, now: Situation, grant: CompiledGrant) -> Verdict | None:
    """The denial of a method where the drone is; of one of `SEEING`, by what a picture from there may show."""
    denials = grant.denials.get(method)
    if denials is None:
        return None
    forbidding = seen(denials, now, grant) if method in SEEING else _matching(denials, now, grant, now.position_error_m)
    if not forbidding:
        return None
    return deny("MethodDenied", f"policy {forbidding[0].name} denies {method} here", names(forbidding))


def _outside_operation_area(method: str, now: Situation, grant: CompiledGrant) -> Verdict | None:
    if now.lat is None or now.lon is None:
        return deny("PositionUnknown", f"{method} needs a known position; wait for a fix")
    here = shapely.points(grant.frame.xy(now.lat, now.lon))
    if grant.operation is None or grant.operation.covers(here):
        return None
    away_m = grant.operation.distance(here)
    return deny(
        "OutsideOperationArea",
        f"{method} is granted inside the operation area, which is {metres(away_m)} away",
        (OPERATION_AREA,),
    )


def _allowing(index: PolicyIndex, now: Situation, grant: CompiledGrant) -> bool:
    """Whether some policy of an index surely holds, whichever reading of a doubtful clock is right."""
    readings = {float(now.time_s), earliest(now.time_s)}
    return all(_matching(index, replace(now, time_s=t), grant, 0.0, certain=True) for t in readings)


def _matching(
    index: PolicyIndex,
    now: Situation,
    grant: CompiledGrant,
    distance_m: float,
    *,
    certain: bool = False,
) -> list[Rule]:
    """Policies of an index that hold at the present position.

    While the position is unknown every policy in force may hold; with `certain`, none of those with zones does.
    """
    found = {rule.name: rule for rule in index.everywhere if rule.in_force(now.time_s)}
    if now.lat is None or now.lon is None:
        if not certain:
            found |= {p.rule.name: p.rule for p in index.zones if p.in_force(now.time_s)}
        return ordered(found)
    if index.zones:
        here = shapely.points(grant.frame.xy(now.lat, now.lon))
        slack_m = 0.0 if certain else now.altitude_error_m
        air = Air(here, distance_m, now.altitude_m - slack_m, now.altitude_m + slack_m)
        for zone in index.near(air, now, grant.flat_terrain):
            found[zone.rule.name] = zone.rule
    return ordered(found)
