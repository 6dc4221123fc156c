"""Common parts of zone import and export: names, rings, and notes on everything that cannot be represented."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
import shlex
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

import shapely

from fractus_core.api import API_VERSION, GROUP, InvalidObject, Zone
from fractus_core.api.geometry import MAX_RING_POINTS, Area, Circle, Point, Polygon
from fractus_core.documents import BadDocument, parse_documents
from fractus_core.geo.areas import area_center, area_polygon, center_of, multipolygon_geojson
from fractus_core.geo.formats.unknown_properties import EMPTY, may_state_limit
from fractus_core.local_frame import LocalFrame

DESCRIPTION_LENGTH = 1024
"""Longest description of a zone, in characters."""

IMPORTED_NAME = f"{GROUP}/imported-name"
"""Annotation of an imported Zone: the name of the zone in the file."""

MAX_RADIUS_M = 200_000.0
"""Largest radius of a circle."""

EARTH_RADIUS_M = 6_371_000.0
MAX_BEND_M = 0.5
"""Largest deviation of an edge from the straight line of degrees that GeoJSON defines. Longer edges get intermediate
points."""

MAX_POINTS = 300_000
"""Maximum number of points of all rings of a file, including intermediate points. Long edges in a small file may need
millions of intermediate points."""

_CLOSED = 0.05
"""A line encloses an area if the distance between its ends is at most this share of its length."""

CORNERS = 64
"""Number of corners of the polygon that replaces a circle in formats without circles."""


@dataclass(frozen=True, slots=True)
class Imported:
    """Imported zones, and a note for everything that was not imported."""

    zones: tuple[Zone, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Exported:
    """Content of a file, and a note for everything that the format cannot represent."""

    text: str
    notes: tuple[str, ...]


class InexactFeatures(InvalidObject):
    """Features that cannot be imported exactly. Field and problem are those of the first feature.

    Attributes:
        every: The problems of all these features.
    """

    def __init__(self, every: Sequence[InvalidObject]) -> None:
        super().__init__(every[0].field, every[0].problem)
        self.every = tuple(every)


class _TooLarge(InvalidObject):
    """The file as a whole is too large."""


@dataclass(frozen=True, slots=True)
class FeatureName:
    """Names of a feature of a file.

    Attributes:
        title: Name in messages and for `--leave-out`. It may depend on the order of the file.
        given: Name in the file. Several features may share it.
        identifier: Identifier of the authority, which stays the same in later versions of the file.
    """

    title: str
    given: str = ""
    identifier: str = ""


@dataclass(frozen=True, slots=True)
class _Part:
    """A zone of a feature, or the problem that prevents its import."""

    feature: FeatureName
    shape: Any
    zone: Zone | None
    problem: InvalidObject | None

    def names(self) -> Iterator[str]:
        """Yield names of the zone, the preferred one first.

        They depend on the feature alone: in an updated file, a zone keeps its name when other zones are added, removed
        or reordered, and another zone never gets its name.
        """
        feature = self.feature
        stem = _slug(feature.identifier or feature.given or "zone")
        if feature.identifier:
            same = stem == feature.identifier.lower()
            yield stem if same else f"{stem}-{_digest(feature.identifier)}"
        known = feature.identifier or feature.given
        yield f"{stem}-{_digest([known, self.shape])}"
        spec = self.zone.spec.to_dict() if self.zone is not None else None
        yield f"{stem}-{_digest([known, self.shape, spec])}"


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:45].strip("-") or "zone"


def _digest(value: Any) -> str:
    """Return a digest of a value. Numbers are rounded to 6 decimals (0.1 m), as programs write them differently."""
    text = json.dumps(_rounded(value), sort_keys=True, default=str)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:10]


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return round(float(value), 6) + 0.0 if is_number(value) and abs(value) < 1e15 else value


class ZoneBuilder:
    """Collects the zones of a file, gives each a unique and stable name, and validates them.

    A zone has exactly the area, altitude and time of the file, or the import fails. A larger exclusion zone would keep out
    permitted drones, and a larger inclusion zone would let drones leave the permitted area.

    Args:
        without: Titles of features, and names of zones, that are left out.
        drop: Names of properties that are left out although they may state the size, altitude or time of a zone.
    """

    def __init__(self, without: Collection[str] = (), drop: Collection[str] = ()) -> None:
        self.notes: list[str] = []
        self._drop = drop
        self._dropped: set[str] = set()
        self._points = 0
        self._parts: list[_Part] = []
        self._without = without
        self._left_out: set[str] = set()

    def take(self, feature: FeatureName, shape: Any, read: Callable[[], None]) -> None:
        """Read a feature, unless its title is in `without`. If it cannot be read, store the problem for `result`.

        Args:
            feature: Names of the feature.
            shape: Its geometry in the file, for its stable name.
            read: Function that adds its zones.
        """
        if feature.title in self._without:
            self._leave_out(feature.title, feature.title)
            return
        try:
            read()
        except _TooLarge:
            raise
        except InvalidObject as error:
            self._parts.append(_Part(feature, shape, None, error))

    def add(self, feature: FeatureName, shape: Any, location: str, build: Callable[[], Mapping[str, Any]]) -> None:
        """Add a zone of a feature. If it cannot be built, store the problem for `result`.

        Args:
            feature: Names of the feature.
            shape: Area and altitude of the zone in the file, for its stable name.
            location: Path of the zone in the file.
            build: Function that returns the spec of the Zone.
        """
        try:
            zone = _zone(build(), location)
        except _TooLarge:
            raise
        except InvalidObject as error:
            self._parts.append(_Part(feature, shape, None, error))
        else:
            self._parts.append(_Part(feature, shape, zone, None))

    def _leave_out(self, name: str, title: str) -> None:
        self._left_out.add(name)
        self.note(title, "left out as requested")

    def described(self, title: str, text: str) -> str:
        """Return the description of a zone, cut to the maximum length with a note."""
        if len(text) > DESCRIPTION_LENGTH:
            self.note(title, f"its description is cut after {DESCRIPTION_LENGTH} characters")
        return text[:DESCRIPTION_LENGTH]

    def rings(self, title: str, value: Any, field: str) -> dict[str, Any]:
        """Return the rings of a GeoJSON polygon as an area.

        Raises:
            InvalidObject: A ring is invalid, or the file has too many points.
        """
        if not isinstance(value, (list, tuple)) or not value:
            raise InvalidObject(field, "must be a list of rings")
        exterior, *holes = [self.ring(title, item, f"{field}[{i}]", planar=True) for i, item in enumerate(value)]
        return {"polygon": {"exterior": exterior} | ({"holes": holes} if holes else {})}

    def ring(self, title: str, value: Any, field: str, *, planar: bool = False) -> list[dict[str, float]]:
        """Return a ring of lon, lat as in `parse_ring`. A ring with too many points for a Zone is simplified with a note.

        Raises:
            InvalidObject: The ring is invalid, or the file has too many points.
        """
        points = value
        if isinstance(value, (list, tuple)) and len(value) > MAX_RING_POINTS:
            points = _simplified(value, field)
            if len(points) < len(value):
                self.note(
                    title,
                    f"a ring of {len(value)} points is simplified to {len(points)}, at most {MAX_BEND_M} m beside it",
                )
        ring = parse_ring(points, field, planar=planar)
        self._points += len(ring)
        if self._points > MAX_POINTS:
            raise _TooLarge(
                field, f"the file needs more than {MAX_POINTS} points, including points added on long sides; split it"
            )
        return ring

    def properties(self, title: str, properties: Mapping[str, Any], known: Collection[str], field: str) -> None:
        """Note the properties that a Zone cannot represent, and reject those that may state its size, altitude or time.

        Raises:
            InvalidObject: A property may state size, altitude or time and is not in `drop`.
        """
        self._dropped.update(set(properties) & set(self._drop))
        unknown = sorted(name for name in set(properties) - set(known) if properties[name] not in EMPTY)
        limits = [name for name in unknown if name not in self._drop and may_state_limit(name, properties[name])]
        if limits:
            first, *others = limits
            also = f" (also {', '.join(others)})" if others else ""
            drops = " ".join(f"--drop {shlex.quote(name)}" for name in limits)
            raise InvalidObject(
                f"{field}.{first}" if field else first,
                f"may state the size, altitude or time of the zone{also}; draw the size or give a Point its radius in metres,"
                f" write altitudes and times as altitude or schedule of a Zone, or ignore the property ({drops})",
            )
        if unknown:
            self.note(title, f"properties {', '.join(unknown)} cannot be imported; left out")

    def note(self, title: str, problem: str) -> None:
        """Note a part of a zone that is not imported."""
        self.notes.append(f"{title}: {problem}")

    def result(self) -> Imported:
        """Return the imported zones.

        Raises:
            InexactFeatures: Some features cannot be represented exactly.
            InvalidObject: A feature to leave out, or a property to drop, does not exist.
        """
        names = _stable_names(self._parts)
        titles = Counter(part.feature.title for part in self._parts)
        zones: dict[str, Zone] = {}
        imported: dict[str, _Part] = {}
        wrong: list[InvalidObject] = []
        for name, part in zip(names, self._parts, strict=True):
            title = part.feature.title
            if name in self._without:
                self._leave_out(name, f"{title} ({name})")
            elif part.problem is not None:
                where = title if titles[title] == 1 else f"{title}, --leave-out {name}"
                wrong.append(InvalidObject(part.problem.field, f"{part.problem.problem} (in {where})"))
            elif name in imported and [*part.names()][-1] == [*imported[name].names()][-1]:
                self.note(title, "occurs twice with the same area, altitude and times; imported once")
            elif name in imported:
                problem = f"another zone has the name {name}; give one of them another name or identifier (in {title})"
                wrong.append(InvalidObject("", problem))
            elif part.zone is not None:
                imported[name] = part
                zones[name] = _named(part.zone, name, part.feature)
        if wrong:
            raise InexactFeatures(wrong)
        missing = sorted(set(self._without) - self._left_out)
        if missing:
            raise InvalidObject("", f"there is no feature {missing[0]} to leave out; correct its name")
        absent = sorted(set(self._drop) - self._dropped)
        if absent:
            raise InvalidObject("", f"there is no property {absent[0]} to drop; correct its name")
        return Imported(tuple(zones.values()), tuple(self.notes))


def _stable_names(parts: Sequence[_Part]) -> list[str]:
    """Return the name of each part: its first name that no other part has, or its last name."""
    names = [""] * len(parts)
    pending = {i: list(part.names()) for i, part in enumerate(parts)}
    while pending:
        counts = Counter(choices[0] for choices in pending.values())
        for i, choices in tuple(pending.items()):
            if counts[choices[0]] == 1 or len(choices) == 1:
                names[i] = choices[0]
                del pending[i]
            else:
                del choices[0]
    return names


def _zone(spec: Mapping[str, Any], location: str) -> Zone:
    """Return a Zone without its final name.

    Raises:
        InvalidObject: Its area is broken, or a value is out of range.
    """
    manifest = {"apiVersion": API_VERSION, "kind": "Zone", "metadata": {"name": "zone"}, "spec": dict(spec)}
    try:
        zone = Zone.from_body(manifest)
        area_polygon(LocalFrame.at(area_center(zone.spec.area)), zone.spec.area)
    except InvalidObject as error:
        raise InvalidObject(location, f"{error.field.removeprefix('spec.')}: {error.problem}") from None
    return zone


def _named(zone: Zone, name: str, feature: FeatureName) -> Zone:
    annotations = {IMPORTED_NAME: feature.given[:DESCRIPTION_LENGTH]} if feature.given else {}
    metadata = zone.metadata.model_copy(update={"name": name, "annotations": annotations})
    return zone.model_copy(update={"metadata": metadata})


def parse_json(text: str) -> dict[str, Any]:
    """Parse a JSON object.

    Raises:
        InvalidObject: The text is not a JSON object.
    """
    try:
        (value,) = parse_documents(text.encode(), "", is_json=True).values or (None,)
    except BadDocument as error:
        raise InvalidObject(f"line {error.line}" if error.line else "", error.problem) from None
    if not isinstance(value, dict):
        raise InvalidObject("", "this is not a JSON object, which begins with {; export the file again")
    return value


def object_list(value: Any, field: str) -> list[dict[str, Any]]:
    """Return a list of JSON objects. A missing value is an empty list.

    Raises:
        InvalidObject: The value has another type.
    """
    if value is None:
        return []
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise InvalidObject(field, "must be a list of objects")
    return value


def optional_object(value: Any, field: str) -> dict[str, Any]:
    """Return a JSON object. A missing value is an empty object.

    Raises:
        InvalidObject: The value has another type.
    """
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InvalidObject(field, f"must be an object, not {_short_repr(value)}")
    return value


def reject_unknown_fields(fields: Mapping[str, Any], known: Collection[str], field: str) -> None:
    """Reject unknown fields with a value.

    Raises:
        InvalidObject: An unknown field has a value.
    """
    for key, value in fields.items():
        if key not in known and value not in EMPTY:
            raise InvalidObject(
                f"{field}.{key}" if field else key,
                "a Zone cannot represent this field; remove it if it does not affect the zone",
            )


def is_number(value: Any) -> TypeGuard[float]:
    """Return True for a number. Booleans are not numbers."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _short_repr(value: Any) -> str:
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**12 else "a number of many digits"
    return text if len(text) <= 40 else text[:37] + "..."


def parse_point(value: Any, field: str, *, lat_first: bool = False) -> Point:
    """Return a pair of degrees as a point.

    Raises:
        InvalidObject: The value is not a pair of numbers, or is out of range.
    """
    pair = value if isinstance(value, (list, tuple)) else ()
    if len(pair) < 2 or not all(map(is_number, pair[:2])):
        raise InvalidObject(field, "must be two numbers, degrees")
    if any(pair[2:]):
        raise InvalidObject(field, "has a height; remove the heights and state them in the altitude of the zone")
    lat, lon = (pair[0], pair[1]) if lat_first else (pair[1], pair[0])
    if not (-90 <= lat <= 90 and -180 <= lon <= 180):
        order = "lat, lon" if lat_first else "lon, lat"
        raise InvalidObject(
            field, f"{_short_repr(pair[0])}, {_short_repr(pair[1])} is not a place on Earth; the order is {order}"
        )
    return Point(lat=lat, lon=lon)


def parse_ring(value: Any, field: str, *, lat_first: bool = False, planar: bool = False) -> list[dict[str, float]]:
    """Return a ring in the form of manifests: its points in order, without the repetition of the first point.

    Args:
        value: The ring.
        field: Its path in the file.
        lat_first: True if latitude comes first.
        planar: True if its edges are straight in longitude and latitude. Such edges never cross the antimeridian.

    Raises:
        InvalidObject: The ring has fewer than three points or an invalid point, crosses the antimeridian although it is
            planar, or has sides that need too many intermediate points.
    """
    if not isinstance(value, (list, tuple)):
        raise InvalidObject(field, "must be a list of positions")
    points = [parse_point(p, f"{field}[{i}]", lat_first=lat_first) for i, p in enumerate(value)]
    if len(points) > 1 and points[0] == points[-1]:
        points = points[:-1]
    if len(points) < 3:
        raise InvalidObject(field, "a ring needs at least three points")
    if planar and any(abs(a.lon - b.lon) > 180 for a, b in itertools.pairwise([*points, points[0]])):
        raise InvalidObject(field, "crosses the antimeridian; cut it there, into two polygons (RFC 7946)")
    if len(points) > MAX_RING_POINTS:
        raise InvalidObject(
            field, f"has {len(points)} points, more than {MAX_RING_POINTS}; simplify the ring, or split the area"
        )
    if planar:
        sides = list(itertools.pairwise([*points, points[0]]))
        if sum(_pieces(*side) for side in sides) > MAX_RING_POINTS:
            raise InvalidObject(field, f"has sides so long that they need more than {MAX_RING_POINTS} points; split it")
        points = list(_along_degrees(sides))
    return [p.to_dict() for p in points]


def _simplified(ring: Sequence[Any], field: str) -> list[tuple[float, float]]:
    """Return a ring of lon, lat with fewer points. Omitted points lie within `MAX_BEND_M` of the resulting ring.

    Algorithm: Douglas-Peucker (GEOS), O(n log n), in metres around the middle of the ring.

    Raises:
        InvalidObject: A point is invalid.
    """
    points = [parse_point(position, f"{field}[{i}]") for i, position in enumerate(ring)]
    frame = LocalFrame.at(center_of(points))
    places = [frame.xy(point.lat, point.lon) for point in points]
    kept = shapely.simplify(shapely.Polygon(places), MAX_BEND_M, preserve_topology=True)
    by_place = dict(zip(places, ((point.lon, point.lat) for point in points), strict=True))
    return [by_place[place] for place in kept.exterior.coords]


def _pieces(start: Point, end: Point) -> int:
    """Return into how many parts to divide a straight line in degrees, so that each part bends by at most `MAX_BEND_M`."""
    lat = math.radians(min(max(abs(start.lat), abs(end.lat)), 89.0))
    lon_deg = abs(end.lon - start.lon)
    width_m = math.radians(min(lon_deg, 360.0 - lon_deg)) * math.cos(lat) * EARTH_RADIUS_M
    return max(math.ceil(math.sqrt(width_m**2 * math.tan(lat) / (8 * EARTH_RADIUS_M) / MAX_BEND_M)), 1)


def _along_degrees(sides: Iterable[tuple[Point, Point]]) -> Iterator[Point]:
    """Yield the corners of a ring, and intermediate points on straight lines of degrees that bend."""
    for start, end in sides:
        yield start
        pieces = _pieces(start, end)
        for share in (i / pieces for i in range(1, pieces)):
            lat_deg, lon_deg = (a + (b - a) * share for a, b in ((start.lat, end.lat), (start.lon, end.lon)))
            yield Point(lat=round(lat_deg, 9), lon=round(lon_deg, 9))


def reject_outlines(lines: Iterable[Sequence[tuple[float, float]]], field: str) -> None:
    """Reject lines of lon, lat that enclose an area, such as the outline of a zone that was drawn as a path.

    Outlines that were drawn by hand do not close exactly: the ends of a line meet if their distance is at most 5 % of its
    length.

    Raises:
        InvalidObject: A line, or several lines joined at their ends, enclose an area.
    """
    drawn = [shapely.LineString(line) for line in lines if len(line) > 1]
    for line in shapely.get_parts(shapely.line_merge(shapely.MultiLineString(drawn))):
        ends = shapely.Point(line.coords[0]).distance(shapely.Point(line.coords[-1]))
        if len(line.coords) > 3 and ends <= _CLOSED * line.length:
            raise InvalidObject(field, "is a line around an area; draw the area as a polygon")


def circle_area(centre: Point, radius_m: Any, field: str) -> dict[str, Any]:
    """Return a circle as an area.

    Raises:
        InvalidObject: The radius is not a length.
    """
    if not is_number(radius_m) or not 0 < radius_m <= MAX_RADIUS_M:
        raise InvalidObject(
            field, f"must be above 0 and at most {MAX_RADIUS_M:.0f} metres, not {_short_repr(radius_m)}"
        )
    return {"circle": {"center": centre.to_dict(), "radius": float(radius_m)}}


def area_rings(area: Area) -> list[list[list[float]]]:
    """Return closed rings of an area, lon before lat. A circle becomes a polygon around it."""
    shape = area.polygon if area.polygon is not None else _circumscribed(area.circle)
    closed = []
    for points in (shape.exterior, *shape.holes):
        pairs = [[p.lon, p.lat] for p in points]
        closed.append([*pairs, pairs[0]])
    return closed


def cut_rings(zone: Zone, notes: list[str]) -> list[list[list[list[float]]]]:
    """Return closed rings of the parts of an area, cut at the antimeridian. Adds a note if it is cut.

    Long sides get intermediate points, so that programs that draw them as straight lines of degrees deviate from the zone by
    at most `MAX_BEND_M`.
    """
    frame = LocalFrame.at(area_center(zone.spec.area))
    outline = [_with_points_between(frame, ring) for ring in area_rings(zone.spec.area)]
    crossings = sum(abs(a[0] - b[0]) > 180 for a, b in itertools.pairwise(outline[0]))
    if crossings % 2:
        notes.append(f"{zone.name}: it contains a pole; programs that draw a flat map display it incorrectly")
    elif crossings:
        notes.append(f"{zone.name}: it crosses the antimeridian and is cut there, into parts")
        exterior, *holes = [[frame.xy(lat, lon) for lon, lat in ring] for ring in outline]
        parts: list[list[list[list[float]]]] = multipolygon_geojson(frame, shapely.Polygon(exterior, holes))[
            "coordinates"
        ]
        return parts
    return [outline]


def _with_points_between(frame: LocalFrame, ring: list[list[float]]) -> list[list[float]]:
    """Return a closed ring of lon, lat with points on the sides that bend between degrees."""
    points = []
    for start, end in itertools.pairwise(ring):
        points.append(start)
        pieces = _pieces(Point(lat=start[1], lon=start[0]), Point(lat=end[1], lon=end[0]))
        start_xy = frame.xy(start[1], start[0])
        end_xy = frame.xy(end[1], end[0])
        for share in (i / pieces for i in range(1, pieces)):
            lat, lon = frame.latlon(*(a + (b - a) * share for a, b in zip(start_xy, end_xy, strict=True)))
            points.append([round(lon, 9), round(lat, 9)])
    return [*points, ring[-1]]


def reject_poles(zones: Iterable[Zone], problem: str) -> None:
    """Reject polygons around a pole for formats whose edges are straight lines of degrees.

    Raises:
        InvalidObject: A zone contains a pole.
    """
    for zone in zones:
        (outline, *_) = area_rings(zone.spec.area)
        if sum(abs(a[0] - b[0]) > 180 for a, b in itertools.pairwise(outline)) % 2:
            raise InvalidObject(f"{zone.name}: spec.area", f"contains a pole, {problem}; export it to kml or qgc-plan")


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


def unsupported_parts(zones: Iterable[Zone], *parts: str) -> list[str]:
    """Return notes on the parts of zones that a format cannot represent.

    Args:
        zones: Zones to check.
        parts: Parts that the format lacks: altitude, schedule, holes, circle, description.
    """
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
