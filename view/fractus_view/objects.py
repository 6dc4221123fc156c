"""Conversion of cluster objects to events."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from typing import cast, get_args

from fractus_core import api
from fractus_core.api.geometry import Area, Circle, Position
from fractus_core.api.model import Condition, Metadata
from fractus_core.api.nodes import is_airborne
from fractus_core.api.policies import PolicySpec, ZoneSpec, ZoneUse
from fractus_core.geo import line_geojson
from fractus_core.geo.formats.geojson import zone_feature
from fractus_core.planning.operation_area import control_routes

from fractus_view.events import Application, Feature, FeatureProperties, Fix, Geometry, Link, Policy, State
from fractus_view.translation import short_name

ENDED_PHASES = frozenset({"Completed", "Failed", "Invalid"})
"""Phases in which an application's plan is no longer relevant."""

_PHASES = {
    "inactive": "on the ground",
    "charging": "charging",
    "takingOff": "taking off",
    "flying": "in the air",
    "landing": "landing",
}

_REFERENCES = {"home": "home", "amsl": "sea level", "terrain": "ground"}


def fix(drone: api.Drone, now_ms: int) -> Fix | None:
    """Return the reported position of a drone, or None if the drone reported no position."""
    position = drone.status.position if drone.status is not None else None
    if position is None:
        return None
    amsl_m = position.alt if position.altitude_reference == "amsl" else None
    return Fix(drone.name, now_ms, position.lat, position.lon, amsl_m, heading_deg=None)


def in_air(drone: api.Drone) -> bool:
    """Return True if a drone is in the air, or was in the air at its last report."""
    status = drone.status or api.nodes.DroneStatus()
    return is_airborne(status.flight_state, status.last_flight_state)


def state(drone: api.Drone, now_ms: int, flight_ms: int | None = None, *, returns: bool = False) -> State:
    """Return the reported state of a drone.

    Args:
        drone: The drone.
        now_ms: Current time in Unix milliseconds.
        flight_ms: Start of the current or latest flight in Unix milliseconds.
        returns: True if the mission of the drone is over, so that it flies home.
    """
    status = drone.status or api.nodes.DroneStatus()
    phase = _PHASES.get(status.flight_state)
    if phase is None:
        last_phase = _PHASES.get(status.last_flight_state or "")
        phase = f"not reporting, last {last_phase}" if last_phase else "not reporting"
    elif returns and status.flight_state == "flying":
        phase = "returning"
    position = status.position
    return State(
        drone=drone.name,
        time_ms=now_ms,
        altitude_m=position.alt if position is not None and position.altitude_reference == "home" else None,
        speed_mps=None,
        battery=status.battery.remaining if status.battery is not None else None,
        mode="",
        controller=short_name(status.controller),
        phase=phase,
        seen_ms=_unix_ms(status.last_seen),
        flight_ms=flight_ms,
    )


def assigned_drones(applications: Iterable[api.Application]) -> frozenset[str]:
    """Return the names of the drones of applications that have not ended."""
    statuses = (resource.status for resource in applications)
    return frozenset(s.drone for s in statuses if s is not None and s.drone and s.phase not in ENDED_PHASES)


def returning_drones(applications: Iterable[api.Application]) -> frozenset[str]:
    """Return the names of the drones that fly home after the mission of an application."""
    statuses = (resource.status for resource in applications)
    return frozenset(s.drone for s in statuses if s is not None and s.phase == "Returning" and s.drone)


def application(resource: api.Application) -> Application:
    """Return the state of an application."""
    status = resource.status
    ready = _condition(status.conditions if status is not None else (), "Ready")
    return Application(
        name="/".join(resource.key),
        drone=(status.drone if status is not None else None) or "",
        phase=(status.phase if status is not None else None) or "Pending",
        reason=ready.reason if ready is not None else "",
        text=(status.message if status is not None else None) or "waiting for the operator",
    )


def link(resource: api.DirectLink) -> Link:
    """Return a direct link and its state."""
    spec = resource.spec
    status = resource.status
    return Link(
        name=resource.name,
        drone=spec.drone,
        node=spec.node,
        lat=spec.position.lat,
        lon=spec.position.lon,
        phase=(status.phase if status is not None else None) or "Idle",
        traffic=(status.traffic if status is not None else None) or "",
        reason=(status.reason if status is not None else None) or "",
        text=(status.message if status is not None else None) or "",
    )


def policy(resource: api.Policy) -> Policy:
    """Return the summary of a policy. If the policy is not ready, the summary begins with the reason."""
    ready = _condition(resource.status.conditions if resource.status is not None else (), "Ready")
    text = _summary(resource.spec)
    if ready is not None and ready.status == "False":
        text = f"not in force: {ready.message or ready.reason} ({text})"
    return Policy(resource.name, text, resource.spec.selector.zones)


def _summary(spec: PolicySpec) -> str:
    match spec.type:
        case "AccessControl":
            return f"{spec.kind} of {', '.join(spec.methods)}"
        case "LimitControl":
            unit = "m/s" if spec.kind == "speed" else f"m above {_REFERENCES[spec.altitude_reference]}"
            limits = (("at least", spec.lower_limit), ("at most", spec.upper_limit))
            limits_text = " and ".join(f"{word} {value:g}" for word, value in limits if value is not None)
            return f"{spec.kind} {limits_text} {unit}, {spec.limit_action}"
        case "GeofenceControl":
            return f"{spec.kind}, {spec.geofence_action}"
        case "PrivacyControl":
            return f"pictures: {spec.action}"


def zones(resources: Iterable[api.Zone], policies: Iterable[api.Policy]) -> list[Feature]:
    """Return the zones, sorted by name, with the effects of the policies that select them."""
    uses: dict[str, set[ZoneUse]] = {}
    for resource in policies:
        for name in resource.spec.selector.zones:
            uses.setdefault(name, set()).update(resource.spec.zone_uses)
    features = []
    for zone in sorted(resources, key=lambda zone: zone.name):
        feature = _zone_feature(zone, "zone")
        feature["properties"]["uses"] = [use for use in get_args(ZoneUse) if use in uses.get(zone.name, ())]
        features.append(feature)
    return features


def places(edge_nodes: Iterable[api.EdgeNode], depots: Iterable[api.Depot]) -> list[Feature]:
    """Return depots as circles and edge nodes as points."""
    features = [_zone_feature(_disc(depot), "depot") for depot in sorted(depots, key=lambda depot: depot.name)]
    for node in sorted(edge_nodes, key=lambda node: node.name):
        ready = _condition(node.status.conditions if node.status is not None else (), "Ready")
        if ready is None:
            state = "not reporting"
        elif ready.status == "True":
            state = "ready"
        else:
            state = ready.message or ready.reason
        location = node.spec.location
        features.append(
            {
                "type": "Feature",
                "properties": {"kind": "edgeNode", "name": node.name, "state": state},
                "geometry": {"type": "Point", "coordinates": [location.lon, location.lat]},
            }
        )
    return features


def planned_flights(
    applications: Iterable[api.Application],
    plans: Mapping[tuple[str, str], api.DeploymentPlan],
    depots: Mapping[str, api.Depot],
) -> list[Feature]:
    """Return operation areas, planned paths and control points of applications that have not ended.

    Args:
        applications: Applications.
        plans: Plans by namespace and name of their application.
        depots: Depots by name. A control point whose depot is missing has no position, and is omitted.
    """
    features: list[Feature] = []
    for resource in sorted(applications, key=lambda resource: resource.key):
        plan = plans.get(resource.key)
        if plan is None or (resource.status is not None and resource.status.phase in ENDED_PHASES):
            continue
        name = "/".join(resource.key)
        if plan.spec.operation_area is not None:
            features.append(_application_feature("operationArea", name, plan.spec.operation_area))
        for component, path in _paths(resource):
            if len(path) > 1:
                features.append(_application_feature("path", name, line_geojson(path), component))
        features += _control_points(resource, depots)
        transit = plan.spec.drone.transit if plan.spec.drone is not None else ()
        features += [
            _application_feature("path", name, line_geojson((leg.start, leg.end)), "system") for leg in transit
        ]
    return features


def _paths(resource: api.Application) -> Iterator[tuple[str, tuple[Position, ...]]]:
    for component in resource.spec.components:
        for point in component.control_points:
            yield component.name, point.path or ()
        if component.points_of_interest is not None:
            yield component.name, component.points_of_interest.points


def _control_points(resource: api.Application, depots: Mapping[str, api.Depot]) -> Iterator[Feature]:
    """Yield the control points of the driver with their numbers, which are the indices of `controlPoints`."""
    driver = resource.spec.driver
    if driver is None:
        return
    for number, point in enumerate(driver.control_points):
        try:
            ((start, *_),) = control_routes([point], depots)
        except api.InvalidObject:
            continue
        geometry = {"type": "Point", "coordinates": [start.lon, start.lat]}
        name = "/".join(resource.key)
        feature = _application_feature("controlPoint", name, geometry, driver.name)
        feature["properties"]["number"] = number
        yield feature


def _application_feature(kind: str, application: str, geometry: Mapping[str, object], component: str = "") -> Feature:
    properties: FeatureProperties = {"kind": kind, "name": application, "application": application}
    if component:
        properties["component"] = component
    return {"type": "Feature", "properties": properties, "geometry": cast(Geometry, geometry)}


def _zone_feature(zone: api.Zone, kind: str) -> Feature:
    feature = zone_feature(zone, [])
    feature["properties"]["kind"] = kind
    return cast(Feature, feature)


def _disc(depot: api.Depot) -> api.Zone:
    spec = ZoneSpec(area=Area(circle=Circle(center=depot.spec.location, radius=depot.spec.radius)))
    return api.Zone(kind="Zone", metadata=Metadata(name=depot.name), spec=spec)


def _condition(conditions: Iterable[Condition], type_: str) -> Condition | None:
    return next((condition for condition in conditions if condition.type == type_), None)


def _unix_ms(time: datetime | None) -> int | None:
    return None if time is None else round(time.timestamp() * 1000)
