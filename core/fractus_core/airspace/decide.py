"""Decision on a new or changed flight plan among the other flight plans.

The rules are those of ASTM F3548 as the reference implementation of InterUSS applies them:

1. A plan that becomes Nonconforming or Contingent is not refused, because its drone is in the air.
2. The earlier version of the plan itself is ignored.
3. A plan may overlap plans of lower priority.
4. A plan must not overlap plans of equal or higher priority.
5. A change of an Activated plan may keep an overlap with another Activated plan that existed before the change.
6. Off-nominal volumes of other plans count like their other volumes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from fractus_core.airspace.conflicts import Airspace, OperationalIntent, first_overlap
from fractus_core.airspace.lifecycle import NOMINAL, OFF_NOMINAL, RESERVING, transition_problem
from fractus_core.airspace.volumes import utc

MAX_HORIZON_S = 30 * 86_400.0
"""Maximum time from the decision until the start of a plan."""

MAX_VERTICES = 10_000
"""Maximum number of corners of all volumes of a plan."""

MAX_EXPLAINED = 20
"""Maximum number of overlaps that a decision explains with place and time."""

MAX_LISTED = 100
"""Maximum number of overlaps with the same reason that a decision lists, so that it fits into a Kubernetes object."""

Reason = Literal[
    "TransitionNotPermitted",
    "VolumesMissing",
    "VolumesOffNominal",
    "TooManyVertices",
    "WindowOver",
    "WindowTooFar",
    "WindowNotActive",
    "Conflict",
    "OverlapsLowerPriority",
    "OverlapsHigherPriority",
    "OverlapsEqualPriority",
    "OverlapKept",
]


@dataclass(frozen=True, slots=True)
class Finding:
    """A reason of a decision.

    Attributes:
        reason: Machine-readable CamelCase reason.
        message: Human-readable explanation in one sentence.
        other: Name of the other plan; empty if the finding is about the plan itself.
    """

    reason: Reason
    message: str
    other: str = ""


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision on a flight plan.

    Attributes:
        refusals: Reasons why the plan is refused, empty if it is accepted. A refused change leaves the earlier version in
            force.
        advisories: Overlaps that the rules permit.
    """

    refusals: tuple[Finding, ...] = ()
    advisories: tuple[Finding, ...] = ()

    @property
    def accepted(self) -> bool:
        """True if the plan may have the requested state and volumes."""
        return not self.refusals


def decide(intent: OperationalIntent, before: OperationalIntent | None, airspace: Airspace, now_s: float) -> Decision:
    """Decide on a plan with a new state or new volumes.

    The caller must store an accepted plan in the airspace before its next decision. Otherwise two plans that overlap may
    both be accepted.

    Args:
        intent: The plan with the requested state and volumes.
        before: The present version of the plan; None: the plan is new, and its state is Draft.
        airspace: All other plans. It may contain the present version, which is ignored.
        now_s: Time in seconds since 1970 UTC.
    """
    problem = transition_problem(before.state if before is not None else "Draft", intent.state)
    if problem:
        return Decision((Finding("TransitionNotPermitted", problem),))
    if intent.state not in RESERVING:
        return Decision()
    finding = _volumes_problem(intent) or _limits_problem(intent, now_s)
    if finding is not None:
        return Decision((finding,))
    if intent.state in OFF_NOMINAL:
        return Decision(advisories=standing_overlaps(intent, airspace))
    others = airspace.overlapping(intent.volumes, without=intent.name)
    kept = [other for other in others if other.priority >= intent.priority and _kept(before, other)]
    conflicts = [other for other in others if other.priority >= intent.priority and other not in kept]
    if conflicts:
        return Decision(_findings(intent, conflicts, "Conflict"))
    lower = [other for other in others if other.priority < intent.priority]
    return Decision(
        advisories=_findings(intent, kept, "OverlapKept") + _findings(intent, lower, "OverlapsLowerPriority")
    )


def standing_overlaps(intent: OperationalIntent, airspace: Airspace) -> tuple[Finding, ...]:
    """Return the overlaps of a plan that is in force, for example with a plan that became Nonconforming.

    Nothing is refused because of these overlaps. The users of both plans should know them.
    """
    findings: tuple[Finding, ...] = ()
    others = airspace.overlapping(intent.all_volumes, without=intent.name)
    findings += _findings(intent, [o for o in others if o.priority > intent.priority], "OverlapsHigherPriority")
    findings += _findings(intent, [o for o in others if o.priority == intent.priority], "OverlapsEqualPriority")
    findings += _findings(intent, [o for o in others if o.priority < intent.priority], "OverlapsLowerPriority")
    return findings


def _kept(before: OperationalIntent | None, other: OperationalIntent) -> bool:
    """Return True if the present version of a plan already overlaps another plan, and both are Activated."""
    if before is None or before.state != "Activated" or other.state != "Activated":
        return False
    return first_overlap(before.volumes, other.all_volumes) is not None


def _volumes_problem(intent: OperationalIntent) -> Finding | None:
    if intent.state in NOMINAL and intent.off_nominal:
        return Finding("VolumesOffNominal", f"a plan that is {intent.state} has no off-nominal volumes; remove them")
    if not intent.all_volumes or (intent.state in NOMINAL and not intent.volumes):
        return Finding("VolumesMissing", "the plan has no volumes, so nothing can be reserved; give a path or a region")
    return None


def _limits_problem(intent: OperationalIntent, now_s: float) -> Finding | None:
    if intent.state not in NOMINAL:
        return None
    vertices = sum(volume.vertices for volume in intent.volumes)
    if vertices > MAX_VERTICES:
        message = f"the volumes have {vertices} corners, more than {MAX_VERTICES}; use fewer waypoints"
        return Finding("TooManyVertices", message)
    begin_s = min(volume.begin_s for volume in intent.volumes)
    end_s = max(volume.end_s for volume in intent.volumes)
    # Negated comparisons, so that an unknown time (NaN) refuses the plan.
    if not now_s <= end_s:
        return Finding("WindowOver", f"the window of the plan ended at {utc(end_s)}; choose a later time")
    if intent.state == "Accepted" and not begin_s - now_s <= MAX_HORIZON_S:
        days = MAX_HORIZON_S / 86_400
        message = f"the plan starts at {utc(begin_s)}, more than {days:.0f} days from now; submit it later"
        return Finding("WindowTooFar", message)
    active = any(volume.begin_s <= now_s <= volume.end_s for volume in intent.volumes)
    if intent.state == "Activated" and not active:
        later_s = min(volume.begin_s for volume in intent.volumes if volume.begin_s > now_s)
        message = f"no volume of the plan is active before {utc(later_s)}; activate the plan then"
        return Finding("WindowNotActive", message)
    return None


def _findings(intent: OperationalIntent, others: Sequence[OperationalIntent], reason: Reason) -> tuple[Finding, ...]:
    return tuple(
        Finding(reason, _sentence(intent, other, reason, explained=i < MAX_EXPLAINED), other.name)
        for i, other in enumerate(others[:MAX_LISTED])
    )


def _sentence(intent: OperationalIntent, other: OperationalIntent, reason: Reason, *, explained: bool) -> str:
    text = f"the plan overlaps flight plan {other.name} ({other.state}, priority {other.priority})"
    part = first_overlap(intent.all_volumes, other.all_volumes) if explained else None
    if part is not None:
        text += f" {part}"
    match reason:
        case "Conflict":
            return f"{text}, and its priority {intent.priority} is not higher; choose another time, area or altitude"
        case "OverlapKept":
            return f"{text}, as before this change"
        case _:
            return f"{text}, and its own priority is {intent.priority}"
