"""Plans every Application of some manifests, one after the other, as the operator would."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

from fractus_core.api import Application, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning import Flight, Host, Infeasible, Inventory, Settings, flight_of
from fractus_core.planning import plan as decide
from fractus_core.planning.candidates import requests
from fractus_core.planning.grant_compiler import compile_grants
from fractus_core.planning.link_planning import PlannedLink, plan_links
from fractus_core.validation import check_application

from fractus_cli.manifests import BadManifest, Manifests


@dataclass(frozen=True)
class Decided:
    """The answer for one application: a plan with the direct links it makes possible, or why there is none."""

    application: Application
    plan: DeploymentPlanSpec | None
    refusal: Infeasible | None = None
    links: tuple[PlannedLink, ...] = ()


def plan_all(manifests: Manifests, settings: Settings) -> list[Decided]:
    """Plan every application on what those before it leave.

    Raises:
        BadManifest: there is no application, or one names what does not exist.
    """
    stock = manifests.inventory()
    decided = []
    in_force = {}
    applications = manifests.applications()
    if not applications:
        raise BadManifest("there is no Application in the manifests; name a file that has one")
    for application in applications:
        before = manifests.previous(application)
        if before is not None:
            in_force[application.key] = (application, before.spec)
    for application in applications:
        previous = in_force.pop(application.key, (application, None))[1]
        left = stock
        for other, its_plan in in_force.values():
            left = _taken(left, other, its_plan)
        try:
            check_application(application, stock.depots)
            found = decide(application, left, settings, previous)
            compile_grants(application, found, stock, settings)
        except InvalidObject as error:
            raise manifests.bad(application, error) from None
        except Infeasible as refusal:
            decided.append(Decided(application, None, refusal))
        else:
            drone = stock.drones.get(found.drone.node) if found.drone is not None else None
            links = plan_links(application, found, drone, stock.edge_nodes)
            decided.append(Decided(application, found, links=links))
            stock = _taken(stock, application, found)
    return decided


def _taken(stock: Inventory, application: Application, found: DeploymentPlanSpec) -> Inventory:
    """What is left for the next application: the drone is claimed, resources are booked."""
    hosts: dict[str, Host] = dict(stock.hosts)
    components = {component.name: component for component in application.spec.components}
    for placed in found.placements:
        if placed.node not in hosts or placed.component not in components:
            continue
        host = hosts[placed.node]
        booked = dict(host.requested)
        for resource, amount in requests(components[placed.component]).items():
            booked[resource] = booked.get(resource, 0.0) + amount
        hosts[placed.node] = replace(host, requested=booked)
    claimed: dict[str, tuple[str, str]] = dict(stock.claimed)
    flights: dict[str, Flight] = dict(stock.flights)
    if found.drone is not None and found.drone.shared_with is None:
        claimed[found.drone.node] = application.key
        with contextlib.suppress(InvalidObject):
            flights[found.drone.node] = flight_of(application, stock.depots)
    return replace(stock, hosts=hosts, claimed=claimed, flights=flights, locations=stock.located())
