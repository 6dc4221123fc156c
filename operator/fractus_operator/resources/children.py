"""All child objects of an Application that follow from its plan and Grants."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from fractus_core.api import Application, Drone
from fractus_core.api.grants import GrantSpec
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator import kinds, labels
from fractus_operator.kinds import Body, Kind
from fractus_operator.labels import label_value, owned_object
from fractus_operator.pods import PodView
from fractus_operator.resources.deployment import deployment
from fractus_operator.resources.grant import grant
from fractus_operator.resources.network_policy import network_policies
from fractus_operator.resources.service import endpoint_slice, service


def children(
    application: Application,
    plan: DeploymentPlanSpec,
    grants: Iterable[GrantSpec],
    pods: Sequence[PodView],
    drone: Callable[[str], Drone | None],
    *,
    gateway_image: str = "",
) -> dict[Kind, list[Body]]:
    """Return the desired child objects by kind, except DirectLinks and Secrets.

    DirectLinks also depend on the addresses of Services. Secrets contain keys, which are generated only when needed.

    Args:
        application: The Application.
        plan: Its plan.
        grants: Grants of its instances.
        pods: Its current pods.
        drone: Returns the Drone of a name, or None.
        gateway_image: Image of the sidecar of MAVLink programs.
    """
    desired: dict[Kind, list[Body]] = {kind: [] for kind in kinds.CHILDREN}
    desired[kinds.DEPLOYMENT_PLAN] = [deployment_plan(application, plan)]
    desired[kinds.GRANT] = [grant(application, spec) for spec in grants]
    desired[kinds.NETWORK_POLICY] = network_policies(application, plan)
    for component in application.spec.components:
        if component.container.ports:
            desired[kinds.SERVICE].append(service(application, component))
            if component.placement == "hybrid":
                desired[kinds.ENDPOINT_SLICE].append(endpoint_slice(application, component, plan, pods))
    if plan.drone is not None:
        # Prevents evictions on the drone, for example by kubectl drain. With maxUnavailable, Kubernetes would look for the
        # controllers of the pods, and warn (UnmanagedPods) about pods of a finished mission, whose Deployment is deleted.
        on_drone = {labels.APPLICATION_LABEL: label_value(application.name), labels.PLACEMENT_LABEL: "drone"}
        instances = sum(placed.placement == "drone" for placed in plan.placements)
        budget = {"minAvailable": instances, "selector": {"matchLabels": on_drone}}
        name = application.name
        desired[kinds.DISRUPTION_BUDGET] = [owned_object(kinds.DISRUPTION_BUDGET, application, name, {}, spec=budget)]
    for placed in plan.placements:
        node = drone(placed.node) if placed.node is not None else None
        desired[kinds.DEPLOYMENT].append(deployment(application, placed, node, gateway_image))
    return desired


def deployment_plan(application: Application, plan: DeploymentPlanSpec) -> Body:
    """Return the DeploymentPlan of an Application. The DeploymentPlan has the name of the Application."""
    return owned_object(kinds.DEPLOYMENT_PLAN, application, application.name, {}, spec=plan.to_dict())
