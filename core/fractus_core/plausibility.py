"""Notes about valid manifests that are probably mistakes, such as exchanged coordinates."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from fractus_core.api import Application, Depot, EdgeNode, Policy, Zone
from fractus_core.api.geometry import Point
from fractus_core.geo import area_center
from fractus_core.geo.distances import geodesic_m

NEAR_M = 100_000.0
"""Distance to a depot within which a zone or a route is plausible, in metres. No drone of Fractus flies further."""


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


def policy_notes(policy: Policy, applications: Collection[Application]) -> Iterator[str]:
    """Yield the notes about a policy."""
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
