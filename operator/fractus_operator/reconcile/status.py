"""What an application's status says: its phase, a message, and its conditions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

from fractus_core.api import Condition, Drone
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.control import Outcome, OutcomeKind

from fractus_operator.cluster.pods import PodView
from fractus_operator.reconcile.conditions import ConditionUpdate
from fractus_operator.reconcile.flight_status import Flight, FlightPhase, mission_condition, pilot_of

_REASONS = {
    OutcomeKind.COMPLETE: "MissionComplete",
    OutcomeKind.REVOKED: "MissionRevoked",
    OutcomeKind.FAILED: "MissionFailed",
}
STAGES = ("Planned", "Granted", "Deployed")
"""Conditions that an application reaches one after the other."""
_NAMED = 3
"""Instances that a message names; the others are counted."""

Phase = Literal["Pending", "Queued", "Deploying", "Running", FlightPhase, "Completed", "Failed", "Invalid"]


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
    controller: str | None = None


class Blocked(Exception):
    """An application cannot go on for now.

    Attributes:
        phase: Invalid, Pending or Queued.
        stage: the condition that is not reached.
        reason: CamelCase.
        message: one sentence.
        retry_s: when to run again even if no input changes.
        full: nodes that would do, were there room on them.
    """

    def __init__(
        self,
        phase: Phase,
        stage: str,
        reason: str,
        message: str,
        *,
        retry_s: float = 30.0,
        full: Collection[str] = frozenset(),
    ) -> None:
        self.phase = phase
        self.stage = stage
        self.reason = reason
        self.message = message
        self.retry_s = retry_s
        self.full = full
        super().__init__(message)


def deployed(
    plan: DeploymentPlanSpec,
    pods: Sequence[PodView],
    granted: int,
    flown: Flight | None = None,
    refused: Mapping[str, str] = MappingProxyType({}),
) -> StatusUpdate:
    """The status of an application whose children are all applied.

    Args:
        plan: The plan in force.
        pods: Its pods as they are.
        granted: How many instances have Grants.
        flown: How far the flight is, where the plan has a drone.
        refused: Why pods of instances cannot be made, where they cannot.
    """
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
        failed = _failures(pod for pod in alive if pod.instance in missing and not pod.ready)
        not_made = _refusals({name: refused[name] for name in missing if name in refused})
        message += "".join(f"; {why}" for why in (not_made, failed) if why)
        reason = "PodsRefused" if not_made else "ComponentFailed" if failed else "PodsNotReady"
        readiness = ConditionUpdate("Ready", "False", reason, message, progress=not failed and not not_made)
    else:
        message = f"all {wanted} pods are ready"
        readiness = ConditionUpdate("Ready", "True", "PodsReady", message)
    phase: Phase = "Deploying" if missing else "Running"
    if flown is not None:
        message = f"{message}; {flown.does}"
        # What a drone in the air does is more urgent than a pod that starts again.
        phase = phase if missing and flown.phase in {"Waiting", "Landed"} else flown.phase
        if flown.phase == "Unknown":
            readiness = ConditionUpdate("Ready", "Unknown", "TelemetryLost", flown.does)
    conditions = [
        ConditionUpdate("Planned", "True", "Planned", _plan_sentence(plan)),
        ConditionUpdate("Granted", "True", "Granted", f"{granted} instances may use services of their nodes"),
        ConditionUpdate("Deployed", "True", "Deployed", f"{len(plan.placements)} instances are deployed"),
        readiness,
    ]
    if plan.drone is not None and plan.drone.policy_conflict is not None:
        conditions.append(_policy_conflict(plan.drone.policy_conflict))
    if flown is not None:
        conditions.append(mission_condition(flown))
    controller = flown.controller if flown is not None else None
    return StatusUpdate(phase, message, tuple(conditions), drone, f"{ready}/{wanted}", controller)


def in_queue(plan: DeploymentPlanSpec, before: int) -> StatusUpdate:
    """The status of an application that is planned, while the operator rolls out many others."""
    message = f"{_plan_sentence(plan)}; {before} other applications are rolled out at the moment"
    return StatusUpdate(
        "Pending", message, (ConditionUpdate("Ready", "False", "OperatorBusy", message, progress=True),)
    )


def stalled(reported: Mapping[str, Any], reason: str, error: str) -> StatusUpdate:
    """The status of an application that the API server takes no change for: as it was reported, and that.

    Args:
        reported: What was last said of it; empty where nothing was.
        reason: CamelCase.
        error: What the API server answered.
    """
    message = f"the API server refuses, or does not answer, what is to be made; it is tried again: {error}"
    known = (Condition.model_validate(c) for c in reported.get("conditions") or ())
    # What it was waiting for may be there by now; what it had reached, it has.
    kept = [
        ConditionUpdate(c.type, c.status, c.reason, c.message)
        for c in known
        if c.type != "Deployed" and (c.status != "False" or c.type not in {*STAGES, "Ready"})
    ]
    failing = [ConditionUpdate("Deployed", "False", reason, message)]
    if all(each.type != "Ready" for each in kept):
        failing.append(ConditionUpdate("Ready", "False", reason, message))
    present = {name: reported.get(name) for name in ("drone", "pods", "controller")}
    phase: Phase = "Pending" if reported.get("phase") in {None, "Queued", "Invalid"} else reported["phase"]
    return StatusUpdate(phase, message, (*kept, *failing), **present)


def waiting(present: StatusUpdate, drone: str) -> StatusUpdate:
    """The status of an application whose changed manifest waits until its drone has landed."""
    why = f"the changed manifest is carried out once {drone} has landed; spec.updatePolicy: Immediate does not wait"
    update = ConditionUpdate("Updated", "False", "WaitsForLanding", why, progress=True)
    return replace(present, message=f"{present.message}; {why}", conditions=(*present.conditions, update))


def _policy_conflict(why: str) -> ConditionUpdate:
    return ConditionUpdate("PolicyConflict", "True", "PolicyConflict", why, adverse=True)


def _plan_sentence(plan: DeploymentPlanSpec) -> str:
    nodes = len({placed.node for placed in plan.placements if placed.node is not None})
    text = f"{len(plan.placements)} instances on {nodes} drone and edge nodes and in the cloud"
    return f"{plan.drone.node} flies; {text}" if plan.drone is not None else text


def finished(outcome: Outcome, name: str | None, drone: Drone | None, pods: Sequence[PodView] = ()) -> StatusUpdate:
    """The status of an application whose mission is over, also while its drone comes home.

    Args:
        outcome: How it ended.
        name: Of its drone.
        drone: As it is now.
        pods: Its pods: where the mission did not complete, how they failed is kept, for they are removed now.
    """
    complete = outcome.kind is OutcomeKind.COMPLETE
    reason, message = _REASONS[outcome.kind], outcome.reason
    failed = "" if complete else _failures(pods)
    message += f"; {failed}" if failed else ""
    conditions = (
        ConditionUpdate("Ready", "False", reason, message, progress=complete),
        ConditionUpdate("MissionComplete", "True" if complete else "False", reason, message),
    )
    return _over(conditions, name, drone)


def _failures(pods: Iterable[PodView]) -> str:
    return "; ".join(sorted(f"{pod.instance} failed with {pod.failure}" for pod in pods if pod.failure)[:_NAMED])


def _refusals(refused: Mapping[str, str]) -> str:
    return "; ".join(f"no pod of {name} can be made: {why}" for name, why in sorted(refused.items())[:_NAMED])


def still_over(reported: Mapping[str, Any], drone: Drone | None) -> StatusUpdate:
    """The status of an application whose mission was reported to be over: its drone may have come home since."""
    kept = (Condition.model_validate(c) for c in reported.get("conditions") or ())
    conditions = tuple(ConditionUpdate(c.type, c.status, c.reason, c.message) for c in kept)
    return _over(conditions, reported.get("drone"), drone)


def _over(conditions: tuple[ConditionUpdate, ...], name: str | None, drone: Drone | None) -> StatusUpdate:
    mission = next(c for c in conditions if c.type == "MissionComplete")
    phase: Phase = "Completed" if mission.status == "True" else "Failed"
    message, controller = mission.message, None
    if drone is not None and drone.status is not None and drone.in_air:
        phase = "Returning"
        known = drone.status.flight_state != "unknown"
        message += (
            f"; {name} is on its way home" if known else f"; {name} was on its way home when it was last heard of"
        )
        controller = pilot_of(drone.status.controller)
    return StatusUpdate(phase, message, conditions, drone=name, controller=controller)


def blocked(by: Blocked, present: StatusUpdate | None) -> StatusUpdate:
    """The status of an application that cannot go on, with what still runs of it."""
    queued = by.phase == "Queued"
    conditions = (
        *(ConditionUpdate(stage, "True", stage) for stage in STAGES[: STAGES.index(by.stage)]),
        ConditionUpdate(by.stage, "False", by.reason, by.message, progress=queued),
        ConditionUpdate("Ready", "False", by.reason, by.message, progress=queued),
    )
    if by.reason == "PolicyConflict":
        conditions = (*conditions, _policy_conflict(by.message))
    kept = (present.drone, present.pods, present.controller) if present is not None else ()
    return StatusUpdate(by.phase, by.message, conditions, *kept)
