"""Zones as KML (OGC 07-147r2): placemarks with polygons."""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterable
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

from fractus_core.api import InvalidObject, Zone
from fractus_core.geo.formats.zone_builder import (
    Exported,
    FeatureName,
    Imported,
    ZoneBuilder,
    cut_rings,
    parse_point,
    reject_outlines,
    unsupported_parts,
)

_LOOK = frozenset(
    {
        "Style",
        "StyleMap",
        "styleUrl",
        "visibility",
        "balloonVisibility",
        "open",
        "LookAt",
        "Camera",
        "Region",
        "drawOrder",
    }
)
_WITHOUT_MEANING = frozenset({"id", "targetId", "maxLines"})
"""Attributes that identify or format an element."""
_DATA = frozenset({"ExtendedData", "Metadata"})
_AROUND_DATA = _DATA | {"SchemaData", "displayName", "value"}
_HOLDERS = frozenset({"kml", "Document", "Folder", "Update", "Create", "Change"})
_TIMES = frozenset({"TimeSpan", "TimeStamp"})
_PICTURES = frozenset({"ScreenOverlay", "PhotoOverlay", "Tour"})
"""Features that are drawn on the screen or beside the ground, such as a legend, and movements of the viewer."""
_OF_HOLDER = _HOLDERS | _PICTURES | _LOOK | _TIMES | {"name", "Placemark", "Schema", "NetworkLink", "GroundOverlay"}
_OF_POLYGON = frozenset({"outerBoundaryIs", "innerBoundaryIs", "altitudeMode", "extrude", "tessellate"})
_LINES = frozenset({"LineString", "LinearRing"})
_OTHERS = frozenset({"Point", *_LINES, "Model", "Track", "MultiTrack"})
_OF_PLACEMARK = _LOOK | _DATA | _TIMES | _OTHERS | {"name", "description", "Polygon", "MultiGeometry"}


def read_kml(text: str, without: Collection[str] = (), drop: Collection[str] = ()) -> Imported:
    """Read zones from the polygons of placemarks. Styles are ignored.

    Args:
        text: Content of the file.
        without: Names of placemarks to leave out.
        drop: Names of placemark data to leave out although they may state the size, altitude or time of a zone.

    Raises:
        InvalidObject: The text is not KML, a polygon is broken, or a placemark cannot be represented exactly.
    """
    if re.search(r"<!(DOCTYPE|ENTITY)", text):
        raise InvalidObject("", "a KML file must not declare entities")
    try:
        root = ElementTree.fromstring(re.sub(r"^\ufeff?\s*<\?xml[^>]*\?>", "", text))  # nosec B314  # noqa: S314  (no entities, see above)
    except ElementTree.ParseError as error:
        raise InvalidObject("", f"this is not XML ({error}); correct or export the file again") from None
    if _tag(root) != "kml":
        raise InvalidObject("", f"the root element is {_tag(root)}, not kml")
    builder = ZoneBuilder(without, drop)
    for holder in (e for e in root.iter() if _tag(e) in _HOLDERS):
        title = _text(holder, "name") or _tag(holder)
        _check_always(holder, title)
        _check_elements(builder, title, holder, _OF_HOLDER)
    count = 0
    for element in root.iter():
        tag = _tag(element)
        if tag == "NetworkLink":
            raise InvalidObject(
                _text(element, "name") or tag,
                "a NetworkLink refers to another file, which is not imported; save everything in one file",
            )
        count += tag == "Placemark"
        given = _text(element, "name")
        name = FeatureName(given or f"{tag} {count}".lower(), given, _identifier(element))
        if tag == "Placemark":
            builder.take(name, _shape(element), functools.partial(_read_placemark, builder, name, element))
        elif tag == "GroundOverlay":
            builder.take(name, None, functools.partial(_reject_overlay, name.title))
    return builder.result()


def _identifier(element: ElementTree.Element) -> str:
    """Return the identifier in the custom data of a placemark."""
    values = _data(element).get("identifier", [])
    return values[0] if len(values) == 1 and isinstance(values[0], str) else ""


def _reject_overlay(title: str) -> None:
    raise InvalidObject(title, "a GroundOverlay is a picture, which is not imported; draw its area as a polygon")


def _check_elements(
    builder: ZoneBuilder, title: str, element: ElementTree.Element, known: Collection[str], field: str = ""
) -> None:
    """Note unknown elements and data. Reject elements and data that may state the size, altitude or time of a zone."""
    unknown: dict[str, list[Any]] = {}
    for child in element:
        if _tag(child) not in {*known, *_DATA}:
            unknown.setdefault(_tag(child), []).extend(_contents(child))
    builder.properties(title, unknown, (), field)
    builder.properties(title, _data(element), ("identifier",), "ExtendedData")


def _contents(element: ElementTree.Element) -> list[Any]:
    """Return the attributes, texts and child elements of an element, by name."""
    text = (element.text or "").strip()
    children = [{_tag(child): _contents(child)} for child in element]
    attributes = {name: value for name, value in element.attrib.items() if name not in _WITHOUT_MEANING}
    return [attributes, *([text] if text else []), *children]


def _check_always(element: ElementTree.Element, field: str) -> None:
    if any(_tag(child) in _TIMES for child in element):
        raise InvalidObject(field, "has a time, which cannot be imported; remove it and add a schedule to the Zone")


def _read_placemark(builder: ZoneBuilder, name: FeatureName, placemark: ElementTree.Element) -> None:
    title = name.title
    described = builder.described(title, _text(placemark, "description"))
    polygons = [e for e in placemark.iter() if _tag(e) == "Polygon"]
    _check_elements(builder, title, placemark, _OF_PLACEMARK)
    for collection in (e for e in placemark.iter() if _tag(e) == "MultiGeometry"):
        _check_elements(builder, title, collection, _OF_PLACEMARK, "MultiGeometry")
    others = _other_geometries(placemark)
    if others:
        builder.note(title, f"{', '.join(sorted(set(map(_tag, others))))} is not a zone; left out")
    lines = [e for e in others if _tag(e) in _LINES]
    if lines and polygons:
        raise InvalidObject(_tag(lines[0]), "is a line beside polygons; draw its area as a polygon, or remove it")
    reject_outlines([_line(e) for e in lines], _tag(lines[0]) if lines else "")
    if not polygons and not others:
        raise InvalidObject("", "has no geometry; draw the zone as a Polygon, or leave it out")
    if polygons:
        _check_always(placemark, "")
    for i, polygon in enumerate(polygons):
        field = f"Polygon[{i}]"
        _check_elements(builder, title, polygon, _OF_POLYGON, field)
        build = functools.partial(_spec, builder, title, polygon, field, described)
        builder.add(name, _shape(polygon), field, build)


def _shape(element: ElementTree.Element) -> list[list[Any]]:
    """Return the coordinates below an element without heights, for stable names.

    Invalid coordinates are returned as text.
    """
    texts = [e.text or "" for e in element.iter() if _tag(e) == "coordinates"]
    try:
        return [_positions(text, "") for text in texts]
    except InvalidObject:
        return [text.split() for text in texts]


def _spec(builder: ZoneBuilder, title: str, polygon: ElementTree.Element, field: str, described: str) -> dict[str, Any]:
    exterior = _rings(builder, title, polygon, "outerBoundaryIs", field)
    holes = _rings(builder, title, polygon, "innerBoundaryIs", field)
    if len(exterior) != 1:
        raise InvalidObject(f"{field}.outerBoundaryIs", "a polygon must have exactly one outer boundary")
    for mode in (e.text or "" for e in polygon if _tag(e) == "altitudeMode"):
        if mode.strip() not in {"", "clampToGround"}:
            raise InvalidObject(
                f"{field}.altitudeMode",
                f"{mode.strip()} uses heights, which cannot be imported; clamp the polygon to the ground",
            )
    area = {"polygon": {"exterior": exterior[0]} | ({"holes": holes} if holes else {})}
    return {"area": area} | ({"description": described} if described else {})


def _other_geometries(element: ElementTree.Element) -> list[ElementTree.Element]:
    """Return the geometries below an element that are not polygons. Rings of polygons are omitted."""
    found = []
    for child in element:
        if _tag(child) in _OTHERS:
            found.append(child)
        elif _tag(child) == "MultiGeometry":
            found += _other_geometries(child)
    return found


def _line(element: ElementTree.Element) -> list[tuple[float, float]]:
    """Return the points of a line or ring as lon, lat. The first point of a ring is repeated at the end."""
    tag = _tag(element)
    field = f"{tag}.coordinates"
    points = [parse_point(pair, field) for pair in _positions(_text(element, "coordinates"), field)]
    if tag == "LinearRing":
        points += points[:1]
    return [(point.lon, point.lat) for point in points]


def _data(element: ElementTree.Element) -> dict[str, Any]:
    """Return the custom data of an element by name. If the data has a display name, the value contains it."""
    data = (e for child in element if _tag(child) in _DATA for e in child.iter() if _tag(e) not in _AROUND_DATA)
    values: dict[str, Any] = {}
    for e in data:
        text = " ".join(part.text.strip() for part in e.iter() if part.text and _tag(part) != "displayName").strip()
        shown = _text(e, "displayName")
        values.setdefault(e.get("name") or _tag(e), []).append({shown: text} if shown and text else text)
    return values


def _rings(
    builder: ZoneBuilder, title: str, shape: ElementTree.Element, boundary: str, field: str
) -> list[list[dict[str, float]]]:
    """Return all rings of a polygon's outer or inner boundaries.

    Some programs write several rings into one boundary.
    """
    texts = [e.text or "" for b in shape if _tag(b) == boundary for e in b.iter() if _tag(e) == "coordinates"]
    path = f"{field}.{boundary}.coordinates"
    return [builder.ring(title, _positions(text, path), path) for text in texts]


def _positions(text: str, field: str) -> list[list[float]]:
    """Return pairs of lon, lat. Heights are ignored because zones are clamped to the ground."""
    try:
        return [[float(v) for v in group.split(",")][:2] for group in text.split()]
    except ValueError:
        raise InvalidObject(field, "must be lon,lat[,alt] groups, separated by spaces") from None


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rsplit("}", 1)[-1]


def _text(element: ElementTree.Element, child: str) -> str:
    return next(((e.text or "").strip() for e in element if _tag(e) == child), "")


def write_kml(zones: Iterable[Zone]) -> Exported:
    """Return a document with a placemark for each zone, clamped to the ground."""
    zones = tuple(zones)
    notes = unsupported_parts(zones, "altitude", "schedule", "circle")
    return Exported(kml_document(zone_placemark(zone, notes) for zone in zones), tuple(notes))


def kml_document(marks: Iterable[str]) -> str:
    """Return a KML document that contains the placemarks."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n<Document>\n'
        f"{''.join(marks)}</Document>\n</kml>\n"
    )


def zone_placemark(zone: Zone, notes: list[str]) -> str:
    """Return a zone as a placemark. Adds notes on differences between the zone and its polygon."""
    polygons = "".join(map(_polygon, cut_rings(zone, notes)))
    description = f"<description>{escape(zone.spec.description)}</description>" if zone.spec.description else ""
    return (
        f"<Placemark><name>{escape(zone.name)}</name>{description}\n"
        f'<ExtendedData><Data name="identifier"><value>{escape(zone.name)}</value></Data></ExtendedData>\n'
        f"<MultiGeometry>{polygons}</MultiGeometry></Placemark>\n"
    )


def _polygon(rings: list[list[list[float]]]) -> str:
    exterior, *holes = rings
    boundaries = _boundary("outerBoundaryIs", exterior) + "".join(_boundary("innerBoundaryIs", h) for h in holes)
    return f"<Polygon><altitudeMode>clampToGround</altitudeMode>{boundaries}</Polygon>"


def _boundary(tag: str, points: list[list[float]]) -> str:
    coordinates = " ".join(f"{lon!r},{lat!r}" for lon, lat in points)
    return f"<{tag}><LinearRing><coordinates>{coordinates}</coordinates></LinearRing></{tag}>"
