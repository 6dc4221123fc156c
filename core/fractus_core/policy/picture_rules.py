"""Privacy rules for pictures: no change, filters in a fixed order, or denial (thesis Table 8.1, PrivacyControl)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import shapely

from fractus_core.api.policies import FaceMethod, Fallback, FilterAction
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant, PolicyIndex, Rule, band_limits_m
from fractus_core.policy.decision_types import Filter, Situation, Verdict, deny
from fractus_core.policy.footprint import exposure_footprint

_FILTER_ORDER: tuple[FilterAction, ...] = exhaustive(
    FilterAction, ("blurFaces", "removeBackground", "blurMedian", "blurAverage", "black")
)
"""Filters from mildest to strictest, which is also the order of their application."""
_FALLBACK_ORDER: tuple[Fallback, ...] = exhaustive(Fallback, ("blurAverage", "black", "refuse"))
_WHOLE_PICTURE_FILTERS: frozenset[FilterAction] = frozenset({"blurMedian", "blurAverage", "black"})
"""Filters of the whole picture. No face is recognisable in the filtered picture."""


def judge_privacy(now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge a picture taken or returned at the present position.

    Args:
        now: Position and orientation of the camera, and its earlier states during the exposure.
        grant: Permissions and restrictions that apply.
    """
    rules = rules_in_view(grant.privacy, now, grant) if grant.privacy else []
    refusing = [rule for rule in rules if rule.spec.action == "refuse"]
    if refusing:
        return deny("PrivacyZone", f"policy {refusing[0].name} forbids pictures here", rule_names(refusing))
    if not rules:
        return Verdict("allow")
    filters = combine_filters(rule_filter(rule) for rule in rules)
    reason = f"policy {rules[0].name} requires {', '.join(f.action for f in filters)} here"
    return Verdict("correct", None, "PrivacyFilter", reason, rule_names(rules), None, filters)


def rule_filter(rule: Rule) -> Filter:
    """Return the filter that a rule requires. A rule that names no filter blacks out the picture."""
    spec = rule.spec
    return Filter(spec.filter_action or "black", spec.faces or "pixelate", spec.fallback or "blurAverage")


def combine_filters(filters: Iterable[Filter]) -> tuple[Filter, ...]:
    """Return the filters that satisfy all given filters, in the order of their application.

    Black satisfies everything. A blur of the whole picture hides its faces as well. Of two ways to hide faces the
    stricter one is used: pixelation instead of a soft blur, and the stricter fallback.
    """
    required: dict[FilterAction, list[Filter]] = {}
    for item in filters:
        required.setdefault(item.action, []).append(item)
    if "black" in required:
        return (Filter("black"),)
    if required.keys() & _WHOLE_PICTURE_FILTERS:
        required.pop("blurFaces", None)
    return tuple(_strictest(required[action]) for action in _FILTER_ORDER if action in required)


def _strictest(alike: list[Filter]) -> Filter:
    method: FaceMethod = "gaussian" if all(item.faces == "gaussian" for item in alike) else "pixelate"
    return Filter(alike[0].action, method, max((item.fallback for item in alike), key=_FALLBACK_ORDER.index))


def remaining_filters(required: Iterable[Filter], applied: Iterable[Filter]) -> tuple[Filter, ...]:
    """Return the filters that must still be applied to an already filtered picture.

    Faces hidden by a milder method than required must be hidden again.
    """
    applied_filters = tuple(applied)
    if any(item.action == "black" for item in applied_filters):
        return ()
    return tuple(item for item in combine_filters(required) if not _satisfied(item, applied_filters))


def _satisfied(required: Filter, applied_filters: Sequence[Filter]) -> bool:
    if required.action != "blurFaces":
        return any(item.action == required.action for item in applied_filters)
    if any(item.action in _WHOLE_PICTURE_FILTERS for item in applied_filters):
        return True
    return any(
        item.action == "blurFaces" and (item.faces == "pixelate" or required.faces == "gaussian")
        for item in applied_filters
    )


def rules_in_view(index: PolicyIndex, now: Situation, grant: CompiledGrant) -> list[Rule]:
    """Return the policies of an index that apply at the camera's position, or whose zones a picture may show.

    While the position is unknown, the result contains every policy in force.
    """
    rules = {rule.name: rule for rule in index.everywhere if rule.in_force(now.time_s)}
    view = exposure_footprint([*now.exposure, now], grant.frame)
    if now.lat is None or now.lon is None or view is None:
        return by_priority(rules | {p.rule.name: p.rule for p in index.zones if p.in_force(now.time_s)})
    if not index.zones:
        return by_priority(rules)
    position = shapely.Point(grant.frame.xy(now.lat, now.lon))
    lower_m = now.altitude_m - now.altitude_error_m
    upper_m = now.altitude_m + now.altitude_error_m
    for zone in index.near(AirVolume(position, now.position_error_m, lower_m, upper_m), now, grant.flat_terrain):
        rules[zone.rule.name] = zone.rule
    air = AirVolume(view.sight, view.margin_m, -math.inf, view.upper_m)
    for zone in index.near(air, now, grant.flat_terrain):
        if zone.rule.name not in rules and view.shows(
            zone.shape, *band_limits_m(zone.band, now.home, grant.flat_terrain)
        ):
            rules[zone.rule.name] = zone.rule
    return by_priority(rules)


def by_priority(rules: dict[str, Rule]) -> list[Rule]:
    """Return policies by falling priority, then by name."""
    return sorted(rules.values(), key=lambda r: (-r.spec.priority, r.name))


def rule_names(rules: Iterable[Rule]) -> tuple[str, ...]:
    """Return the names of policies."""
    return tuple(rule.name for rule in rules)
