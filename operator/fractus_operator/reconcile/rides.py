"""Who may come along with whose drone, and what becomes of a guest when that flight ends."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from fractus_core.api import Application, Depot, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.flight import ahead, flight_of, misses
from fractus_core.planning.inventory import Flight

from fractus_operator.cluster.reading import Submitted
from fractus_operator.inventory.claims import Flown
from fractus_operator.reconcile.missions import Outcome


def is_guest(plan: DeploymentPlanSpec | None) -> bool:
    """Whether an application comes along with another one."""
    return plan is not None and plan.drone is not None and plan.drone.shared_with is not None


def may_come_along(application: Application) -> bool:
    """Whether an application can do with another one's flight: one that only has points to visit."""
    return application.spec.driver is None and application.spec.points_of_interest is not None


def flights(
    flown: Iterable[Flown], depots: Mapping[str, Depot], radius_m: float, present: DeploymentPlanSpec | None
) -> dict[str, Flight]:
    """What claimed drones fly, by drone, for an application that may come along.

    Of a drone in the air only what lies ahead of it counts, except for a guest that is aboard already. A drone whose owner's
    manifest was changed since the plan is not offered: nobody knows its way yet.

    Args:
        flown: Applications that have a drone.
        depots: By name.
        radius_m: How far from its path a drone may be.
        present: The guest's plan.
    """
    aboard = present.drone.node if is_guest(present) and present is not None and present.drone is not None else None
    found: dict[str, Flight] = {}
    for host in flown:
        if host.plan.application_generation != host.application.metadata.generation:
            continue
        try:
            flight: Flight | None = flight_of(host.application, depots)
        except InvalidObject:
            continue
        if flight is not None and host.aloft and host.drone.name != aboard:
            place = host.drone.status.position if host.drone.status is not None else None
            flight = ahead(flight, place, radius_m) if place is not None else None
        if flight is not None:
            found[host.drone.name] = flight
    return found


def ride_outcome(
    plan: DeploymentPlanSpec | None, host: Submitted | None, host_plan: DeploymentPlanSpec | None
) -> Outcome | None:
    """How a guest's mission ended, as that of its host did; None while it goes on, or where it goes on with another drone.

    Args:
        plan: The guest's plan.
        host: The application that it comes along with, if it still exists.
        host_plan: That one's plan, unless its mission is over.
    """
    if plan is None or plan.drone is None or plan.drone.shared_with is None:
        return None
    if host is None or host_plan is not None or host.phase != "Completed":
        return None
    name = plan.drone.shared_with
    return Outcome(True, "MissionComplete", f"{name} has flown {plan.drone.node} past all points of interest")


def ride_lost(
    application: Application,
    plan: DeploymentPlanSpec | None,
    host_plan: DeploymentPlanSpec | None,
    flight: Flight | None,
    radius_m: float,
) -> str | None:
    """Why a guest can come along no longer, as a sentence; None while it can.

    Args:
        application: The guest.
        plan: Its plan.
        host_plan: The plan of the application it comes along with, if that still has one.
        flight: All that its host flies, from the beginning; None if that is not known for now.
        radius_m: How far from its path a drone may be.
    """
    if plan is None or plan.drone is None or plan.drone.shared_with is None:
        return None
    name, node = plan.drone.shared_with, plan.drone.node
    if host_plan is None or host_plan.drone is None or host_plan.drone.shared_with is not None:
        return f"{name}, which took it along, does not fly {node} any more"
    if host_plan.drone.node != node:
        return f"{name}, which took it along, flies {host_plan.drone.node} now"
    missed = misses(application, flight, radius_m) if flight is not None else None
    if missed is not None:
        return f"{name}, which took it along, does not visit pointsOfInterest.points[{missed}] any more"
    return None
