"""The flight as GeoJSON (lon, lat)."""

from __future__ import annotations

from typing import Any

from fractus_core.geo import area_polygon, multipolygon_geojson

from fractus_sim.report.geojson import feature, lonlat, path, point
from fractus_sim.report.record import Judgement, Record


def features(record: Record) -> dict[str, Any]:
    """Return a FeatureCollection with path, requests, zones, operation area, nodes and depots."""
    found: list[dict[str, Any]] = []
    if record.samples:
        found.append(path(record.track))
    for number, judged in enumerate(record.judgements, 1):
        found += _request(number, judged)
    for zone in record.zones:
        policies = [p.name for p in record.policies if zone.name in p.spec.selector.zones]
        shape = multipolygon_geojson(record.frame, area_polygon(record.frame, zone.spec.area))
        found.append(feature(shape, what="zone", name=zone.name, policies=policies))
    if record.plan is not None and record.plan.spec.operation_area is not None:
        found.append(feature(record.plan.spec.operation_area, what="operationArea"))
    for node in record.edge_nodes:
        at = node.spec.location
        found.append(feature(point([at.lon, at.lat]), what="edgeNode", name=node.name))
    for depot in record.depots:
        at_depot = depot.spec.location
        found.append(feature(point([at_depot.lon, at_depot.lat]), what="depot", name=depot.name))
    return {"type": "FeatureCollection", "features": found}


def _request(number: int, judged: Judgement) -> list[dict[str, Any]]:
    place = judged.asked or judged.at
    if place is None:
        return []
    properties = {
        "what": "refused" if judged.refused else "corrected",
        "number": number,
        "component": judged.component,
        "method": judged.method,
        "code": judged.code,
        "reason": judged.reason,
        "policies": list(judged.policies),
    }
    return [feature(point(lonlat(place)), **properties)]
