"""Zones as GeoJSON (RFC 7946): polygons, multipolygons, and points with a radius."""

from __future__ import annotations

import functools
import json
from collections.abc import Collection, Iterable, Iterator
from typing import Any

from fractus_core.api import InvalidObject, Zone
from fractus_core.geo.formats.ed318 import is_ed318
from fractus_core.geo.formats.unknown_properties import EMPTY
from fractus_core.geo.formats.zone_builder import (
    Exported,
    FeatureName,
    Imported,
    ZoneBuilder,
    circle_area,
    cut_rings,
    is_number,
    object_list,
    optional_object,
    parse_json,
    parse_point,
    reject_outlines,
    reject_poles,
    reject_unknown_fields,
    unsupported_parts,
)

_KNOWN = frozenset({"identifier", "description", "radius", "altitude", "schedule"})
_OF_FEATURE = frozenset({"type", "id", "geometry", "properties", "bbox", "crs"})
_OF_COLLECTION = _OF_FEATURE | {
    "features", "name", "title", "description", "generator", "copyright", "license", "attribution", "links", "timestamp", "timeStamp",
    "totalFeatures", "numberMatched", "numberReturned", "xy_coordinate_resolution", "exceededTransferLimit",
}  # fmt: skip
"""Members of a FeatureCollection that do not affect zones.

Some are defined by GeoJSON, and map servers add the others.
"""
_OF_GEOMETRY = frozenset({"type", "coordinates", "geometries", "bbox", "crs"})
_AREAS = ("Polygon", "MultiPolygon", "GeometryCollection")
_STYLE = frozenset({"fill", "fill-opacity", "stroke", "stroke-width", "stroke-opacity", "marker-color"})
_LINES = ("LineString", "MultiLineString")
_POINTS = ("Point", "MultiPoint")
_WGS84 = frozenset(
    {
        "urn:ogc:def:crs:OGC:1.3:CRS84",
        "urn:ogc:def:crs:OGC::CRS84",
        "OGC:CRS84",
        "EPSG:4326",
        "urn:ogc:def:crs:EPSG::4326",
    }
)
"""Names of WGS 84 in files of GeoJSON 2008, which may name a reference system. With all names, lon comes before lat."""


def read_geojson(text: str, without: Collection[str] = (), drop: Collection[str] = ()) -> Imported:
    """Read zones from features. The properties `altitude` and `schedule` have the form of the fields of a Zone.

    Args:
        text: Content of the file.
        without: Titles of features to leave out.
        drop: Names of properties to leave out although they may state the size, altitude or time of a zone.

    Raises:
        InvalidObject: The text is not GeoJSON, a geometry is broken, or a feature cannot be represented exactly.
    """
    document = parse_json(text)
    kind = document.get("type")
    _check_system(document, "crs")
    if kind == "FeatureCollection":
        features = object_list(document.get("features"), "features")
        field = "features[{}]"
    elif kind == "Feature":
        features = [document]
        field = ""
    elif kind in _AREAS:
        features = [{"type": "Feature", "geometry": document, "properties": {}}]
        field = ""
    else:
        raise InvalidObject("type", f"{kind!r} is not GeoJSON of zones; expected a FeatureCollection of polygons")
    if is_ed318(features):
        raise InvalidObject("", "this is an ED-318 file; import it with --from ed318")
    builder = ZoneBuilder(without, drop)
    if kind == "FeatureCollection":
        builder.properties("the file", document, _OF_COLLECTION, "")
    for i, feature in enumerate(features):
        path = field.format(i)
        properties = feature.get("properties")
        stated = properties if isinstance(properties, dict) else {}
        given = _text(stated.get(_title_property(stated)))
        title = given or _text(feature.get("id")) or f"zone {i}"
        name = FeatureName(title, given, _text(stated.get("identifier")))
        geometry = feature.get("geometry")
        builder.take(
            name, [geometry, stated.get("altitude")], functools.partial(_read_feature, builder, name, feature, path)
        )
    return builder.result()


def _text(value: Any) -> str:
    """Return a name or number as text, and an empty string for other values."""
    return str(value).strip() if value not in EMPTY and isinstance(value, (str, int, float)) else ""


def _title_property(properties: dict[str, Any]) -> str:
    """Return the name of the property that names a feature."""
    return "name" if _text(properties.get("name")) else "title"


def _check_system(value: dict[str, Any], field: str) -> None:
    """Reject coordinates in another reference system."""
    system = value.get("crs")
    if system is None:
        return
    named = system.get("properties") if isinstance(system, dict) else None
    name = named.get("name") if isinstance(named, dict) else None
    if not isinstance(name, str) or name not in _WGS84:
        raise InvalidObject(field, f"must be WGS 84, not {name or 'an unnamed one'}; convert the file to OGC:CRS84")


def _read_feature(builder: ZoneBuilder, name: FeatureName, feature: dict[str, Any], field: str) -> None:
    title = name.title
    inside = f"{field}." if field else ""
    if feature.get("type") != "Feature":
        raise InvalidObject(f"{inside}type", f"must be Feature, not {feature.get('type')!r}")
    properties = optional_object(feature.get("properties"), f"{inside}properties")
    _check_system(feature, f"{inside}crs")
    known = ("altitude", "schedule", "description")
    spec = {k: properties[k] for k in known if properties.get(k) is not None and properties[k] != ""}
    if isinstance(spec.get("description"), str):
        spec["description"] = builder.described(title, spec["description"])
    builder.properties(title, feature, _OF_FEATURE, field)
    builder.properties(title, properties, _KNOWN | _STYLE | {_title_property(properties)}, f"{inside}properties")
    geometry = optional_object(feature.get("geometry"), f"{inside}geometry")
    for owner, path in ((feature, f"{inside}bbox"), (geometry, f"{inside}geometry.bbox")):
        box = owner.get("bbox")
        if isinstance(box, list) and len(box) == 6 and (box[2] or box[5]):
            raise InvalidObject(path, "has heights; remove them and state them in the altitude of the zone")
    if properties.get("radius") is not None and geometry.get("type") != "Point":
        raise InvalidObject(f"{inside}properties.radius", "is valid for a Point only; draw other areas as polygons")
    _check_lines(geometry, f"{inside}geometry")
    _read_geometry(builder, name, geometry, spec | {"radius": properties.get("radius")}, f"{inside}geometry")


def _read_geometry(
    builder: ZoneBuilder, name: FeatureName, geometry: dict[str, Any], stated: dict[str, Any], field: str
) -> None:
    """Add zones of a geometry, each with the properties of the feature."""
    title = name.title
    spec = {key: value for key, value in stated.items() if key != "radius"}
    coordinates = geometry.get("coordinates")
    path = f"{field}.coordinates"
    reject_unknown_fields(geometry, _OF_GEOMETRY, field)
    _check_system(geometry, f"{field}.crs")
    if "altitude" in spec and _heights(coordinates):
        builder.note(title, "heights of its points are ignored; properties.altitude is used")
        coordinates = _flat(coordinates)

    def add_polygon(rings: Any, place: str, location: str) -> None:
        shape = [{"type": "Polygon", "coordinates": rings}, spec.get("altitude")]
        builder.add(name, shape, location, lambda: {**spec, "area": builder.rings(title, rings, place)})

    match geometry.get("type"):
        case "Polygon":
            add_polygon(coordinates, path, field)
        case "MultiPolygon":
            if not isinstance(coordinates, list):
                raise InvalidObject(path, "must be a list of polygons")
            for j, part in enumerate(coordinates):
                add_polygon(part, f"{path}[{j}]", f"{path}[{j}]")
        case "Point" if stated["radius"] is not None:
            radius = f"{field.removesuffix('geometry')}properties.radius"
            shape = [geometry, spec.get("altitude"), stated["radius"]]
            builder.add(
                name,
                shape,
                field,
                lambda: {**spec, "area": circle_area(parse_point(coordinates, path), stated["radius"], radius)},
            )
        case "GeometryCollection":
            for j, part in enumerate(object_list(geometry.get("geometries"), f"{field}.geometries")):
                _read_geometry(builder, name, part, stated, f"{field}.geometries[{j}]")
        case other if other in _LINES or other in _POINTS:
            builder.note(title, f"a geometry of type {other} is not a zone; left out")
        case None:
            raise InvalidObject(field, "is missing; draw the zone, or leave the feature out")
        case other:
            raise InvalidObject(
                f"{field}.type", f"{other!r:.40} is not a geometry of GeoJSON; draw the zone as a Polygon"
            )


def _check_lines(geometry: dict[str, Any], field: str) -> None:
    """Reject lines that enclose an area, and lines beside polygons.

    A line beside a polygon belongs to a zone but has no area.

    Raises:
        InvalidObject: A line may be part of a zone, or its coordinates are invalid.
    """
    parts = list(_simple_geometries(geometry, field))
    lines = []
    for part, path in parts:
        kind = part.get("type")
        if kind in _LINES:
            drawn = part.get("coordinates") if kind == "MultiLineString" else [part.get("coordinates")]
            if not isinstance(drawn, list) or not all(isinstance(line, list) for line in drawn):
                raise InvalidObject(f"{path}.coordinates", "must be a list of positions")
            flat = [[parse_point(_flat(position), f"{path}.coordinates") for position in line] for line in drawn]
            lines += [[(point.lon, point.lat) for point in line] for line in flat]
            if any(other.get("type") in _AREAS for other, _ in parts):
                raise InvalidObject(path, "is a line beside polygons; draw its area as a polygon, or remove it")
    reject_outlines(lines, field)


def _simple_geometries(geometry: dict[str, Any], field: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the geometries of a collection, or the geometry itself if it is not a collection, each with its path."""
    if geometry.get("type") != "GeometryCollection":
        yield geometry, field
        return
    for i, part in enumerate(object_list(geometry.get("geometries"), f"{field}.geometries")):
        yield from _simple_geometries(part, f"{field}.geometries[{i}]")


def _heights(coordinates: Any) -> bool:
    """Return True if a position has a third number other than 0."""
    pending = [coordinates]
    while pending:
        value = pending.pop()
        if isinstance(value, list):
            if len(value) > 2 and all(map(is_number, value[:3])) and value[2]:
                return True
            pending += [item for item in value if isinstance(item, list)]
    return False


def _flat(coordinates: Any) -> Any:
    """Return the coordinates without heights."""
    if isinstance(coordinates, list) and coordinates and is_number(coordinates[0]):
        return coordinates[:2]
    return [_flat(item) for item in coordinates] if isinstance(coordinates, list) else coordinates


def write_geojson(zones: Iterable[Zone]) -> Exported:
    """Return a FeatureCollection with a polygon for each zone, cut at the antimeridian.

    `read_geojson` can read the result.

    Raises:
        InvalidObject: A zone contains a pole.
    """
    zones = tuple(zones)
    reject_poles(zones, "around which GeoJSON has no polygon")
    notes = unsupported_parts(zones, "circle")
    features = [zone_feature(zone, notes) for zone in zones]
    text = json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"
    return Exported(text, tuple(notes))


def zone_feature(zone: Zone, notes: list[str]) -> dict[str, Any]:
    """Return a zone as a feature. Adds notes on differences between the zone and its polygon."""
    spec = zone.spec.to_dict()
    properties = {"identifier": zone.name, "name": zone.name} | {
        k: spec[k] for k in ("altitude", "schedule", "description") if spec.get(k)
    }
    parts = cut_rings(zone, notes)
    geometry: dict[str, Any] = {"type": "MultiPolygon", "coordinates": parts}
    if len(parts) == 1:
        geometry = {"type": "Polygon", "coordinates": parts[0]}
    return {"type": "Feature", "properties": properties, "geometry": geometry}
