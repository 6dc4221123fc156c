"""Conversion of cluster objects to events."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from typing import Any

from fractus_core import api
from fractus_core.api.geometry import Area, Circle, Position
from fractus_core.api.model import Condition, Metadata
from fractus_core.api.policies import PolicySpec, ZoneSpec
from fractus_core.geo import line_geojson
from fractus_core.geo.formats.geojson import zone_feature

from fractus_view.events import Application, Fix, Link, Policy, State
from fractus_view.translation import who

OVER = frozenset({"Completed", "Failed", "Invalid"})
"""Phases in which an application's plan is no longer relevant."""

_PHASES = {
    "inactive": "on the ground",
    "charging": "charging",
    "takingOff": "taking off",
    "flying": "in the air",
    "landing": "landing",
}

_REFERENCES = {"home": "home", "amsl": "sea level", "terrain": "ground"}

Feature = dict[str, Any]


def fix(drone: api.Drone, now_ms: int) -> Fix | None:
    """Return the reported position of a drone."""
    place = drone.status.position if drone.status is not None else None
    if place is None:
        return None
    return Fix(
        drone.name, now_ms, place.lat, place.lon, place.alt if place.altitude_reference == "amsl" else None, None
    )


def state(drone: api.Drone, now_ms: int) -> State:
    """Return the reported state of a drone."""
    said = drone.status or api.nodes.DroneStatus()
    phase = _PHASES.get(said.flight_state)
    if phase is None:
        last = _PHASES.get(said.last_flight_state or "")
        phase = f"not heard of, last {last}" if last else "not heard of"
    place = said.position
    return State(
        drone=drone.name,
        time_ms=now_ms,
        altitude_m=place.alt if place is not None and place.altitude_reference == "home" else None,
        speed_mps=None,
        battery=said.battery.remaining if said.battery is not None else None,
        mode="",
        controller=who(said.controller),
        phase=phase,
        seen_ms=_unix_ms(said.last_seen),
    )


def application(given: api.Application) -> Application:
    """Return the state of an application."""
    said = given.status
    ready = _condition(said.conditions if said is not None else (), "Ready")
    return Application(
        name="/".join(given.key),
        drone=(said.drone if said is not None else None) or "",
        phase=(said.phase if said is not None else None) or "Pending",
        reason=ready.reason if ready is not None else "",
        text=(said.message if said is not None else None) or "the operator has not seen it yet",
    )


def link(given: api.DirectLink) -> Link:
    """Return a direct link and its state."""
    spec = given.spec
    said = given.status
    return Link(
        name=given.name,
        drone=spec.drone,
        node=spec.node,
        lat=spec.position.lat,
        lon=spec.position.lon,
        phase=(said.phase if said is not None else None) or "Idle",
        traffic=(said.traffic if said is not None else None) or "",
        reason=(said.reason if said is not None else None) or "",
        text=(said.message if said is not None else None) or "",
    )


def policy(given: api.Policy) -> Policy:
    """Return the summary of a policy, or the reason why it is not ready."""
    ready = _condition(given.status.conditions if given.status is not None else (), "Ready")
    text = _phrase(given.spec)
    if ready is not None and ready.status == "False":
        text = f"not in force: {ready.message or ready.reason} ({text})"
    return Policy(given.name, text, given.spec.selector.zones)


def _phrase(spec: PolicySpec) -> str:
    match spec.type:
        case "AccessControl":
            return f"{spec.kind} of {', '.join(spec.methods)}"
        case "LimitControl":
            unit = "m/s" if spec.kind == "speed" else f"m above {_REFERENCES[spec.altitude_reference]}"
            bounds = (("at least", spec.lower_limit), ("at most", spec.upper_limit))
            said = " and ".join(f"{word} {value:g}" for word, value in bounds if value is not None)
            return f"{spec.kind} {said} {unit}, {spec.limit_action}"
        case "GeofenceControl":
            return f"{spec.kind}, {spec.geofence_action}"
        case "PrivacyControl":
            return f"pictures: {spec.action}"


def zones(given: Iterable[api.Zone]) -> list[Feature]:
    """Return the zones by name."""
    return [_placed(zone, "zone") for zone in sorted(given, key=lambda zone: zone.name)]


def places(edge_nodes: Iterable[api.EdgeNode], depots: Iterable[api.Depot]) -> list[Feature]:
    """Return depots as circles and edge nodes as points."""
    found = [_placed(_disc(depot), "depot") for depot in sorted(depots, key=lambda depot: depot.name)]
    for node in sorted(edge_nodes, key=lambda node: node.name):
        ready = _condition(node.status.conditions if node.status is not None else (), "Ready")
        state = (
            "not heard of" if ready is None else "ready" if ready.status == "True" else ready.message or ready.reason
        )
        shape = {"type": "Point", "coordinates": [node.spec.location.lon, node.spec.location.lat]}
        found.append(_feature("edgeNode", node.name, shape, state=state))
    return found


def intentions(
    applications: Iterable[api.Application], plans: Mapping[tuple[str, str], api.DeploymentPlan]
) -> list[Feature]:
    """Return operation areas and planned paths of applications that have not ended.

    Args:
        applications: all that are known.
        plans: by namespace and name of the application.
    """
    found: list[Feature] = []
    for each in sorted(applications, key=lambda each: each.key):
        plan = plans.get(each.key)
        if plan is None or (each.status is not None and each.status.phase in OVER):
            continue
        name = "/".join(each.key)
        if plan.spec.operation_area is not None:
            found.append(_feature("operationArea", name, plan.spec.operation_area, application=name))
        for component, path in _paths(each):
            if len(path) > 1:
                found.append(_feature("path", name, line_geojson(path), application=name, component=component))
        for leg in plan.spec.drone.transit if plan.spec.drone is not None else ():
            shape = line_geojson((leg.start, leg.end))
            found.append(_feature("path", name, shape, application=name, component="system"))
    return found


def _paths(given: api.Application) -> Iterator[tuple[str, tuple[Position, ...]]]:
    for component in given.spec.components:
        for point in component.control_points:
            yield component.name, point.path or ()
        if component.points_of_interest is not None:
            yield component.name, component.points_of_interest.points


def _feature(kind: str, name: str, geometry: Mapping[str, Any], **more: str) -> Feature:
    return {"type": "Feature", "properties": {"name": name, "kind": kind, **more}, "geometry": dict(geometry)}


def _placed(zone: api.Zone, kind: str) -> Feature:
    feature = zone_feature(zone, [])
    feature["properties"]["kind"] = kind
    return feature


def _disc(depot: api.Depot) -> api.Zone:
    spec = ZoneSpec(area=Area(circle=Circle(center=depot.spec.location, radius=depot.spec.radius)))
    return api.Zone(kind="Zone", metadata=Metadata(name=depot.name), spec=spec)


def _condition(conditions: Iterable[Condition], type_: str) -> Condition | None:
    return next((each for each in conditions if each.type == type_), None)


def _unix_ms(moment: datetime | None) -> int | None:
    return None if moment is None else round(moment.timestamp() * 1000)
