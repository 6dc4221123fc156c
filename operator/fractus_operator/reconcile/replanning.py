"""Which plan an application is deployed by: the one in force while it fits, else a new one. Pure decisions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.planner import Infeasible, plan
from fractus_core.planning.scale_up import full_nodes, next_free_node

from fractus_operator.cluster.pods import PodView

UNSCHEDULABLE_GRACE = timedelta(seconds=5)
"""How long a pod may wait for its planned node before the node counts as unusable."""

_OPTIONAL = frozenset({"NodeCordoned", "NodesAppeared"})
"""Reasons for a new plan that can be ignored: what runs goes on where there is no other plan."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The plan to deploy.

    Attributes:
        plan: the one in force, or a new one.
        reason: why there is a new one; None while the one in force is kept.
        fits: whether the one in force is kept because it fits, rather than for want of another.
        full: nodes on which the plan would have more instances, were there room on them.
    """

    plan: DeploymentPlanSpec
    reason: str | None = None
    fits: bool = False
    full: frozenset[str] = frozenset()

    @property
    def suits(self) -> bool:
        """Whether the plan is what the application asks for: of others it waits for nothing but room on the nodes that are full."""
        return self.fits or self.reason is not None


def choose_plan(
    application: Application,
    previous: DeploymentPlanSpec | None,
    inventory: Inventory,
    settings: Settings,
    *,
    stuck: Mapping[str, str],
    in_flight: str | None,
) -> Choice:
    """The plan in force while it fits, else a new one that moves as little as it can.

    Args:
        application: As submitted.
        previous: The plan in force, with what the policies of now say of its way.
        inventory: As of now.
        settings: Of the planning; with the time, and the nodes that are excluded.
        stuck: Nodes on which the scheduler refuses a pod of the application.
        in_flight: The drone of the plan in force while it flies.

    Raises:
        Infeasible: there is no plan, and the one in force does not fit either.
        InvalidObject: the application contradicts itself.
    """
    choice = _choose(application, previous, inventory, settings, stuck=stuck, in_flight=in_flight)
    return replace(choice, full=full_nodes(application, inventory, settings, choice.plan))


def _choose(
    application: Application,
    previous: DeploymentPlanSpec | None,
    inventory: Inventory,
    settings: Settings,
    *,
    stuck: Mapping[str, str],
    in_flight: str | None,
) -> Choice:
    if in_flight is not None:
        # What flies is judged call by call; no plan takes its drone away.
        settings = replace(settings, policy_conflicts="warn")
    reason = replan_reason(application, previous, inventory, stuck, in_flight)
    if reason is None and settings.policy_conflicts == "forbid" and _conflict(previous) is not None:
        reason = "PolicyConflict"
    if previous is not None and reason is None:
        if next_free_node(application, inventory, settings, previous) is None:
            return Choice(previous, fits=True)
        reason = "NodesAppeared"
    try:
        decided = plan(application, inventory, settings, previous)
    except Infeasible:
        if previous is None or reason not in _OPTIONAL:
            raise
        return Choice(previous)
    flies = decided.drone.node if decided.drone is not None else None
    if previous is not None and in_flight is not None and reason != "SpecChanged" and flies != in_flight:
        # A problem on another node is no reason to leave a drone that flies.
        return Choice(previous)
    if previous is not None and in_flight is not None:
        decided = _with_names_of(previous, decided)
    return Choice(decided, reason)


def mission_changed(application: Application | None, plan: DeploymentPlanSpec | None) -> bool:
    """Whether an application says something else of its mission than what was planned; one that cannot be read does."""
    if application is None or plan is None:
        return True
    if plan.application_generation == application.metadata.generation:
        return False
    return plan.application_digest is None or plan.application_digest != application.spec.mission_digest


def flown_generation(application: Application | None, plan: DeploymentPlanSpec | None) -> int | None:
    """The generation whose mission a plan is of, where the present one is another mission, which still waits; else None."""
    return plan.application_generation if plan is not None and mission_changed(application, plan) else None


def present_plan(application: Application, plan: DeploymentPlanSpec | None) -> DeploymentPlanSpec | None:
    """A plan as that of the application's present generation, if that says the same of its mission; else as it is."""
    return plan if plan is None or mission_changed(application, plan) else of_generation(application, plan)


def of_generation(application: Application, plan: DeploymentPlanSpec) -> DeploymentPlanSpec:
    """A plan as that of an application's present generation, which is known to say the same of the mission.

    Other releases tell missions apart by the generation alone, or hash them otherwise: what they find is kept up to date.
    """
    said = {
        "application_generation": application.metadata.generation,
        "application_digest": application.spec.mission_digest,
    }
    return plan if plan.model_dump(include=set(said)) == said else plan.model_copy(update=said)


def waits_for_landing(application: Application, plan: DeploymentPlanSpec, in_flight: str | None) -> bool:
    """Whether a changed manifest is not carried out yet, because it would change what flies.

    Args:
        application: As submitted.
        plan: In force.
        in_flight: Its drone while it flies.
    """
    changed = mission_changed(application, plan)
    return changed and in_flight is not None and application.spec.update_policy == "OnGround"


def _with_names_of(previous: DeploymentPlanSpec, decided: DeploymentPlanSpec) -> DeploymentPlanSpec:
    """A plan whose instances that stay keep their names, also where another release named them: a new name restarts them."""
    names = {(p.component, p.node, p.location): p.instance for p in previous.placements}
    kept = tuple(
        p.model_copy(update={"instance": names.get((p.component, p.node, p.location), p.instance)})
        for p in decided.placements
    )
    distinct = len({p.instance for p in kept}) == len(kept)
    return decided.model_copy(update={"placements": kept}) if distinct else decided


def _conflict(plan: DeploymentPlanSpec | None) -> str | None:
    return plan.drone.policy_conflict if plan is not None and plan.drone is not None else None


def replan_reason(
    application: Application,
    plan: DeploymentPlanSpec | None,
    inventory: Inventory,
    stuck: Mapping[str, str],
    in_flight: str | None = None,
) -> str | None:
    """Why a (new) plan is needed, as a CamelCase reason; None while the present one stands.

    A node that is out of reach is no reason: its pods run on, and it comes back. One that is cordoned is.

    Args:
        application: As submitted.
        plan: The present plan.
        inventory: As of now.
        stuck: Nodes on which the scheduler refuses a pod of the application.
        in_flight: The plan's drone while it flies: whatever becomes of its node, what runs there stays until it has landed.
    """
    if plan is None:
        return "NoPlanYet"
    if mission_changed(application, plan):
        return "SpecChanged"
    for placed in plan.placements:
        if placed.node is None or placed.node == in_flight:
            continue
        described = placed.node in inventory.drones or placed.node in inventory.edge_nodes
        if placed.node not in inventory.hosts or not described:
            return "NodeGone"
        if placed.node in stuck:
            return "NodeUnusable"
    used = {placed.node for placed in plan.placements} - {None, in_flight}
    if any(not inventory.hosts[node].schedulable for node in used if node is not None):
        return "NodeCordoned"
    return None


def stuck_nodes(
    plan: DeploymentPlanSpec | None, pods: Iterable[PodView], now: datetime
) -> tuple[dict[str, str], float | None]:
    """Planned nodes that the scheduler refuses for a pod of the plan.

    Returns:
        What the scheduler says, by node; and in how many seconds to run again, if a pod may become stuck.
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
        # Everyone with access to the namespace may create a pod with our labels.
        if pod.deployment != pod.instance:
            continue
        left = (pod.unschedulable_since + UNSCHEDULABLE_GRACE - now).total_seconds()
        if left <= 0 and node in leaving:
            # The resources of its predecessor are free once that has ended.
            wait_s = min(1.0, wait_s or 1.0)
        elif left <= 0:
            stuck[node] = f"the scheduler cannot place {pod.instance} on {node}: {pod.unschedulable_message}"
        else:
            wait_s = min(left, wait_s or left)
    return stuck, wait_s
