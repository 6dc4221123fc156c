"""Legality of landing places before takeoff, judged for a drone with the rules that also apply in flight."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from fractus_core.api.applications import Application
from fractus_core.api.geometry import Point
from fractus_core.api.grants import GrantSpec
from fractus_core.api.nodes import Drone
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.grant_compiler import flight_grant
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.mission import home_of
from fractus_core.planning.operation_area import OperationArea
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
from fractus_core.policy.decision_types import Airframe, Home, Situation
from fractus_core.policy.geofences import RTL_CONE_SLOPE
from fractus_core.policy.return_route import MIN_RETURN_ALTITUDE_M, landing_problem, return_altitudes_m
from fractus_core.policy.route_search import quick_route


def check_landing_places(
    application: Application, drone: Drone, area: OperationArea, inventory: Inventory, settings: Settings
) -> str:
    """Return why a drone could not land at a landing place of an application, or an empty string if it could.

    Every place must be legal itself, and a legal route must lead to it from the drone's home.

    Args:
        application: Application that the drone would fly for.
        drone: The drone.
        area: Operation area of the application.
        inventory: Policies, zones and depots.
        settings: Settings with the time. Without a time, no place is checked.
    """
    home = home_of(drone, inventory.depots)
    if settings.time_s is None or home is None or not _may_abort(application, inventory):
        return ""
    granted = flight_grant(application, drone, inventory, area)
    places = list(landing_places(granted))
    if not places:
        return ""
    grant = compile_grant(granted, home, settings.flat_terrain)
    grant = replace(grant, operation_area=grant.flight_area, operation_area_border=grant.flight_area_border)
    ground_m = drone.spec.home.alt if drone.spec.home is not None else None
    now = Situation(
        settings.time_s,
        home.lat,
        home.lon,
        MIN_RETURN_ALTITUDE_M,
        home=Home(home.lat, home.lon, ground_m or 0.0),
        armed=True,
        in_air=True,
        airframe=Airframe(retraces=True),
    )
    for name, place in places:
        problem = _problem(place, now, grant)
        if problem:
            return f"{name} ({place.lat:.6f}, {place.lon:.6f}) is not a legal landing place: {problem}"
    return ""


def landing_places(grant: GrantSpec) -> Iterator[tuple[str, Point]]:
    """Yield the landing places of a Grant, each with the name of its field."""
    for policy in grant.policies:
        if policy.spec.land_at is not None:
            yield f"landAt of policy {policy.name}", policy.spec.land_at
    if grant.contact_lost is not None and grant.contact_lost.land_at is not None:
        yield "contactLost.landAt", grant.contact_lost.land_at


def planned_landing_places(
    application: Application, plan: DeploymentPlanSpec, inventory: Inventory, area: OperationArea | None
) -> list[tuple[str, Point]]:
    """Return the landing places of a plan, each with the name of its field."""
    drone = inventory.drones.get(plan.drone.node) if plan.drone is not None else None
    if drone is None or area is None or not _may_abort(application, inventory):
        return []
    return list(landing_places(flight_grant(application, drone, inventory, area)))


def _may_abort(application: Application, inventory: Inventory) -> bool:
    """Return True if a landing place may apply. This check is quicker than the compilation of a Grant."""
    lost = application.spec.contact_lost
    if lost is not None and lost.land_at is not None:
        return True
    if any(selection.land_at is not None for selection in application.spec.policy_actions):
        return True
    return any(policy.spec.land_at is not None for policy in inventory.policies.values())


def _problem(place: Point, now: Situation, grant: CompiledGrant) -> str:
    begin = grant.locate(now) or (0.0, 0.0)
    goal = grant.frame.xy(place.lat, place.lon)
    problem = landing_problem(goal, now.altitude_m, now, grant)
    if problem:
        return problem
    heights = return_altitudes_m(now, grant, RTL_CONE_SLOPE * math.dist(begin, goal), goal)
    if any(quick_route(begin, goal, now, grant, height_m, from_m=now.altitude_m) for height_m in heights):
        return ""
    return "no legal route from the drone's home to it was found"
