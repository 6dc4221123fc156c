"""The flight as GeoJSON (lon, lat), for maps of others."""

from __future__ import annotations

from typing import Any

from fractus_core.geo import geojson, polygon

from fractus_sim.report.record import Judgement, Place, Record


def features(record: Record) -> dict[str, Any]:
    """A FeatureCollection: path, requests, zones, operation area, nodes, depots."""
    found: list[dict[str, Any]] = []
    if record.samples:
        line = {"type": "LineString", "coordinates": [_lonlat(s.place) for s in record.samples]}
        times = [round(s.time_s, 3) for s in record.samples]
        found.append(_feature(line, what="path", drone=record.drone.name if record.drone else None, times=times))
    for number, judged in enumerate(record.judgements, 1):
        found += _request(number, judged)
    for zone in record.zones:
        policies = [p.name for p in record.policies if zone.name in p.spec.selector.zones]
        shape = geojson(record.frame, polygon(record.frame, zone.spec.area))
        found.append(_feature(shape, what="zone", name=zone.name, policies=policies))
    if record.plan is not None and record.plan.spec.operation_area is not None:
        found.append(_feature(record.plan.spec.operation_area, what="operationArea"))
    for node in record.edge_nodes:
        at = node.spec.location
        found.append(_feature(_point([at.lon, at.lat]), what="edgeNode", name=node.name))
    for depot in record.depots:
        at_depot = depot.spec.location
        found.append(_feature(_point([at_depot.lon, at_depot.lat]), what="depot", name=depot.name))
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
    return [_feature(_point(_lonlat(place)), **properties)]


def _lonlat(place: Place) -> list[float]:
    return [round(place.lon, 7), round(place.lat, 7), round(place.alt_m, 2)]


def _point(coordinates: list[float]) -> dict[str, Any]:
    return {"type": "Point", "coordinates": coordinates}


def _feature(geometry: dict[str, Any], **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}
