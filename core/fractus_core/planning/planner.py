"""From an application and an inventory to a deployment plan that explains itself (thesis 8.5, with its errata)."""

from __future__ import annotations

from collections.abc import Generator
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
    place_beside,
    place_static,
)
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.operation_area import OperationArea, operation_area
from fractus_core.planning.plan_builder import Draft, Infeasible, instance_name

__all__ = ["Infeasible", "instance_name", "plan", "plan_in_steps"]


_IN_ORDER: tuple[Placement, ...] = exhaustive(Placement, ("drone", "edge", "hybrid", "cloud"))
_ROUNDING_M = 0.01
"""How far from the area its outline in a plan may be: it is written to the centimetre anyway."""


def plan(
    application: Application,
    inventory: Inventory,
    settings: Settings | None = None,
    previous: DeploymentPlanSpec | None = None,
) -> DeploymentPlanSpec:
    """Choose a host for every instance of every component.

    Ties go by name, so that the same inventory always gives the same plan; hosts of the previous plan come first as
    long as they are suitable, so that a new plan moves as little as it can.

    Rejected nodes: every node that was a candidate by its place and was looked at is listed with the first rule it
    fails. Of the nodes that are too far away, only the nearest are (Settings.near_misses for each place asked for), and
    Settings.rejections_listed of all; the plan tells how many it leaves out. Nodes behind the best ones, which did not have to
    be looked at, are not rejected.

    Raises:
        Infeasible: some component has no suitable node.
        InvalidObject: the application names an unknown depot or its geometry is broken.
    """
    steps = plan_in_steps(application, inventory, settings, previous)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            decided: DeploymentPlanSpec = done.value
            return decided


def plan_in_steps(
    application: Application,
    inventory: Inventory,
    settings: Settings | None = None,
    previous: DeploymentPlanSpec | None = None,
) -> Generator[str, None, DeploymentPlanSpec]:
    """Plan as `plan` does, naming each phase when it is done, for benchmarks.

    The phases are the thesis' own: area, then for each kind of component (drone, static, hybrid, cloud) the search of
    candidates by place (`drone.candidates`) and the choice among them (`drone.host`).
    """
    try:
        return (yield from _drafted(Draft(application, inventory, settings or Settings(), previous)))
    except Infeasible:
        if previous is None:
            raise
    # What runs takes no room from what must run: without keeping it in place there may be a plan.
    return (yield from _drafted(Draft(application, inventory, settings or Settings(), previous, reserving=False)))


def _drafted(draft: Draft) -> Generator[str, None, DeploymentPlanSpec]:
    application, inventory = draft.application, draft.inventory
    area = operation_area(draft.spec, inventory.depots, draft.settings.safety_radius_m)
    yield "area"
    choice: DroneChoice | None = None
    if area is not None:
        drones = find_drones(draft, area)
        yield "drone.candidates"
        choice = choose_drone(draft, area, drones)
        yield "drone.host"
    locations = [location for component in draft.spec.on("edge") for location in find_static(draft, component)]
    yield "static.candidates"
    place_static(draft, locations)
    yield "static.host"
    # Hybrid components go beside those that have their places already, so these come first.
    for placement in _IN_ORDER:
        for component in draft.spec.on(placement):
            match placement:
                case "drone" | "edge":
                    pass  # They are placed: all on one drone, and the static ones.
                case "hybrid":
                    _place_cloud(draft, component, 1)
                    yield "cloud.host"
                    yield from _place_hybrid(draft, component, area, choice)
                case "cloud":
                    _place_cloud(draft, component, component.replicas or 1)
                    yield "cloud.host"
                case _:
                    assert_never(placement)
    rejected, omitted = draft.listed()
    decided = DeploymentPlanSpec(
        application=application.name,
        application_generation=application.metadata.generation,
        application_digest=application.spec.mission_digest,
        operation_area=multipolygon_geojson(area.frame, area.shape.simplify(_ROUNDING_M)) if area is not None else None,
        drone=choice,
        placements=tuple(draft.placements),
        rejected=rejected,
        rejected_omitted=omitted or None,
    )
    yield "report"
    return decided


def _place_hybrid(
    draft: Draft, component: Component, area: OperationArea | None, choice: DroneChoice | None
) -> Generator[str, None, None]:
    """Instances of a hybrid component near each of its partners; the one in the cloud is there already."""
    hosts = HybridHosts()
    for name in component.hybrid_to:
        other = draft.spec.component(name)
        if other.placement == "edge":
            for static in [p for p in draft.placements if p.component == name]:
                place_beside(draft, component, static, hosts)
            yield "hybrid-edge"
        elif area is not None and choice is not None:
            drone = draft.inventory.drones[choice.node]
            along = find_along(draft, component, drone, area)
            yield "hybrid-drone.candidates"
            place_along(draft, component, other, along, hosts)
            yield "hybrid-drone.host"


def _place_cloud(draft: Draft, component: Component, replicas: int) -> None:
    """Leave a component to the cloud, if there is a node that could run it; Kubernetes chooses which.

    Raises:
        Infeasible: there is none.
    """
    for name in sorted(draft.located.cloud & draft.inventory.hosts.keys()):
        check = check_host(draft.inventory.hosts, name, draft.settings) and check_resources(
            draft.ledger, name, [component]
        )
        if check:
            draft.place(component, "cloud", None, replicas=replicas)
            return
        draft.reject(component, name, check)
    raise draft.infeasible(
        component,
        "NoCloudNode",
        f"no cloud node can host {component.name}",
        "no Node has the label fractus.dev/class=cloud, or fractus.dev/cloud=true beside another class",
    )
