"""Applications that share the flight of another one: which flights are offered, and when a shared one ends or is lost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from fractus_core.api import Application, Depot, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.planning.inventory import Flight
from fractus_core.planning.mission import flight_of, misses, remaining_flight

from fractus_operator.cluster.reading import Submitted
from fractus_operator.inventory.claims import Flown
from fractus_operator.reconcile.replanning import mission_changed


def may_share(application: Application | None) -> bool:
    """Whether another application's flight is enough for this one: it only has points to visit."""
    return (
        application is not None and application.spec.driver is None and application.spec.points_of_interest is not None
    )


def offered_flights(
    flown: Iterable[Flown], depots: Mapping[str, Depot], radius_m: float, present: DeploymentPlanSpec | None
) -> dict[str, Flight]:
    """What claimed drones fly, by drone, for an application that may share a flight.

    Of a drone in flight only what lies ahead of it counts, except for an application that shares its flight already. A drone
    whose application was changed since its plan is not offered: its new way is not known yet.

    Args:
        flown: Applications that have a drone.
        depots: By name.
        radius_m: How far from its path a drone may be.
        present: The plan in force of the application that asks.
    """
    choice = present.drone if present is not None else None
    shared = choice.node if choice is not None and choice.shared_with is not None else None
    found: dict[str, Flight] = {}
    for host in flown:
        if mission_changed(host.application, host.plan):
            continue
        try:
            flight: Flight | None = flight_of(host.application, depots)
        except InvalidObject:
            continue
        if flight is not None and host.in_flight and host.drone.name != shared:
            place = host.drone.status.position if host.drone.status is not None else None
            flight = remaining_flight(flight, place, radius_m) if place is not None else None
        if flight is not None:
            found[host.drone.name] = flight
    return found


def shared_flight_outcome(
    plan: DeploymentPlanSpec | None, host: Submitted | None, host_plan: DeploymentPlanSpec | None
) -> Outcome | None:
    """How the mission of an application that shares a flight ended: as that of its host did; None while it goes on.

    Args:
        plan: The application's plan.
        host: The application whose flight it shares, if that still exists.
        host_plan: That one's plan, unless its mission is over.
    """
    if plan is None or plan.drone is None or plan.drone.shared_with is None:
        return None
    if host is None or host_plan is not None or not host.completed:
        return None
    name = plan.drone.shared_with
    return Outcome(OutcomeKind.COMPLETE, f"{name} has flown {plan.drone.node} past all points of interest")


def shared_flight_lost(
    application: Application,
    plan: DeploymentPlanSpec | None,
    host_plan: DeploymentPlanSpec | None,
    flight: Flight | None,
    radius_m: float,
) -> str | None:
    """Why an application can no longer share a flight, as a sentence; None while it can.

    Args:
        application: The application that shares it.
        plan: Its plan.
        host_plan: The plan of the application whose flight it shares, if that still has one.
        flight: All that its host flies, from the beginning; None if that is not known for now.
        radius_m: How far from its path a drone may be.
    """
    if plan is None or plan.drone is None or plan.drone.shared_with is None:
        return None
    name, node = plan.drone.shared_with, plan.drone.node
    if host_plan is None or host_plan.drone is None or host_plan.drone.shared_with is not None:
        return f"{name}, whose flight it shared, does not fly {node} any more"
    if host_plan.drone.node != node:
        return f"{name}, whose flight it shared, flies {host_plan.drone.node} now"
    missed = misses(application, flight, radius_m) if flight is not None else None
    if missed is not None:
        return f"{name}, whose flight it shared, does not visit pointsOfInterest.points[{missed}] any more"
    return None
