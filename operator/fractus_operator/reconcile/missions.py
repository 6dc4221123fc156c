"""Where an application stands: pure judgements over its plan, pods and grants."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal

from fractus_core.api import Application, Grant
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.inventory import Inventory

from fractus_operator.cluster.pods import PodView
from fractus_operator.reconcile.conditions import Fact

UNSCHEDULABLE_GRACE = timedelta(seconds=5)
"""How long a pod may wait for its planned node before the node counts as unusable."""

_STAGES = ("Planned", "Granted", "Deployed")

Phase = Literal["Pending", "Queued", "Deploying", "Running", "Completed", "Failed", "Invalid"]


@dataclass(frozen=True, slots=True)
class Standing:
    """What is to be reported of an application.

    Attributes:
        message: one sentence on what is going on.
        facts: for its conditions, in their order.
    """

    phase: Phase
    message: str
    facts: tuple[Fact, ...]
    drone: str | None = None
    pods: str | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a mission ended."""

    complete: bool
    reason: str
    message: str


class Hindered(Exception):
    """An application cannot go on for now.

    Attributes:
        phase: Invalid, Pending or Queued.
        condition: the stage that is not reached.
        reason: CamelCase.
        message: one sentence.
        again_s: when to look again even if nothing was seen to change.
    """

    def __init__(self, phase: Phase, condition: str, reason: str, message: str, *, again_s: float = 30.0) -> None:
        self.phase = phase
        self.condition = condition
        self.reason = reason
        self.message = message
        self.again_s = again_s
        super().__init__(message)


def mission_outcome(uid: str | None, grants: Iterable[Grant]) -> Outcome | None:
    """How the mission of the application with this uid ended, as the node of its driver, or of whom it is flown for, reports; None while it goes on."""
    for grant in grants:
        spec, status = grant.spec, grant.status
        leads = spec.class_ == "driver" or spec.tour
        if not leads or spec.application.uid != uid or status is None:
            continue
        if status.phase == "Complete":
            return Outcome(True, "MissionComplete", status.message or f"{spec.component} finished its mission")
        if status.phase == "Failed":
            return Outcome(False, "MissionFailed", status.message or f"the mission of {spec.component} failed")
        if status.phase == "Revoked":
            return Outcome(False, "MissionRevoked", status.message or f"the control of {spec.component} was revoked")
    return None


def replan_reason(
    application: Application,
    plan: DeploymentPlanSpec | None,
    inventory: Inventory,
    stuck: Mapping[str, str],
    aloft: str | None = None,
) -> str | None:
    """Why a (new) plan is needed, as a CamelCase reason; None while the present one stands.

    A node that is out of reach is no reason: its pods run on, and it comes back. One that is cordoned is.

    Args:
        application: As submitted.
        plan: The present plan.
        inventory: As of now.
        stuck: Nodes on which the scheduler refuses a pod of the application.
        aloft: The plan's drone while it flies: whatever becomes of its node, what runs there stays until it is down.
    """
    if plan is None:
        return "NoPlanYet"
    if plan.application_generation != application.metadata.generation:
        return "SpecChanged"
    for placed in plan.placements:
        if placed.node is None or placed.node == aloft:
            continue
        described = placed.node in inventory.drones or placed.node in inventory.edge_nodes
        if placed.node not in inventory.hosts or not described:
            return "NodeGone"
        if placed.node in stuck:
            return "NodeUnusable"
    used = {placed.node for placed in plan.placements} - {None, aloft}
    if any(not inventory.hosts[node].schedulable for node in used if node is not None):
        return "NodeCordoned"
    return None


def stuck_nodes(
    plan: DeploymentPlanSpec | None, pods: Iterable[PodView], now: datetime
) -> tuple[dict[str, str], float | None]:
    """Planned nodes which the scheduler refuses for a pod of the plan.

    Returns:
        What the scheduler says, by node; and in how many seconds to look again, if a pod may become stuck.
    """
    nodes = {placed.instance: placed.node for placed in plan.placements} if plan is not None else {}
    stuck: dict[str, str] = {}
    wait_s: float | None = None
    pods = tuple(pods)
    leaving = {pod.node for pod in pods if pod.terminating}
    for pod in pods:
        node = nodes.get(pod.instance or "")
        if pod.unschedulable_since is None or node is None or pod.terminating:
            continue
        # Anybody in the namespace may make a pod with our labels.
        if pod.deployment != pod.instance:
            continue
        left = (pod.unschedulable_since + UNSCHEDULABLE_GRACE - now).total_seconds()
        if left <= 0 and node in leaving:
            # What its predecessor has is free when that has ended.
            wait_s = min(1.0, wait_s or 1.0)
        elif left <= 0:
            stuck[node] = f"the scheduler cannot place {pod.instance} on {node}: {pod.unschedulable_message}"
        else:
            wait_s = min(left, wait_s or left)
    return stuck, wait_s


def deployed_standing(plan: DeploymentPlanSpec, pods: Sequence[PodView], granted: int) -> Standing:
    """The standing of an application whose children are all applied."""
    alive = [pod for pod in pods if not pod.terminating and not pod.finished]
    wanted = sum(placed.replicas for placed in plan.placements)
    missing: list[str] = []
    ready = 0
    for placed in plan.placements:
        here = min(sum(pod.ready for pod in alive if pod.instance == placed.instance), placed.replicas)
        ready += here
        if here < placed.replicas:
            missing.append(placed.instance)
    drone = plan.drone.node if plan.drone is not None else None
    nodes = len({placed.node for placed in plan.placements if placed.node is not None})
    planned = Fact("Planned", "True", "Planned", _plan_sentence(plan, nodes))
    grants = Fact("Granted", "True", "Granted", f"{granted} instances may use services of their nodes")
    deployed = Fact("Deployed", "True", "Deployed", f"{len(plan.placements)} instances are deployed")
    if missing:
        message = f"waiting for {', '.join(missing[:3])}" + (
            f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        )
        condition = Fact("Ready", "False", "PodsNotReady", message, progress=True)
    else:
        message = f"all {wanted} pods are ready" + (f"; {drone} flies" if drone else "")
        condition = Fact("Ready", "True", "PodsReady", message)
    going = Fact("MissionComplete", "False", "MissionUnderway", "the mission is not over", progress=True)
    facts = (planned, grants, deployed, condition, *((going,) if drone else ()))
    return Standing("Deploying" if missing else "Running", message, facts, drone=drone, pods=f"{ready}/{wanted}")


def _plan_sentence(plan: DeploymentPlanSpec, nodes: int) -> str:
    text = f"{len(plan.placements)} instances on {nodes} drone and edge nodes and in the cloud"
    return f"{plan.drone.node} flies; {text}" if plan.drone is not None else text


def finished_standing(outcome: Outcome, present: Standing | None) -> Standing:
    """The standing of an application whose mission is over."""
    facts = (
        Fact("Ready", "False", outcome.reason, outcome.message, progress=outcome.complete),
        Fact("MissionComplete", "True" if outcome.complete else "False", outcome.reason, outcome.message),
    )
    drone = present.drone if present is not None else None
    return Standing("Completed" if outcome.complete else "Failed", outcome.message, facts, drone=drone)


def hindered_standing(hindrance: Hindered, present: Standing | None) -> Standing:
    """The standing of an application that cannot go on, with what still runs of it."""
    reason, message = hindrance.reason, hindrance.message
    queued = hindrance.phase == "Queued"
    facts = (
        *(Fact(stage, "True", stage) for stage in _STAGES[: _STAGES.index(hindrance.condition)]),
        Fact(hindrance.condition, "False", reason, message, progress=queued),
        Fact("Ready", "False", reason, message, progress=queued),
    )
    return Standing(
        hindrance.phase,
        message,
        facts,
        drone=present.drone if present is not None else None,
        pods=present.pods if present is not None else None,
    )
