"""Plans as GeoJSON features with simplestyle colours for map viewers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from fractus_core.api import Application
from fractus_core.api.geometry import Point
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance, Role
from fractus_core.exhaustive import exhaustive
from fractus_core.geo import line_geojson, multipolygon_geojson
from fractus_core.planning import Inventory, Settings, operation_area
from fractus_core.planning.landing_places import planned_landing_places

_COLOURS: dict[Role, str] = exhaustive(
    Role,
    {
        "drone": "#d62728",
        "static": "#1f77b4",
        "hybrid-edge": "#2ca02c",
        "hybrid-drone": "#ff7f0e",
        "cloud": "#7f7f7f",
    },
)

Feature = dict[str, Any]


def plan_map(
    application: Application, plan: DeploymentPlanSpec, inventory: Inventory, settings: Settings
) -> Iterator[Feature]:
    """Yield features: operation area, area of each control point, route, transit legs, landing places and nodes."""
    name = "/".join(application.key)
    area = operation_area(application.spec, inventory.depots, settings.safety_radius_m)
    if plan.operation_area is not None:
        style = {"fill": "#9467bd", "fill-opacity": 0.25, "stroke": "#9467bd"}
        yield _feature(plan.operation_area, name, "operationArea", style)
    if area is not None:
        if len(area.parts) > 1:
            for i, part in enumerate(area.parts):
                shape = multipolygon_geojson(area.frame, part)
                yield _feature(shape, name, f"controlPoints[{i}]", {"fill-opacity": 0, "stroke": "#8c564b"})
        if len(area.route) > 1:
            yield _feature(line_geojson(area.route), name, "route", {"stroke": "#d62728", "stroke-width": 2})
    for leg in plan.drone.transit if plan.drone is not None else ():
        yield _feature(line_geojson((leg.start, leg.end)), name, "transit", {"stroke": "#7f7f7f"})
    for title, place in planned_landing_places(application, plan, inventory, area):
        shape = {"type": "Point", "coordinates": [place.lon, place.lat]}
        yield _feature(shape, name, title, {"marker-color": "#17becf", "marker-symbol": "heliport"})
    for node, instances in _by_node(plan.placements).items():
        position = _position(node, inventory)
        if position is not None:
            components = ", ".join(f"{p.component} ({p.role})" for p in instances)
            colour = next((c for role, c in _COLOURS.items() if any(p.role == role for p in instances)), "#7f7f7f")
            shape = {"type": "Point", "coordinates": [position.lon, position.lat]}
            properties = {"marker-color": colour, "node": node, "instances": [p.instance for p in instances]}
            yield _feature(shape, name, components, properties)


def _feature(geometry: Mapping[str, Any], application: str, title: str, properties: Mapping[str, Any]) -> Feature:
    all_properties = {"application": application, "title": title, **properties}
    return {"type": "Feature", "properties": all_properties, "geometry": dict(geometry)}


def _by_node(placements: Sequence[PlannedInstance]) -> dict[str, list[PlannedInstance]]:
    nodes: dict[str, list[PlannedInstance]] = {}
    for placed in placements:
        if placed.node is not None:
            nodes.setdefault(placed.node, []).append(placed)
    return nodes


def _position(node: str, inventory: Inventory) -> Point | None:
    located = inventory.located()
    for index in (located.edge_nodes, located.stands):
        if node in index:
            return index.position(node)
    return None
