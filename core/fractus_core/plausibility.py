"""Notes about valid manifests that are probably mistakes, such as exchanged coordinates."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator

from fractus_core.api import Application, Depot, EdgeNode, Policy, Zone
from fractus_core.api.geometry import Area, Point
from fractus_core.geo import area_center
from fractus_core.geo.distances import geodesic_m
from fractus_core.local_frame import ecef

NEAR_M = 100_000.0
"""Distance to a depot within which a zone or a route is plausible, in metres. No drone of Fractus flies further."""
_LISTED = 3
"""Number of names in a note."""


def exchanged_coordinates(point: Point, depots: Iterable[Depot]) -> str:
    """Return a sentence if a point is near a depot only with exchanged latitude and longitude, otherwise an empty string."""
    places = [depot.spec.location for depot in depots]
    if not places or not -90 <= point.lon <= 90:
        return ""
    distance_m = min(geodesic_m(point, place) for place in places)
    exchanged = Point(lat=point.lon, lon=point.lat)
    if distance_m <= NEAR_M or min(geodesic_m(exchanged, place) for place in places) > NEAR_M:
        return ""
    return (
        f"{point.lat:g}, {point.lon:g} is {distance_m / 1000:,.0f} km from the nearest depot; "
        "latitude and longitude are probably exchanged, here or in the Depot"
    )


def zone_notes(zone: Zone, depots: Collection[Depot]) -> Iterator[str]:
    """Yield the notes about a zone."""
    if note := exchanged_coordinates(area_center(zone.spec.area), depots):
        yield f"Zone {zone.name}: spec.area: {note}"


def edge_node_notes(edge_node: EdgeNode, depots: Collection[Depot]) -> Iterator[str]:
    """Yield the notes about an edge node."""
    if note := exchanged_coordinates(edge_node.spec.location, depots):
        yield f"EdgeNode {edge_node.name}: spec.location: {note}"


def far_zones(zones: Iterable[Zone], depots: Collection[Depot]) -> str:
    """Return a sentence if zones are far from every depot, otherwise an empty string.

    Such a zone may be intended, for example as part of the imported zones of a country. A policy whose only zones are far
    restricts no flight, or, as inclusion, forbids every flight.
    """
    places = [_ecef(depot.spec.location) for depot in depots]
    far = sorted(zone.name for zone in zones if places and _is_far(zone.spec.area, places))
    if not far:
        return ""
    names = ", ".join(far[:_LISTED]) + (f" and {len(far) - _LISTED} more" if len(far) > _LISTED else "")
    return f"more than {NEAR_M / 1000:.0f} km from every Depot: {names}; check latitude and longitude, which may be exchanged"


def _is_far(area: Area, places: Iterable[tuple[float, float, float]]) -> bool:
    """Return True if the circle around an area is further than NEAR_M from all places (earth-centred, in metres)."""
    center = _ecef(area_center(area))
    if area.circle is not None:
        radius_m = area.circle.radius
    else:
        assert area.polygon is not None  # the model requires a circle or a polygon
        radius_m = max(math.dist(center, _ecef(point)) for point in area.polygon.exterior)
    return all(math.dist(center, place) - radius_m > NEAR_M for place in places)


def _ecef(point: Point) -> tuple[float, float, float]:
    return ecef(point.lat, point.lon)


def notes(
    depots: Collection[Depot],
    zones: Collection[Zone],
    edge_nodes: Iterable[EdgeNode],
    policies: Iterable[Policy],
    applications: Collection[Application],
) -> Iterator[str]:
    """Yield the notes about all objects of a cluster or of a set of files."""
    exchanged = {zone.name: list(zone_notes(zone, depots)) for zone in zones}
    for found in exchanged.values():
        yield from found
    for edge_node in edge_nodes:
        yield from edge_node_notes(edge_node, depots)
    others = [zone for zone in zones if not exchanged[zone.name]]
    for policy in policies:
        yield from policy_notes(policy, applications)
        if far := far_zones((zone for zone in others if zone.name in policy.spec.selector.zones), depots):
            yield f"Policy {policy.name}: spec.selector.zones: {far}"


def policy_notes(policy: Policy, applications: Collection[Application]) -> Iterator[str]:
    """Yield the notes about the selected applications of a policy."""
    selected = policy.spec.selector.applications
    if selected is None:
        return
    matching = [
        application
        for application in applications
        if (not selected.namespaces or application.key[0] in selected.namespaces)
        and (not selected.names or application.name in selected.names)
    ]
    field = f"Policy {policy.name}: spec.selector.applications"
    if not matching:
        yield f"{field}: no Application is selected, so the policy has no effect; check namespaces and names"
    elif selected.components:
        components = {component.name for application in matching for component in application.spec.components}
        if not components.intersection(selected.components):
            names = ", ".join(sorted(components))
            yield f"{field}.components: no component of a selected Application has one of these names (existing: {names})"
