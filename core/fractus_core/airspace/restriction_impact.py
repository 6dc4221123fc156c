"""Flight plans and flights in the air that a restriction affects."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import shapely
from pydantic import Field
from shapely.geometry.base import BaseGeometry

from fractus_core.airspace.flight_volumes import HEIGHT_MARGIN_M, enlarged
from fractus_core.airspace.lifecycle import RESERVING
from fractus_core.airspace.plan_status import intent_of
from fractus_core.airspace.volumes import TOLERANCE_M
from fractus_core.api.flight_plans import FlightPlan, PlanState, application_name
from fractus_core.api.geometry import AltitudeBand, Point
from fractus_core.api.grants import ENDED, ApplicationReference, Grant
from fractus_core.api.model import Model
from fractus_core.api.names import Name
from fractus_core.api.nodes import Drone
from fractus_core.api.policies import ApplicationSelector, PolicySpec, Zone
from fractus_core.api.schedules import active_between
from fractus_core.geo import LocalFrame, area_center, area_polygon
from fractus_core.planning.grant_compiler import surely_beyond
from fractus_core.policy.compiled_grant import band_limits_m
from fractus_core.policy.decision_types import Home
from fractus_core.policy.selectors import node_attributes, policy_applies


class AffectedPlan(Model):
    """A flight plan that a restriction affects."""

    namespace: Name = Field(description="Namespace of the plan.")
    name: str = Field(description="Name of the plan.")
    state: PlanState = Field(description="State of the plan.")
    drone: str | None = Field(default=None, description="Name of the reserved drone.")
    begin: datetime = Field(description="First moment at which the plan uses airspace of the restriction.")
    end: datetime = Field(description="Last moment at which the plan uses airspace of the restriction.")


class AffectedFlight(Model):
    """A flight in the air that a restriction affects."""

    namespace: str = Field(description="Namespace of the Application.")
    application: str = Field(description="Name of the Application.")
    drone: str = Field(description="Name of the drone.")


@dataclass(frozen=True, slots=True)
class _Place:
    """Airspace of a flight, with altitudes above mean sea level in metres and times in seconds since 1970 UTC."""

    frame: LocalFrame
    shape: BaseGeometry
    lower_m: float
    upper_m: float
    begin_s: float
    end_s: float


def affected_plans(
    policy: PolicySpec, zone: Zone, plans: Iterable[FlightPlan], drones: Mapping[str, Drone], now_s: float
) -> list[AffectedPlan]:
    """Return the plans that reserve airspace of a restriction in the future, in the order of their namespaces and names.

    The selector of the policy is applied to the drone that a plan has reserved. Components are not compared, because a plan
    does not contain them. Altitudes of the zone above an unknown datum count as unlimited.

    Args:
        policy: Policy of the restriction.
        zone: Zone of the restriction.
        plans: All plans.
        drones: Drones by name.
        now_s: Time in seconds since 1970 UTC.

    Raises:
        InvalidObject: A volume of a plan, or the zone, is invalid.
    """
    affected = []
    for plan in plans:
        intent = intent_of(plan)
        if intent.state not in RESERVING:
            continue
        drone = drones.get((plan.status and plan.status.drone) or "")
        owner = ApplicationReference(
            namespace=plan.metadata.namespace or "default",
            name=application_name(plan.metadata.uid or ""),
            uid="",
        )
        if not policy_applies(_for_any_component(policy), owner, "", _attributes(drone)):
            continue
        home = _home(drone)
        shared = []
        for volume in intent.all_volumes:
            begin_s = max(volume.begin_s, now_s)
            place = _Place(
                volume.frame, volume.in_frame(volume.frame), volume.lower_m, volume.upper_m, begin_s, volume.end_s
            )
            if (span_s := _shared_time_s(policy, zone, place, home)) is not None:
                shared.append(span_s)
        if shared:
            affected.append(
                AffectedPlan(
                    namespace=owner.namespace,
                    name=plan.name,
                    state=intent.state,
                    drone=plan.status.drone if plan.status else None,
                    begin=datetime.fromtimestamp(min(begin_s for begin_s, _ in shared), UTC),
                    end=datetime.fromtimestamp(max(end_s for _, end_s in shared), UTC),
                )
            )
    return sorted(affected, key=lambda each: (each.namespace, each.name))


def affected_flights(
    policy: PolicySpec, zone: Zone, grants: Iterable[Grant], drones: Mapping[str, Drone], now_s: float
) -> list[AffectedFlight]:
    """Return the flights in the air whose Grants would contain a restriction, in the order of namespaces and Applications.

    A flight may use the areas of its Grant, with the margin that the engine keeps from fences, up to the maximum altitude
    of the Grant. It lasts at most as long as a full battery of the drone.

    Args:
        policy: Policy of the restriction.
        zone: Zone of the restriction.
        grants: All Grants.
        drones: Drones by name.
        now_s: Time in seconds since 1970 UTC.

    Raises:
        InvalidObject: An area is invalid.
    """
    affected = set()
    for grant in grants:
        spec = grant.spec
        drone = drones.get(spec.node)
        if drone is None or drone.status is None or not drone.status.in_air:
            continue
        if grant.status is not None and grant.status.phase in ENDED:
            continue
        areas = (*spec.operation_area, *spec.corridor)
        if not areas or not policy_applies(policy, spec.application, spec.component, _attributes(drone)):
            continue
        home = _home(drone)
        mobility = drone.spec.services.mobility
        frame = LocalFrame.at(area_center(areas[0]))
        shape = enlarged(shapely.union_all([area_polygon(frame, area) for area in areas]))
        upper_m = math.inf
        if home is not None and spec.limits is not None:
            upper_m = home.amsl_m + spec.limits.max_altitude + HEIGHT_MARGIN_M
        lasts_s = math.inf if mobility is None else mobility.max_flight_time * 60
        place = _Place(frame, shape, -math.inf, upper_m, now_s, now_s + lasts_s)
        if _shared_time_s(policy, zone, place, home) is not None:
            affected.add((spec.application.namespace, spec.application.name, drone.name))
    return [AffectedFlight(namespace=ns, application=app, drone=drone) for ns, app, drone in sorted(affected)]


def _shared_time_s(policy: PolicySpec, zone: Zone, place: _Place, home: Home | None) -> tuple[float, float] | None:
    """Return the first and last moment at which a flight may be in a restriction, or None if it never is."""
    valid_from_s, valid_until_s = policy.window_s
    begin_s = max(place.begin_s, valid_from_s)
    end_s = min(place.end_s, valid_until_s)
    if begin_s > end_s or begin_s >= valid_until_s or not active_between(zone.spec.schedule, begin_s, end_s):
        return None
    lower_m, upper_m = _band_amsl_m(zone.spec.altitude, home)
    if lower_m > place.upper_m + TOLERANCE_M or upper_m < place.lower_m - TOLERANCE_M:
        return None
    corners = shapely.get_coordinates(place.shape)
    reach_m = float(np.hypot(*corners.T).max()) + TOLERANCE_M
    if surely_beyond(zone, Point(lat=place.frame.lat, lon=place.frame.lon), reach_m):
        return None
    # Like the engine, this converts the corners of the zone to a frame near the drone.
    if not shapely.dwithin(place.shape, area_polygon(place.frame, zone.spec.area), TOLERANCE_M):
        return None
    return begin_s, end_s


def _band_amsl_m(band: AltitudeBand | None, home: Home | None) -> tuple[float, float]:
    """Return the altitudes of a zone above mean sea level. An unset or unknown bound is infinite."""
    if band is not None and band.reference == "amsl":
        # Mean sea level as the home, because these altitudes need no home.
        return band_limits_m(band, Home(0.0, 0.0, 0.0), flat_terrain=False)
    if home is None:
        return -math.inf, math.inf
    lower_m, upper_m = band_limits_m(band, home, flat_terrain=False)
    return lower_m + home.amsl_m, upper_m + home.amsl_m


def _home(drone: Drone | None) -> Home | None:
    home = drone.spec.home if drone is not None else None
    return None if home is None or home.alt is None else Home(home.lat, home.lon, home.alt)


def _attributes(drone: Drone | None) -> dict[str, object]:
    return {} if drone is None else node_attributes(drone)


def _for_any_component(policy: PolicySpec) -> PolicySpec:
    """Return a policy that selects all components of the applications that it selects."""
    selected = policy.selector.applications or ApplicationSelector()
    selector = policy.selector.model_copy(update={"applications": selected.model_copy(update={"components": ()})})
    return policy.model_copy(update={"selector": selector})
