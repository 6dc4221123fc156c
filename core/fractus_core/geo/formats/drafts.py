"""What reading and writing zones has in common: names, rings, and a note of everything that does not map."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

from fractus_core.api import API_VERSION, InvalidObject, Zone
from fractus_core.api.geometry import Area, Circle, Point, Polygon
from fractus_core.geo.areas import middle, polygon
from fractus_core.geo.frames import LocalFrame

LonLat = Sequence[float]

DESCRIPTION_LENGTH = 1024
"""Characters that the description of a zone takes."""

MAX_RADIUS_M = 200_000.0
"""Of a circle."""

CORNERS = 64
"""Corners of the polygon that stands for a circle where a format has none."""


@dataclass(frozen=True, slots=True)
class Imported:
    """Zones that were read, and a sentence for everything that was not taken over."""

    zones: tuple[Zone, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Exported:
    """A file, and a sentence for everything that the format cannot say."""

    text: str
    notes: tuple[str, ...]


class Drafts:
    """Zones while a file is read: each gets a name of its own, and is checked as it is made."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self._zones: list[Zone] = []
        self._names: set[str] = set()

    def add(self, title: str, spec: Mapping[str, Any]) -> None:
        """Make a zone.

        Raises:
            InvalidObject: its area is broken, or something is out of range; the field begins with the title.
        """
        name = self._name(title)
        manifest = {"apiVersion": API_VERSION, "kind": "Zone", "metadata": {"name": name}, "spec": dict(spec)}
        try:
            zone = Zone.from_body(manifest)
            polygon(LocalFrame.at(middle(zone.spec.area)), zone.spec.area)
        except InvalidObject as error:
            raise InvalidObject(f"{title}: {error.field}".rstrip(": "), error.problem) from None
        self._zones.append(zone)

    def described(self, title: str, text: str) -> str:
        """The description of a zone, as long as it may be; notes if that cuts it."""
        if len(text) > DESCRIPTION_LENGTH:
            self.note(title, f"its description is cut after {DESCRIPTION_LENGTH} characters")
        return text[:DESCRIPTION_LENGTH]

    def unmapped(self, title: str, found: Iterable[str], known: Iterable[str]) -> None:
        """Note the fields for which a zone has no place."""
        dropped = sorted(set(found) - set(known))
        if dropped:
            self.note(title, f"no place for {', '.join(dropped)}; left out")

    def note(self, title: str, problem: str) -> None:
        """Say what of a zone is not taken over."""
        self.notes.append(f"{title}: {problem}")

    def result(self) -> Imported:
        """All that was read."""
        return Imported(tuple(self._zones), tuple(self.notes))

    def _name(self, title: str) -> str:
        stem = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:56].strip("-") or "zone"
        name, count = stem, 1
        while name in self._names:
            count += 1
            name = f"{stem}-{count}"
        self._names.add(name)
        return name


def parse_json(text: str) -> dict[str, Any]:
    """A JSON object.

    Raises:
        InvalidObject: it is none.
    """
    try:
        found = json.loads(text.removeprefix("\ufeff"))
    except json.JSONDecodeError as error:
        raise InvalidObject(f"line {error.lineno}", f"this is not JSON ({error.msg.lower()})") from None
    except RecursionError:
        raise InvalidObject("", "its lists or objects are nested too deeply") from None
    except ValueError:
        raise InvalidObject("", "a number in it has thousands of digits") from None
    if not isinstance(found, dict):
        raise InvalidObject("", "this is not a JSON object")
    return found


def objects(found: Any, field: str) -> list[dict[str, Any]]:
    """A list of JSON objects; absent is empty.

    Raises:
        InvalidObject: it is something else.
    """
    if found is None:
        return []
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        raise InvalidObject(field, "must be a list of objects")
    return found


def fields(found: Any, field: str) -> dict[str, Any]:
    """A JSON object; absent is empty.

    Raises:
        InvalidObject: it is something else.
    """
    if found is None:
        return {}
    if not isinstance(found, dict):
        raise InvalidObject(field, f"must be an object, not {_shown(found)}")
    return found


def number(found: Any) -> TypeGuard[float]:
    """Whether this is a number; true and false are none."""
    return isinstance(found, (int, float)) and not isinstance(found, bool)


def _shown(found: Any) -> str:
    text = repr(found) if not isinstance(found, int) or abs(found) < 10**12 else "a number of many digits"
    return text if len(text) <= 40 else text[:37] + "..."


def place(found: Any, field: str, *, lat_first: bool = False) -> Point:
    """A pair of degrees as a point.

    Raises:
        InvalidObject: it is none, or out of range.
    """
    pair = found if isinstance(found, (list, tuple)) else ()
    if len(pair) < 2 or not all(map(number, pair[:2])):
        raise InvalidObject(field, "must be two numbers, degrees")
    lat, lon = (pair[0], pair[1]) if lat_first else (pair[1], pair[0])
    if not (-90 <= lat <= 90 and -180 <= lon <= 180):
        order = "lat, lon" if lat_first else "lon, lat"
        raise InvalidObject(
            field, f"{_shown(pair[0])}, {_shown(pair[1])} is not a place on Earth; the order is {order}"
        )
    return Point(lat=lat, lon=lon)


def ring(found: Any, field: str, *, lat_first: bool = False) -> list[dict[str, float]]:
    """A ring as manifests spell it: open, without the repetition of its first point.

    Raises:
        InvalidObject: it has fewer than three points, or one that is none.
    """
    if not isinstance(found, (list, tuple)):
        raise InvalidObject(field, "must be a list of positions")
    points = [place(p, f"{field}[{i}]", lat_first=lat_first) for i, p in enumerate(found)]
    if len(points) > 1 and points[0] == points[-1]:
        points = points[:-1]
    if len(points) < 3:
        raise InvalidObject(field, "a ring needs at least three points")
    return [p.to_dict() for p in points]


def rings(found: Any, field: str) -> dict[str, Any]:
    """The rings of a GeoJSON polygon as an area.

    Raises:
        InvalidObject: one of them is none.
    """
    if not isinstance(found, (list, tuple)) or not found:
        raise InvalidObject(field, "must be a list of rings")
    exterior, *holes = [ring(r, f"{field}[{i}]") for i, r in enumerate(found)]
    return {"polygon": {"exterior": exterior} | ({"holes": holes} if holes else {})}


def round_area(centre: Point, radius_m: Any, field: str) -> dict[str, Any]:
    """A circle as an area.

    Raises:
        InvalidObject: the radius is not a length.
    """
    if not number(radius_m) or not 0 < radius_m <= MAX_RADIUS_M:
        raise InvalidObject(field, f"must be 0 to {MAX_RADIUS_M:.0f} metres, not {_shown(radius_m)}")
    return {"circle": {"center": centre.to_dict(), "radius": float(radius_m)}}


def area_rings(area: Area) -> list[list[list[float]]]:
    """Closed rings of an area, lon before lat; a circle becomes a polygon around it."""
    shape = area.polygon if area.polygon is not None else _circumscribed(area.circle)
    closed = []
    for points in (shape.exterior, *shape.holes):
        pairs = [[p.lon, p.lat] for p in points]
        closed.append([*pairs, pairs[0]])
    return closed


def _circumscribed(circle: Circle | None) -> Polygon:
    if circle is None:
        raise InvalidObject("area", "give either polygon or circle")
    frame = LocalFrame.at(circle.center)
    reach = circle.radius / math.cos(math.pi / CORNERS)
    points = []
    for i in range(CORNERS):
        bearing = 2 * math.pi * i / CORNERS
        lat, lon = frame.latlon(reach * math.cos(bearing), reach * math.sin(bearing))
        points.append(Point(lat=round(lat, 9), lon=round(lon, 9)))
    return Polygon(exterior=tuple(points))


def unsaid(zones: Iterable[Zone], *parts: str) -> list[str]:
    """Notes of the parts of zones that a format cannot say: altitude, schedule, holes, circle, description."""
    notes = []
    for zone in zones:
        spec = zone.spec
        has = {
            "altitude": spec.altitude is not None,
            "schedule": bool(spec.schedule),
            "holes": spec.area.polygon is not None and bool(spec.area.polygon.holes),
            "description": bool(spec.description),
        }
        lost = [part for part in parts if has.get(part)]
        if lost:
            notes.append(f"{zone.name}: the format has no {' and no '.join(lost)}; left out")
        if "circle" in parts and spec.area.circle is not None:
            notes.append(f"{zone.name}: the circle is written as a polygon of {CORNERS} corners around it")
    return notes
