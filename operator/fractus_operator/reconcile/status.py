"""What an application's status says: its phase, a message, and its conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.control import Outcome, OutcomeKind

from fractus_operator.cluster.pods import PodView
from fractus_operator.reconcile.conditions import ConditionUpdate

_REASONS = {
    OutcomeKind.COMPLETE: "MissionComplete",
    OutcomeKind.REVOKED: "MissionRevoked",
    OutcomeKind.FAILED: "MissionFailed",
}
_STAGES = ("Planned", "Granted", "Deployed")
_NAMED = 3
"""Instances that a message names; the others are counted."""

Phase = Literal["Pending", "Queued", "Deploying", "Running", "Completed", "Failed", "Invalid"]


@dataclass(frozen=True, slots=True)
class StatusUpdate:
    """What is to be reported of an application.

    Attributes:
        message: one sentence on what is going on.
        conditions: in their order.
    """

    phase: Phase
    message: str
    conditions: tuple[ConditionUpdate, ...]
    drone: str | None = None
    pods: str | None = None


class Blocked(Exception):
    """An application cannot go on for now.

    Attributes:
        phase: Invalid, Pending or Queued.
        stage: the condition that is not reached.
        reason: CamelCase.
        message: one sentence.
        retry_s: when to run again even if no input changes.
    """

    def __init__(self, phase: Phase, stage: str, reason: str, message: str, *, retry_s: float = 30.0) -> None:
        self.phase = phase
        self.stage = stage
        self.reason = reason
        self.message = message
        self.retry_s = retry_s
        super().__init__(message)


def deployed(plan: DeploymentPlanSpec, pods: Sequence[PodView], granted: int) -> StatusUpdate:
    """The status of an application whose children are all applied."""
    alive = [pod for pod in pods if not pod.terminating and not pod.finished]
    missing: list[str] = []
    ready = 0
    for placed in plan.placements:
        here = min(sum(pod.ready for pod in alive if pod.instance == placed.instance), placed.replicas)
        ready += here
        if here < placed.replicas:
            missing.append(placed.instance)
    wanted = sum(placed.replicas for placed in plan.placements)
    drone = plan.drone.node if plan.drone is not None else None
    if missing:
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        message = f"waiting for {', '.join(missing[:_NAMED])}{more}"
        readiness = ConditionUpdate("Ready", "False", "PodsNotReady", message, progress=True)
    else:
        message = f"all {wanted} pods are ready" + (f"; {drone} flies" if drone else "")
        readiness = ConditionUpdate("Ready", "True", "PodsReady", message)
    conditions = [
        ConditionUpdate("Planned", "True", "Planned", _plan_sentence(plan)),
        ConditionUpdate("Granted", "True", "Granted", f"{granted} instances may use services of their nodes"),
        ConditionUpdate("Deployed", "True", "Deployed", f"{len(plan.placements)} instances are deployed"),
        readiness,
    ]
    if drone is not None:
        under_way = "the mission is not over"
        conditions.append(ConditionUpdate("MissionComplete", "False", "MissionUnderway", under_way, progress=True))
    phase: Phase = "Deploying" if missing else "Running"
    return StatusUpdate(phase, message, tuple(conditions), drone=drone, pods=f"{ready}/{wanted}")


def _plan_sentence(plan: DeploymentPlanSpec) -> str:
    nodes = len({placed.node for placed in plan.placements if placed.node is not None})
    text = f"{len(plan.placements)} instances on {nodes} drone and edge nodes and in the cloud"
    return f"{plan.drone.node} flies; {text}" if plan.drone is not None else text


def finished(outcome: Outcome, present: StatusUpdate | None) -> StatusUpdate:
    """The status of an application whose mission is over."""
    complete = outcome.kind is OutcomeKind.COMPLETE
    reason, message = _REASONS[outcome.kind], outcome.reason
    conditions = (
        ConditionUpdate("Ready", "False", reason, message, progress=complete),
        ConditionUpdate("MissionComplete", "True" if complete else "False", reason, message),
    )
    phase: Phase = "Completed" if complete else "Failed"
    return StatusUpdate(phase, message, conditions, drone=present.drone if present is not None else None)


def blocked(by: Blocked, present: StatusUpdate | None) -> StatusUpdate:
    """The status of an application that cannot go on, with what still runs of it."""
    queued = by.phase == "Queued"
    conditions = (
        *(ConditionUpdate(stage, "True", stage) for stage in _STAGES[: _STAGES.index(by.stage)]),
        ConditionUpdate(by.stage, "False", by.reason, by.message, progress=queued),
        ConditionUpdate("Ready", "False", by.reason, by.message, progress=queued),
    )
    drone, pods = (present.drone, present.pods) if present is not None else (None, None)
    return StatusUpdate(by.phase, by.message, conditions, drone=drone, pods=pods)
