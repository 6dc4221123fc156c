"""Choice of the plan of an Application: the active plan while it fits, otherwise a new plan. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.planner import Infeasible, plan
from fractus_core.planning.scale_up import next_free_node

from fractus_operator.pods import PodView

UNSCHEDULABLE_GRACE = timedelta(seconds=5)
"""Time for which a pod may wait for its planned node before the node counts as unusable."""

_OPTIONAL = frozenset({"NodeCordoned", "NodesAppeared"})
"""Reasons to plan again after which the present plan is kept if there is no better one."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The plan to deploy.

    Attributes:
        plan: The active plan, or a new one.
        reason: CamelCase reason for a new plan, or None if the active plan is kept.
        fits: True if the active plan is kept because it fits. False if it is kept because there is no other plan.
    """

    plan: DeploymentPlanSpec
    reason: str | None = None
    fits: bool = False

    @property
    def suits(self) -> bool:
        """True if the plan meets the requirements of the Application, which then waits only for free capacity on full nodes."""
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
    """Return the active plan while it fits, otherwise a new plan that moves as few instances as possible.

    Args:
        application: The Application.
        previous: The active plan, with the latest check of its route.
        inventory: The current inventory.
        settings: Settings of planning, with the current time and the excluded nodes.
        stuck: Nodes on which the scheduler cannot place a pod of the Application.
        in_flight: The drone of the active plan while it is in flight.

    Raises:
        Infeasible: There is no plan, and the active plan does not fit.
        InvalidObject: The Application contradicts itself.
    """
    if in_flight is not None:
        # The services check every call of an Application in flight. Neither a policy conflict nor a gateway that will be removed
        # after the landing must take its drone away.
        settings = replace(settings, policy_conflicts="warn", gateway=True)
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
    drone = decided.drone.node if decided.drone is not None else None
    if previous is not None and in_flight is not None and reason != "SpecChanged" and drone != in_flight:
        # Do not give up a drone in flight because of a problem on another node.
        return Choice(previous)
    if previous is not None and in_flight is not None:
        decided = _with_names_of(previous, decided)
    return Choice(decided, reason)


def mission_changed(application: Application | None, plan: DeploymentPlanSpec | None) -> bool:
    """Return True if the mission of an Application differs from the mission of its plan, or if one is missing."""
    if application is None or plan is None:
        return True
    if plan.application_generation == application.metadata.generation:
        return False
    return plan.application_digest is None or plan.application_digest != application.spec.mission_digest


def flown_generation(application: Application | None, plan: DeploymentPlanSpec | None) -> int | None:
    """Return the generation of a plan if the current manifest describes another mission, otherwise None."""
    return plan.application_generation if plan is not None and mission_changed(application, plan) else None


def of_generation(application: Application, plan: DeploymentPlanSpec) -> DeploymentPlanSpec:
    """Return a plan as the plan of the current generation, whose mission must be the same.

    Generation and digest are both updated, because other releases compare only generations, or compute another digest.
    """
    current = {
        "application_generation": application.metadata.generation,
        "application_digest": application.spec.mission_digest,
    }
    return plan if plan.model_dump(include=set(current)) == current else plan.model_copy(update=current)


def waits_for_landing(application: Application, plan: DeploymentPlanSpec, in_flight: str | None) -> bool:
    """Return True if a changed manifest is applied only after the landing, because it would change an Application in flight.

    Args:
        application: The Application.
        plan: Its active plan.
        in_flight: The drone of the plan while it is in flight.
    """
    changed = mission_changed(application, plan)
    return changed and in_flight is not None and application.spec.update_policy == "OnGround"


def _with_names_of(previous: DeploymentPlanSpec, decided: DeploymentPlanSpec) -> DeploymentPlanSpec:
    """Return a plan in which unmoved instances keep their names, because a new name restarts an instance.

    Another release may have given them names that this release would not give.
    """
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
    """Return why a new plan is needed, as a CamelCase reason, or None.

    A cordoned node is a reason. An unreachable node is not, because its pods continue to run until it is reachable again.

    Args:
        application: The Application.
        plan: The active plan.
        inventory: The current inventory.
        stuck: Nodes on which the scheduler cannot place a pod of the Application.
        in_flight: The drone of the plan while it is in flight. Its pods stay until it has landed.
    """
    if plan is None:
        return "NoPlanYet"
    if mission_changed(application, plan):
        return "SpecChanged"
    for placed in plan.placements:
        if placed.node is None or placed.node == in_flight:
            continue
        registered = placed.node in inventory.drones or placed.node in inventory.edge_nodes
        if placed.node not in inventory.hosts or not registered:
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
    """Return the planned nodes on which the scheduler cannot place a pod.

    Returns:
        Messages of the scheduler by node, which do not name the node, and the seconds until the next check, or None if no other pod may become stuck.
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
        # Ignore a pod of another Deployment, which a user of the namespace created with copied labels.
        if pod.deployment != pod.instance:
            continue
        remaining_s = (pod.unschedulable_since + UNSCHEDULABLE_GRACE - now).total_seconds()
        if remaining_s <= 0 and node in leaving:
            # The predecessor of the pod still uses the resources. They are released when the predecessor has ended.
            wait_s = min(1.0, wait_s or 1.0)
        elif remaining_s <= 0:
            stuck[node] = f"the scheduler cannot place {pod.instance}: {pod.unschedulable_message}"
        else:
            wait_s = min(remaining_s, wait_s or remaining_s)
    return stuck, wait_s
