"""Zones as KML (OGC 07-147r2): placemarks with polygons."""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterable
from xml.etree import ElementTree
from xml.sax.saxutils import escape

from fractus_core.api import InvalidObject, Zone
from fractus_core.geo.formats.zone_builder import (
    Exported,
    Imported,
    ZoneBuilder,
    cut_rings,
    parse_ring,
    unsupported_parts,
)

_KNOWN = frozenset({"name", "description", "Polygon", "MultiGeometry"})
_LOOK = frozenset({"Style", "StyleMap", "styleUrl", "visibility", "open", "Snippet", "LookAt", "Camera"})
_DATA = frozenset({"ExtendedData"})
_AROUND_DATA = _DATA | {"SchemaData", "displayName", "value"}
_HOLDERS = frozenset({"Document", "Folder", "NetworkLink"})
_TIMES = frozenset({"TimeSpan", "TimeStamp"})
_OTHERS = ("Point", "LineString", "LinearRing", "Model", "Track")


def read_kml(text: str, without: Collection[str] = (), drop: Collection[str] = ()) -> Imported:
    """Read zones from the polygons of placemarks. Styles are ignored.

    Args:
        text: Content of the file.
        without: Names of placemarks to leave out.
        drop: Names of placemark data to leave out although they seem to state the altitude or time of a zone.

    Raises:
        InvalidObject: The text is not KML, a polygon is broken, or a placemark cannot be represented exactly.
    """
    if re.search(r"<!(DOCTYPE|ENTITY)", text):
        raise InvalidObject("", "a KML file must not declare entities")
    try:
        root = ElementTree.fromstring(re.sub(r"^\ufeff?\s*<\?xml[^>]*\?>", "", text))  # nosec B314  # noqa: S314  (no entities, see above)
    except ElementTree.ParseError as error:
        raise InvalidObject("", f"this is not XML ({error})") from None
    if _tag(root) != "kml":
        raise InvalidObject("", f"the root element is {_tag(root)}, not kml")
    for holder in (e for e in root.iter() if _tag(e) in _HOLDERS):
        title = _text(holder, "name") or _tag(holder)
        if _tag(holder) == "NetworkLink":
            raise InvalidObject(
                title, "a NetworkLink refers to another file, which is not imported; save everything in one file"
            )
        _check_always(holder, title)
    builder = ZoneBuilder(without, drop)
    for count, placemark in enumerate(e for e in root.iter() if _tag(e) == "Placemark"):
        title = _text(placemark, "name") or f"placemark {count + 1}"
        builder.take(title, functools.partial(_read_placemark, builder, title, placemark))
    return builder.result()


def _check_always(element: ElementTree.Element, field: str) -> None:
    if any(_tag(child) in _TIMES for child in element):
        raise InvalidObject(field, "has a time, which cannot be imported; remove it and add a schedule to the Zone")


def _read_placemark(builder: ZoneBuilder, title: str, placemark: ElementTree.Element) -> None:
    described = builder.described(title, _text(placemark, "description"))
    polygons = [e for e in placemark.iter() if _tag(e) == "Polygon"]
    others = sorted({_tag(e) for e in placemark.iter()} & set(_OTHERS) - ({"LinearRing"} if polygons else set()))
    if others:
        builder.note(title, f"{', '.join(others)} is not a zone; left out")
    builder.unmapped(title, map(_tag, placemark), _KNOWN | _LOOK | _DATA | set(_OTHERS))
    builder.properties(title, _data(placemark), (), "ExtendedData")
    if polygons:
        _check_always(placemark, "")
    for i, shape in enumerate(polygons):
        field = f"Polygon[{i}]"
        exterior = _rings(shape, "outerBoundaryIs", field)
        holes = _rings(shape, "innerBoundaryIs", field)
        if len(exterior) != 1:
            raise InvalidObject(f"{field}.outerBoundaryIs", "a polygon has exactly one")
        mode = _text(shape, "altitudeMode")
        if mode not in {"", "clampToGround"}:
            raise InvalidObject(
                f"{field}.altitudeMode",
                f"{mode} uses heights, which cannot be imported; clamp the polygon to the ground",
            )
        area = {"polygon": {"exterior": exterior[0]} | ({"holes": holes} if holes else {})}
        builder.add(title, {"area": area} | ({"description": described} if described else {}), field)


def _data(placemark: ElementTree.Element) -> dict[str, str]:
    """Return the custom data of a placemark by name."""
    data = (e for child in placemark if _tag(child) in _DATA for e in child.iter() if _tag(e) not in _AROUND_DATA)
    return {e.get("name") or _tag(e): "".join(e.itertext()).strip() for e in data}


def _rings(shape: ElementTree.Element, boundary: str, field: str) -> list[list[dict[str, float]]]:
    """Return all rings of a polygon's boundaries of one kind. Some programs write several rings into one boundary."""
    texts = [e.text or "" for b in shape if _tag(b) == boundary for e in b.iter() if _tag(e) == "coordinates"]
    return [_ring(text, f"{field}.{boundary}.coordinates") for text in texts]


def _ring(text: str, field: str) -> list[dict[str, float]]:
    try:
        # Heights are ignored because the polygon is clamped to the ground.
        positions = [[float(v) for v in group.split(",")][:2] for group in text.split()]
    except ValueError:
        raise InvalidObject(field, "must be lon,lat[,alt] groups") from None
    return parse_ring(positions, field)


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
    """Return the KML document of placemarks."""
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
        f"<MultiGeometry>{polygons}</MultiGeometry></Placemark>\n"
    )


def _polygon(rings: list[list[list[float]]]) -> str:
    exterior, *holes = rings
    boundaries = _boundary("outerBoundaryIs", exterior) + "".join(_boundary("innerBoundaryIs", h) for h in holes)
    return f"<Polygon><altitudeMode>clampToGround</altitudeMode>{boundaries}</Polygon>"


def _boundary(tag: str, points: list[list[float]]) -> str:
    coordinates = " ".join(f"{lon!r},{lat!r}" for lon, lat in points)
    return f"<{tag}><LinearRing><coordinates>{coordinates}</coordinates></LinearRing></{tag}>"
