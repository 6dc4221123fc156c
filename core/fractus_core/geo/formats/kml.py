"""Zones as KML (OGC 07-147r2): placemarks with polygons."""

from __future__ import annotations

import re
from collections.abc import Iterable
from xml.etree import ElementTree
from xml.sax.saxutils import escape

from fractus_core.api import InvalidObject, Zone
from fractus_core.geo.formats.drafts import Drafts, Exported, Imported, area_rings, ring, unsaid

_KNOWN = frozenset({"name", "description", "Polygon", "MultiGeometry"})
_LOOK = frozenset({"Style", "StyleMap", "styleUrl", "visibility", "open", "Snippet", "LookAt", "Camera"})
_OTHERS = ("Point", "LineString", "LinearRing", "Model", "Track")


def read_kml(text: str) -> Imported:
    """Zones from the polygons of placemarks; heights and styles are not taken over.

    Raises:
        InvalidObject: this is not KML, or a polygon is broken.
    """
    if re.search(r"<!(DOCTYPE|ENTITY)", text):
        raise InvalidObject("", "a KML file must not declare entities")
    try:
        root = ElementTree.fromstring(re.sub(r"^\ufeff?\s*<\?xml[^>]*\?>", "", text))  # noqa: S314  (no entities, see above)
    except ElementTree.ParseError as error:
        raise InvalidObject("", f"this is not XML ({error})") from None
    if _tag(root) != "kml":
        raise InvalidObject("", f"the root element is {_tag(root)}, not kml")
    drafts = Drafts()
    for count, mark in enumerate(e for e in root.iter() if _tag(e) == "Placemark"):
        _read_placemark(drafts, mark, count)
    return drafts.result()


def _read_placemark(drafts: Drafts, mark: ElementTree.Element, count: int) -> None:
    title = _text(mark, "name") or f"placemark {count + 1}"
    described = drafts.described(title, _text(mark, "description"))
    polygons = [e for e in mark.iter() if _tag(e) == "Polygon"]
    others = sorted({_tag(e) for e in mark.iter()} & set(_OTHERS) - ({"LinearRing"} if polygons else set()))
    if others:
        drafts.note(title, f"{', '.join(others)} is not a zone; left out")
    drafts.unmapped(title, map(_tag, mark), _KNOWN | _LOOK | set(_OTHERS))
    for i, shape in enumerate(polygons):
        field = f"{title}: Polygon[{i}]"
        exterior = [_ring(e, f"{field}.outerBoundaryIs") for e in shape if _tag(e) == "outerBoundaryIs"]
        holes = [_ring(e, f"{field}.innerBoundaryIs") for e in shape if _tag(e) == "innerBoundaryIs"]
        if len(exterior) != 1:
            raise InvalidObject(f"{field}.outerBoundaryIs", "a polygon has exactly one")
        mode = _text(shape, "altitudeMode")
        if mode not in {"", "clampToGround"}:
            drafts.note(title, f"heights ({mode}) are not taken over; the zone reaches from the ground up")
        area = {"polygon": {"exterior": exterior[0]} | ({"holes": holes} if holes else {})}
        drafts.add(title, {"area": area} | ({"description": described} if described else {}))


def _ring(boundary: ElementTree.Element, field: str) -> list[dict[str, float]]:
    text = next((e.text or "" for e in boundary.iter() if _tag(e) == "coordinates"), "")
    try:
        positions = [[float(v) for v in group.split(",")] for group in text.split()]
    except ValueError:
        raise InvalidObject(f"{field}.coordinates", "must be lon,lat[,alt] groups") from None
    return ring(positions, f"{field}.coordinates")


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rsplit("}", 1)[-1]


def _text(element: ElementTree.Element, child: str) -> str:
    return next(((e.text or "").strip() for e in element if _tag(e) == child), "")


def write_kml(zones: Iterable[Zone]) -> Exported:
    """A document with a placemark for each zone, clamped to the ground."""
    zones = tuple(zones)
    marks = "".join(_placemark(zone) for zone in zones)
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n<Document>\n'
        f"{marks}</Document>\n</kml>\n"
    )
    return Exported(text, tuple(unsaid(zones, "altitude", "schedule", "circle")))


def _placemark(zone: Zone) -> str:
    exterior, *holes = area_rings(zone.spec.area)
    boundaries = _boundary("outerBoundaryIs", exterior) + "".join(_boundary("innerBoundaryIs", h) for h in holes)
    description = f"<description>{escape(zone.spec.description)}</description>" if zone.spec.description else ""
    return (
        f"<Placemark><name>{escape(zone.name)}</name>{description}\n"
        f"<Polygon><altitudeMode>clampToGround</altitudeMode>{boundaries}</Polygon></Placemark>\n"
    )


def _boundary(tag: str, points: list[list[float]]) -> str:
    coordinates = " ".join(f"{lon!r},{lat!r}" for lon, lat in points)
    return f"<{tag}><LinearRing><coordinates>{coordinates}</coordinates></LinearRing></{tag}>"
