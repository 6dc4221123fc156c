"""Zones as UAS geographical zones of EUROCAE ED-318 (GeoJSON with a layer for each geometry)."""

from __future__ import annotations

import functools
from collections.abc import Collection
from typing import Any

from fractus_core.api import InvalidObject
from fractus_core.geo.formats.ed269 import LimitNames, read_band, read_schedule
from fractus_core.geo.formats.unknown_properties import EMPTY
from fractus_core.geo.formats.zone_builder import (
    FeatureName,
    Imported,
    ZoneBuilder,
    circle_area,
    object_list,
    optional_object,
    parse_json,
    parse_point,
    reject_unknown_fields,
)

_LIMITS = LimitNames("lower", "lowerReference", "upper", "upperReference", "uom")
_OF_FILE = frozenset({"type", "name", "title", "description", "bbox", "features"})
_OF_FEATURE = frozenset({"type", "id", "properties", "geometry", "bbox"})
_DESCRIBED = ("name", "type", "restrictionConditions", "message", "otherReasonInfo")
_OF_PROPERTIES = frozenset({"identifier", "limitedApplicability", "extendedProperties", *_DESCRIBED})
_WITHOUT_EFFECT = frozenset(
    {"country", "variant", "region", "reason", "regulationExemption", "zoneAuthority", "dataSource"}
)
"""Properties that state neither area nor altitude nor time. An import lists them in its notes."""
_OF_GEOMETRY = frozenset({"type", "coordinates", "layer", "bbox"})
_OF_EXTENT = frozenset({"subType", "radius"})


def read_ed318(text: str, without: Collection[str] = (), drop: Collection[str] = ()) -> Imported:
    """Read zones from features: polygons, and points with a circle as extent, each with the altitudes of its layer.

    Name, type, conditions and message of a feature become the description of the Zone.

    Args:
        text: Content of the file.
        without: Identifiers of features to leave out.
        drop: Names of unknown properties to leave out although they may state the size, altitude or time of a zone.

    Raises:
        InvalidObject: The text is not an ED-318 file, a geometry is broken, or a feature cannot be represented exactly.
    """
    document = parse_json(text)
    if document.get("type") != "FeatureCollection":
        raise InvalidObject("type", f"must be FeatureCollection, not {document.get('type')!r:.40}; ED-318 is GeoJSON")
    builder = ZoneBuilder(without, drop)
    builder.properties("the file", document, _OF_FILE | {"metadata"}, "")
    if document.get("metadata") not in EMPTY:
        builder.note("the file", "metadata cannot be imported; left out. Import again when a new version is published")
    for i, feature in enumerate(object_list(document.get("features"), "features")):
        field = f"features[{i}]"
        stated = feature.get("properties")
        properties = stated if isinstance(stated, dict) else {}
        identifier = str(properties.get("identifier") or "")
        given = _text(properties.get("name"))
        name = FeatureName(identifier or given or field, given, identifier)
        builder.take(name, feature.get("geometry"), functools.partial(_read_feature, builder, name, feature, field))
    return builder.result()


def is_ed318(features: Collection[dict[str, Any]]) -> bool:
    """Return True if a feature has an identifier as in ED-318, and also texts or a variant as in ED-318."""
    stated = [feature.get("properties") for feature in features]
    return any(
        "identifier" in properties and ("variant" in properties or isinstance(properties.get("name"), list))
        for properties in stated
        if isinstance(properties, dict)
    )


def _text(value: Any) -> str:
    """Return a text of ED-318: a list of texts in several languages, or an object with named conditions."""
    if isinstance(value, dict):
        named = ((key, _text(item)) for key, item in value.items() if key != "lang")
        return ", ".join(text if key == "text" else f"{key} {text}" for key, text in named if text)
    if isinstance(value, list):
        return ", ".join(filter(None, map(_text, value)))
    return "" if value is None else str(value)


def _read_feature(builder: ZoneBuilder, name: FeatureName, feature: dict[str, Any], field: str) -> None:
    title = name.title
    path = f"{field}.properties"
    builder.properties(title, feature, _OF_FEATURE, field)
    properties = optional_object(feature.get("properties"), path)
    without_effect = sorted(key for key in _WITHOUT_EFFECT if properties.get(key) not in EMPTY)
    if without_effect:
        builder.note(title, f"{', '.join(without_effect)} cannot be imported; left out")
    builder.properties(title, properties, _OF_PROPERTIES | _WITHOUT_EFFECT, path)
    extended = optional_object(properties.get("extendedProperties"), f"{path}.extendedProperties")
    builder.properties(title, extended, (), f"{path}.extendedProperties")
    parts = [text for text in (_text(properties.get(key)) for key in _DESCRIBED) if text]
    spec: dict[str, Any] = {"description": builder.described(title, ": ".join(parts))} if parts else {}
    if properties.get("type"):
        builder.note(title, f"a Zone forbids nothing by itself; add a policy for type {properties['type']}")
    schedule = read_schedule(properties.get("limitedApplicability"), f"{path}.limitedApplicability")
    if schedule:
        spec["schedule"] = schedule
    _read_geometry(
        builder, name, optional_object(feature.get("geometry"), f"{field}.geometry"), spec, f"{field}.geometry"
    )


def _read_geometry(
    builder: ZoneBuilder, name: FeatureName, geometry: dict[str, Any], spec: dict[str, Any], field: str
) -> None:
    """Add the zones of a geometry, each with the altitudes of its own layer."""
    coordinates = geometry.get("coordinates")
    if geometry.get("type") == "GeometryCollection":
        reject_unknown_fields(geometry, ("type", "geometries", "bbox"), field)
        parts = object_list(geometry.get("geometries"), f"{field}.geometries")
        if not parts:
            raise InvalidObject(f"{field}.geometries", "is empty; give at least one geometry")
        for i, part in enumerate(parts):
            _read_geometry(builder, name, part, spec, f"{field}.geometries[{i}]")
    elif geometry.get("type") == "MultiPolygon":
        path = f"{field}.coordinates"
        if not isinstance(coordinates, list) or not coordinates:
            raise InvalidObject(path, "must be a list of polygons")
        for i, polygon in enumerate(coordinates):
            part = geometry | {"type": "Polygon", "coordinates": polygon}
            _add(builder, name, part, spec, field=field, path=f"{path}[{i}]")
    else:
        _add(builder, name, geometry, spec, field=field, path=f"{field}.coordinates")


def _add(
    builder: ZoneBuilder, name: FeatureName, geometry: dict[str, Any], spec: dict[str, Any], *, field: str, path: str
) -> None:
    def build() -> dict[str, Any]:
        layer = optional_object(geometry.get("layer"), f"{field}.layer")
        reject_unknown_fields(layer, _LIMITS, f"{field}.layer")
        band = read_band(builder, name.title, layer, _LIMITS, f"{field}.layer")
        area = _area(builder, name.title, geometry, field, path)
        return {**spec, "area": area, **({"altitude": band} if band else {})}

    builder.add(name, geometry, path, build)


def _area(builder: ZoneBuilder, title: str, geometry: dict[str, Any], field: str, path: str) -> dict[str, Any]:
    """Return the area of a polygon, or of a point with a circle as extent."""
    kind = geometry.get("type")
    if kind == "Polygon":
        reject_unknown_fields(geometry, _OF_GEOMETRY, field)
        return builder.rings(title, geometry.get("coordinates"), path)
    if kind != "Point":
        raise InvalidObject(f"{field}.type", f"must be a Polygon, or a Point with a circle as extent, not {kind!r:.40}")
    reject_unknown_fields(geometry, _OF_GEOMETRY | {"extent"}, field)
    extent = optional_object(geometry.get("extent"), f"{field}.extent")
    reject_unknown_fields(extent, _OF_EXTENT, f"{field}.extent")
    if extent.get("subType") != "Circle":
        raise InvalidObject(f"{field}.extent.subType", "must be Circle; give the point a circle, or draw a Polygon")
    return circle_area(parse_point(geometry.get("coordinates"), path), extent.get("radius"), f"{field}.extent.radius")
