"""Computation of a deployment plan from an application and an inventory (thesis 8.5, with its errata)."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from typing import assert_never

from fractus_core.api.applications import Application
from fractus_core.api.components import Component, Placement
from fractus_core.api.plans import DeploymentPlanSpec, DroneChoice
from fractus_core.exhaustive import exhaustive
from fractus_core.geo import multipolygon_geojson
from fractus_core.planning.candidates import check_host, check_resources
from fractus_core.planning.drone_selection import choose_drone, find_drones
from fractus_core.planning.edge_placement import (
    HybridHosts,
    find_along,
    find_static,
    place_along,
    place_near,
    place_static,
)
from fractus_core.planning.grant_compiler import check_policy_actions
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.operation_area import OperationArea, operation_area
from fractus_core.planning.plan_builder import Infeasible, PlanBuilder, instance_name

__all__ = ["Infeasible", "instance_name", "plan", "plan_in_steps"]


_IN_ORDER: tuple[Placement, ...] = exhaustive(Placement, ("drone", "edge", "hybrid", "cloud"))
_ROUNDING_M = 0.01
"""Tolerance of the operation area's outline in a plan. Its coordinates have a resolution of centimetres."""


def plan(
    application: Application,
    inventory: Inventory,
    settings: Settings | None = None,
    previous: DeploymentPlanSpec | None = None,
) -> DeploymentPlanSpec:
    """Choose a host for every instance of every component.

    Ties are resolved by name, so the same inventory always gives the same plan. Suitable hosts of the previous plan are
    preferred, so a new plan moves as few instances as possible.

    The plan lists each node in range that was checked and rejected, with its first failed requirement. Of the nodes out of
    range it lists only the nearest ones (`Settings.near_misses` per location), up to `Settings.rejections_listed` in total, and
    contains the number of omitted nodes. Nodes that did not have to be checked are not rejected.

    Raises:
        Infeasible: A component has no suitable node.
        InvalidObject: The application names an unknown depot, its geometry is invalid, or it selects an action that a policy
            does not permit.
    """
    if previous is None or previous.application_digest != application.spec.mission_digest:
        # A policy that changes in flight must not take the drone of a running mission.
        check_policy_actions(application, inventory)
    steps = plan_in_steps(application, inventory, settings, previous)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            result: DeploymentPlanSpec = done.value
            return result


def plan_in_steps(
    application: Application,
    inventory: Inventory,
    settings: Settings | None = None,
    previous: DeploymentPlanSpec | None = None,
) -> Generator[str, None, DeploymentPlanSpec]:
    """Plan like `plan`, and yield the name of each completed phase, for benchmarks.

    The phases are those of the thesis. After the area, each kind of component (drone, static, hybrid, cloud) has two phases:
    the search for nodes in range (`drone.candidates`) and the choice of a node (`drone.host`).
    """
    try:
        return (yield from _plan_once(PlanBuilder(application, inventory, settings or Settings(), previous)))
    except Infeasible:
        if previous is None:
            raise
    # Try again without reservations for running instances.
    return (
        yield from _plan_once(PlanBuilder(application, inventory, settings or Settings(), previous, reserving=False))
    )


def _plan_once(builder: PlanBuilder) -> Generator[str, None, DeploymentPlanSpec]:
    application = builder.application
    inventory = builder.inventory
    if not builder.settings.gateway:
        _check_gateway_not_needed(builder.spec.components)
    area = operation_area(builder.spec, inventory.depots, builder.settings.safety_radius_m)
    yield "area"
    choice: DroneChoice | None = None
    if area is not None:
        drones = find_drones(builder, area)
        yield "drone.candidates"
        choice = choose_drone(builder, area, drones)
        yield "drone.host"
    locations = [location for component in builder.spec.on("edge") for location in find_static(builder, component)]
    yield "static.candidates"
    place_static(builder, locations)
    yield "static.host"
    # Hybrid components come after the components near which they are placed.
    for placement in _IN_ORDER:
        for component in builder.spec.on(placement):
            match placement:
                case "drone" | "edge":
                    pass  # Drone and static components are already placed.
                case "hybrid":
                    _place_cloud(builder, component, 1)
                    yield "cloud.host"
                    yield from _place_hybrid(builder, component, area, choice)
                case "cloud":
                    _place_cloud(builder, component, component.replicas or 1)
                    yield "cloud.host"
                case _:
                    assert_never(placement)
    rejected, omitted = builder.listed_rejections()
    result = DeploymentPlanSpec(
        application=application.name,
        application_generation=application.metadata.generation,
        application_digest=application.spec.mission_digest,
        operation_area=multipolygon_geojson(area.frame, area.shape.simplify(_ROUNDING_M)) if area is not None else None,
        drone=choice,
        placements=tuple(builder.placements),
        rejected=rejected,
        rejected_omitted=omitted or None,
    )
    yield "report"
    return result


def _check_gateway_not_needed(components: Iterable[Component]) -> None:
    """Check that no component needs a gateway.

    Raises:
        Infeasible: A component uses the interface mavlink.
    """
    for component in components:
        if component.uses_mavlink:
            message = (
                f"{component.name} uses the interface mavlink, but the drones have no gateway;"
                " set gateway.enabled=true in the values of the chart fractus"
            )
            raise Infeasible(component.name, "NoGateway", message)


def _place_hybrid(
    builder: PlanBuilder, component: Component, area: OperationArea | None, choice: DroneChoice | None
) -> Generator[str, None, None]:
    """Place instances of a hybrid component near each of its partners. Its cloud instance is already placed."""
    hosts = HybridHosts()
    for name in component.hybrid_to:
        other = builder.spec.component(name)
        if other.placement == "edge":
            for static in [p for p in builder.placements if p.component == name]:
                place_near(builder, component, static, hosts)
            yield "hybrid-edge"
        elif area is not None and choice is not None:
            drone = builder.inventory.drones[choice.node]
            along = find_along(builder, component, drone, area)
            yield "hybrid-drone.candidates"
            place_along(builder, component, other, along, hosts)
            yield "hybrid-drone.host"


def _place_cloud(builder: PlanBuilder, component: Component, replicas: int) -> None:
    """Place a component in the cloud if a node can run it. Kubernetes selects the node.

    Raises:
        Infeasible: No cloud node can run the component.
    """
    for name in sorted(builder.located.cloud & builder.inventory.hosts.keys()):
        check = check_host(builder.inventory.hosts, name, builder.settings) and check_resources(
            builder.ledger, name, [component]
        )
        if check:
            builder.place(component, "cloud", None, replicas=replicas)
            return
        builder.reject(component, name, check)
    raise builder.infeasible(
        component,
        "NoCloudNode",
        f"no cloud node can host {component.name}",
        "no Node has the label fractus.dev/class=cloud, or fractus.dev/cloud=true in addition to another class",
    )
