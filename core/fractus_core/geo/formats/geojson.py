"""Zones as GeoJSON (RFC 7946): polygons, multipolygons, and points with a radius."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from typing import Any

from fractus_core.api import InvalidObject, Zone
from fractus_core.geo.areas import geojson, middle, polygon
from fractus_core.geo.formats.drafts import (
    Drafts,
    Exported,
    Imported,
    area_rings,
    fields,
    number,
    objects,
    parse_json,
    place,
    rings,
    round_area,
    unsaid,
)
from fractus_core.geo.frames import LocalFrame

_KNOWN = frozenset({"name", "title", "description", "radius", "altitude", "schedule"})
_STYLE = frozenset({"fill", "fill-opacity", "stroke", "stroke-width", "stroke-opacity", "marker-color"})


def read_geojson(text: str) -> Imported:
    """Zones from features; altitude and schedule come from properties of these names, spelt as in a Zone.

    Raises:
        InvalidObject: this is not GeoJSON, or a geometry is broken.
    """
    whole = parse_json(text)
    kind = whole.get("type")
    if kind == "FeatureCollection":
        features = objects(whole.get("features"), "features")
    elif kind == "Feature":
        features = [whole]
    elif kind in {"Polygon", "MultiPolygon"}:
        features = [{"type": "Feature", "geometry": whole, "properties": {}}]
    else:
        raise InvalidObject("type", f"{kind!r} is not GeoJSON of zones; expected a FeatureCollection of polygons")
    drafts = Drafts()
    if whole.get("crs"):
        drafts.note("crs", "is not looked at; coordinates are taken as WGS 84, lon, lat")
    for i, feature in enumerate(features):
        _read_feature(drafts, feature, f"features[{i}]")
    return drafts.result()


def _read_feature(drafts: Drafts, feature: dict[str, Any], field: str) -> None:
    properties = fields(feature.get("properties"), f"{field}.properties")
    title = str(properties.get("name") or properties.get("title") or feature.get("id") or f"zone {field[9:-1]}")
    spec = {k: properties[k] for k in ("altitude", "schedule", "description") if properties.get(k)}
    if isinstance(spec.get("description"), str):
        spec["description"] = drafts.described(title, spec["description"])
    dropped = sorted(set(properties) - _KNOWN - _STYLE)
    if dropped:
        drafts.note(title, f"no place for properties {', '.join(dropped)}; left out")
    geometry = fields(feature.get("geometry"), f"{field}.geometry")
    coordinates = geometry.get("coordinates")
    if _heights(coordinates):
        drafts.note(title, "heights of its points are not taken over; give properties.altitude")
    where = f"{field}.geometry.coordinates"
    match geometry.get("type"):
        case "Polygon":
            drafts.add(title, {**spec, "area": rings(coordinates, where)})
        case "MultiPolygon":
            if not isinstance(coordinates, list):
                raise InvalidObject(where, "must be a list of polygons")
            for j, part in enumerate(coordinates):
                drafts.add(title, {**spec, "area": rings(part, f"{where}[{j}]")})
        case "Point" if "radius" in properties:
            area = round_area(place(coordinates, where), properties["radius"], f"{field}.properties.radius")
            drafts.add(title, {**spec, "area": area})
        case other:
            drafts.note(title, f"a geometry of type {other} is not a zone; left out")


def _heights(coordinates: Any) -> bool:
    """Whether a position has a third number other than 0."""
    pending = [coordinates]
    while pending:
        found = pending.pop()
        if isinstance(found, list):
            if len(found) > 2 and all(map(number, found[:3])) and found[2]:
                return True
            pending += [item for item in found if isinstance(item, list)]
    return False


def write_geojson(zones: Iterable[Zone]) -> Exported:
    """A FeatureCollection with a polygon for each zone, cut at the antimeridian (RFC 7946); read_geojson takes it back."""
    zones = tuple(zones)
    notes = unsaid(zones, "circle")
    features = []
    for zone in zones:
        spec = zone.spec.to_dict()
        properties = {"name": zone.name} | {k: spec[k] for k in ("altitude", "schedule", "description") if spec.get(k)}
        outline = area_rings(zone.spec.area)
        geometry: dict[str, Any] = {"type": "Polygon", "coordinates": outline}
        crossings = _crossings(outline[0])
        if crossings % 2:
            notes.append(f"{zone.name}: it contains a pole; programs that draw degrees on a plane show it wrong")
        elif crossings:
            frame = LocalFrame.at(middle(zone.spec.area))
            geometry = geojson(frame, polygon(frame, zone.spec.area))
            notes.append(f"{zone.name}: it crosses the antimeridian and is cut there, into parts")
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    text = json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"
    return Exported(text, tuple(notes))


def _crossings(ring: list[list[float]]) -> int:
    """How often a ring crosses the antimeridian: an odd number only if it runs around a pole."""
    return sum(abs(a[0] - b[0]) > 180 for a, b in itertools.pairwise(ring))
