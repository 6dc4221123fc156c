"""Whether an instance may use a method here and now, and what privacy asks of its pictures."""

from __future__ import annotations

import math
from dataclasses import replace

import shapely

from fractus_core.policy.compiled import OPERATION_AREA, Air, CompiledGrant, Patches, Rule
from fractus_core.policy.values import Call, Situation, Verdict, deny, earliest

IN_OPERATION_AREA = frozenset({"CaptureImage", "RetrieveImage"})
"""Methods that are used only while the drone is where the application works; motion is judged by its leg."""


def judge_access(call: Call, now: Situation, grant: CompiledGrant) -> Verdict | None:
    """The refusal of a method, or None when it may be used."""
    method = call.method
    if method not in grant.methods:
        return deny(
            "MethodNotGranted",
            f"the grant of {grant.identity} does not include {method}; add it to the component's services",
        )
    denials = grant.denials.get(method)
    if denials is not None:
        seeing = method in IN_OPERATION_AREA
        forbidding = _matching(denials, now, grant, now.footprint_m if seeing else now.position_error_m)
        if forbidding:
            rule = forbidding[0]
            return deny("MethodDenied", f"policy {rule.name} denies {method} here", _names(forbidding))
    allowances = grant.allowances.get(method)
    if allowances is not None and not _allowing(allowances, now, grant):
        rules = _ordered({p.rule.name: p.rule for p in allowances.patches} | {r.name: r for r in allowances.everywhere})
        return deny("MethodNotGrantedHere", f"{method} is granted elsewhere or at other times only", _names(rules))
    if method in IN_OPERATION_AREA and grant.operation is not None:
        return _outside_operation_area(method, now, grant)
    return None


def _outside_operation_area(method: str, now: Situation, grant: CompiledGrant) -> Verdict | None:
    if now.lat is None or now.lon is None:
        return deny("PositionUnknown", f"{method} needs a known position; wait for a fix")
    here = shapely.Point(grant.frame.xy(now.lat, now.lon))
    if grant.operation is None or grant.operation.covers(here):
        return None
    away_m = grant.operation.distance(here)
    return deny(
        "OutsideOperationArea",
        f"{method} is granted inside the operation area, which is {away_m:.1f} m away",
        (OPERATION_AREA,),
    )


def _allowing(patches: Patches, now: Situation, grant: CompiledGrant) -> bool:
    """Whether some policy of an index surely holds, whichever reading of a doubtful clock is right."""
    readings = {float(now.time_s), earliest(now.time_s)}
    return all(_matching(patches, replace(now, time_s=t), grant, 0.0, certain=True) for t in readings)


def _matching(
    patches: Patches,
    now: Situation,
    grant: CompiledGrant,
    distance_m: float,
    *,
    certain: bool = False,
    from_above: bool = False,
) -> list[Rule]:
    """Policies of an index that hold at the present position.

    While the position is unknown every policy in force may hold; with `certain`, none of those with zones does. Seen
    `from_above`, a zone's upper edge hides nothing.
    """
    found = {rule.name: rule for rule in patches.everywhere if rule.in_force(now.time_s)}
    if now.lat is None or now.lon is None:
        if not certain:
            found |= {p.rule.name: p.rule for p in patches.patches if p.in_force(now.time_s)}
        return _ordered(found)
    if patches.patches:
        here = shapely.Point(grant.frame.xy(now.lat, now.lon))
        slack_m = 0.0 if certain else now.altitude_error_m
        lower = -math.inf if from_above else now.altitude_m - slack_m
        upper = now.altitude_m + slack_m
        for patch in patches.near(Air(here, distance_m, lower, upper), now, grant.flat_terrain):
            found[patch.rule.name] = patch.rule
    return _ordered(found)


def _ordered(rules: dict[str, Rule]) -> list[Rule]:
    return sorted(rules.values(), key=lambda r: (-r.spec.priority, r.name))


def _names(rules: list[Rule]) -> tuple[str, ...]:
    return tuple(rule.name for rule in rules)


def judge_privacy(now: Situation, grant: CompiledGrant) -> Verdict:
    """What privacy policies ask of a picture taken or handed out here: nothing, filters, or refusal.

    A picture shows the ground around the camera, the more the higher it is; what lies below a zone's upper edge is seen
    from above as well.
    """
    rules = _matching(grant.privacy, now, grant, now.footprint_m, from_above=True) if grant.privacy else []
    refusing = [rule for rule in rules if rule.spec.action == "refuse"]
    if refusing:
        return deny("PrivacyZone", f"policy {refusing[0].name} forbids pictures here", _names(refusing))
    if not rules:
        return Verdict("allow")
    filters = tuple(dict.fromkeys(rule.spec.action for rule in rules if rule.spec.action is not None))
    reason = f"policy {rules[0].name} asks for {', '.join(filters)} here"
    return Verdict("correct", None, "PrivacyFilter", reason, _names(rules), None, filters)
