"""Plan the Applications of manifests one after the other, like the operator."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

from fractus_core.api import Application, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning import Flight, Host, Infeasible, Inventory, Settings, flight_of
from fractus_core.planning import plan as make_plan
from fractus_core.planning.candidates import requests
from fractus_core.planning.grant_compiler import compile_grants
from fractus_core.planning.link_planning import PlannedLink, plan_links
from fractus_core.validation import check_application

from fractus_cli.manifests import BadManifest, Manifests


@dataclass(frozen=True)
class PlanResult:
    """Plan of an Application with its possible direct links, or the reason why it is infeasible."""

    application: Application
    plan: DeploymentPlanSpec | None
    refusal: Infeasible | None = None
    links: tuple[PlannedLink, ...] = ()


def plan_all(manifests: Manifests, settings: Settings) -> list[PlanResult]:
    """Plan each Application with the drones and resources that no earlier Application uses.

    Raises:
        BadManifest: There is no Application, or an Application refers to an object that does not exist.
    """
    inventory = manifests.inventory()
    results = []
    current_plans = {}
    applications = manifests.applications()
    if not applications:
        raise BadManifest("the manifests contain no Application; specify a file with an Application")
    for application in applications:
        current_plan = manifests.previous(application)
        if current_plan is not None:
            current_plans[application.key] = (application, current_plan.spec)
    for application in applications:
        previous = current_plans.pop(application.key, (application, None))[1]
        available = inventory
        for other, other_plan in current_plans.values():
            available = _without(available, other, other_plan)
        try:
            check_application(application, inventory.depots)
            plan = make_plan(application, available, settings, previous)
            compile_grants(application, plan, inventory, settings)
        except InvalidObject as error:
            raise manifests.bad(application, error) from None
        except Infeasible as refusal:
            results.append(PlanResult(application, None, refusal))
        else:
            drone = inventory.drones.get(plan.drone.node) if plan.drone is not None else None
            links = plan_links(application, plan, drone, inventory.edge_nodes)
            results.append(PlanResult(application, plan, links=links))
            inventory = _without(inventory, application, plan)
    return results


def _without(inventory: Inventory, application: Application, plan: DeploymentPlanSpec) -> Inventory:
    """Return the inventory without the drone and the resources that a plan uses."""
    hosts: dict[str, Host] = dict(inventory.hosts)
    components = {component.name: component for component in application.spec.components}
    for placed in plan.placements:
        if placed.node not in hosts or placed.component not in components:
            continue
        host = hosts[placed.node]
        booked = dict(host.requested)
        for resource, amount in requests(components[placed.component]).items():
            booked[resource] = booked.get(resource, 0.0) + amount
        hosts[placed.node] = replace(host, requested=booked)
    claimed: dict[str, tuple[str, str]] = dict(inventory.claimed)
    flights: dict[str, Flight] = dict(inventory.flights)
    if plan.drone is not None and plan.drone.shared_with is None:
        claimed[plan.drone.node] = application.key
        with contextlib.suppress(InvalidObject):
            flights[plan.drone.node] = flight_of(application, inventory.depots)
    return replace(inventory, hosts=hosts, claimed=claimed, flights=flights, locations=inventory.located())
