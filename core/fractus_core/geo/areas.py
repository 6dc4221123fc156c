"""Conversion between areas of manifests, shapely geometries in a local frame, and GeoJSON. Crossings of lines."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.api.geometry import Area, Circle, Point, Polygon, Position
from fractus_core.api.model import InvalidObject
from fractus_core.geo.distances import distance_m
from fractus_core.local_frame import LocalFrame

_SEGMENTS = (8, 32)
"""Minimum and maximum number of straight pieces that replace a quarter of a circle. The area is accurate to 0.4 %."""

_CORNER_M = 0.01
"""Distance of corners from their circle, which determines the number of pieces within the limits of `_SEGMENTS`."""

MAX_EXTENT_M = 1_000_000.0
"""Largest distance of a point of an area from its center. A local frame is meaningless beyond this distance."""

_MIN_CURVATURE_M = 6_335_000.0
"""Smallest radius of curvature of the ellipsoid."""

_SNAPPED = 1e-5
"""Share by which the radius of a corridor is enlarged.

GEOS merges corners that are closer than about a millionth of the radius, which would cut off the end of a short leg.
"""


def points_xy(frame: LocalFrame, points: Iterable[Point]) -> list[tuple[float, float]]:
    """Return metres east and north of each point."""
    return [frame.xy(p.lat, p.lon) for p in points]


def area_polygon(frame: LocalFrame, area: Area, *, within: bool = False) -> shapely.Polygon:
    """Return the area in metres east and north of the frame's origin. A circle is circumscribed.

    Args:
        frame: Frame of the result.
        area: Polygon or circle.
        within: True to inscribe a circle, so that the result never exceeds the circle.

    Raises:
        InvalidObject: A ring crosses itself or encloses nothing, or a hole leaves the exterior.
    """
    if area.circle is not None:
        return _circle(frame, area.circle, within=within)
    if area.polygon is None:
        raise InvalidObject("", "give either polygon or circle")
    return _polygon(frame, area.polygon)


def _circle(frame: LocalFrame, circle: Circle, *, within: bool) -> shapely.Polygon:
    x, y = frame.xy(circle.center.lat, circle.center.lon)
    radius_m, segments = _circumscribed(circle.radius)
    if within:
        # The frame shortens distances far from its origin, so a circle of the same radius in the frame would be too large.
        furthest = (math.hypot(x, y) + circle.radius) / _MIN_CURVATURE_M
        radius_m = circle.radius * math.sqrt(max(1.0 - furthest * furthest, 0.0))
    return shapely.Point(x, y).buffer(radius_m, quad_segs=segments)


def _polygon(frame: LocalFrame, spec: Polygon) -> shapely.Polygon:
    exterior = _ring(frame, spec.exterior, "polygon.exterior")
    holes = []
    for i, hole in enumerate(spec.holes):
        ring = _ring(frame, hole, f"polygon.holes[{i}]")
        if not exterior.covers(ring):
            raise InvalidObject(f"polygon.holes[{i}]", "the hole must lie inside the exterior")
        holes.append(ring.exterior.coords)
    shape = shapely.Polygon(exterior.exterior.coords, holes)
    if not shape.is_valid:
        raise InvalidObject("polygon.holes", f"holes must not cross each other ({shapely.is_valid_reason(shape)})")
    return shape


def _ring(frame: LocalFrame, ring: Sequence[Point], field: str) -> shapely.Polygon:
    shape = shapely.Polygon(points_xy(frame, ring))
    if not shape.is_valid:
        reason = shapely.is_valid_reason(shape)
        location = ""
        if "[" in reason:
            x, y = (float(v) for v in reason[reason.index("[") + 1 : reason.index("]")].split()[:2])
            lat, lon = frame.latlon(x, y)
            location = f" near lat {lat:.6f}, lon {lon:.6f}"
        raise InvalidObject(field, f"the ring crosses itself{location}; list the points in order around the area")
    if shape.area < 1e-6:
        raise InvalidObject(field, "the ring encloses no area; give at least three points that are not in line")
    return shape


def corridor(frame: LocalFrame, points: Iterable[Point], radius_m: float) -> BaseGeometry:
    """Return a path dilated by a radius in metres, with a circumscribed boundary.

    Legs are dilated one by one and then united, because dilating a path that crosses itself a thousand times takes
    minutes.
    """
    xy = points_xy(frame, points)
    ends = list(itertools.pairwise(xy)) or [(xy[0], xy[0])]
    legs = shapely.linestrings(np.asarray(ends))
    circumscribed, segments = _circumscribed(radius_m * (1 + _SNAPPED))
    united: BaseGeometry = shapely.union_all(shapely.buffer(legs, circumscribed, quad_segs=segments))
    return united


def _circumscribed(radius_m: float) -> tuple[float, int]:
    """Return the distance from the centre to the corners of a polygon around a circle, and the pieces per quarter."""
    needed = math.ceil(math.pi / 4 / math.acos(radius_m / (radius_m + _CORNER_M)))
    fewest, maximum = _SEGMENTS
    segments = min(max(needed, fewest), maximum)
    return radius_m / math.cos(math.pi / (4 * segments)), segments


def check_extent(area: Area) -> None:
    """Reject an area of continental size.

    Raises:
        InvalidObject: A point is too far away. The error names the first such point.
    """
    centre = area_center(area)
    for i, point in enumerate(area.polygon.exterior if area.polygon is not None else ()):
        if distance_m(centre, point) > MAX_EXTENT_M:
            problem = f"is more than {MAX_EXTENT_M / 1000:.0f} km from the middle; split the area"
            raise InvalidObject(f"polygon.exterior[{i}]", problem)


def area_center(area: Area) -> Point:
    """Return a point that serves as the origin of a frame for the area."""
    if area.circle is not None:
        return area.circle.center
    if area.polygon is None:
        raise InvalidObject("", "give either polygon or circle")
    return center_of(area.polygon.exterior)


def center_of(points: Iterable[Point]) -> Point:
    """Return the center of points on the sphere.

    The result is also correct across the antimeridian and near the poles.
    """
    rad = np.radians([(p.lat, p.lon) for p in points])
    lat = rad[:, 0]
    lon = rad[:, 1]
    vector = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]).mean(axis=1)
    if np.linalg.norm(vector) < 1e-9:
        return Point(lat=float(np.degrees(lat[0])), lon=float(np.degrees(lon[0])))
    return Point(
        lat=float(np.degrees(np.arctan2(vector[2], np.hypot(vector[0], vector[1])))),
        lon=float(np.degrees(np.arctan2(vector[1], vector[0]))),
    )


def areas_of_shape(frame: LocalFrame, shape: BaseGeometry) -> tuple[Area, ...]:
    """Return a (multi)polygon in metres as areas of the API."""
    return tuple(
        Area(
            polygon=Polygon(
                exterior=_points(frame, part.exterior),
                holes=tuple(_points(frame, hole) for hole in part.interiors),
            )
        )
        for part in shapely.get_parts(shape)
        if isinstance(part, shapely.Polygon) and not part.is_empty
    )


def multipolygon_geojson(frame: LocalFrame, shape: BaseGeometry) -> dict[str, Any]:
    """Return a (multi)polygon in metres as a GeoJSON MultiPolygon, lon before lat.

    The result is cut at the antimeridian (RFC 7946).
    """
    polygons = []
    for part in shapely.get_parts(shape):
        rings = [_unwrapped(frame, ring) for ring in (part.exterior, *part.interiors)]
        reference = rings[0][0][0]
        rings = [_shifted(ring, _near(ring[0][0], reference) - ring[0][0]) for ring in rings]
        whole = shapely.Polygon(rings[0], rings[1:])
        if any(_turns(ring) for ring in rings) or not whole.is_valid:
            # Use the precision of the output, because slivers left by a straight edge past the pole would round to
            # nothing.
            polygons += _parts(shapely.set_precision(part, 1e-7) for part in _parts(_cut(_beside_pole(rings))))
        else:
            polygons += _parts(_cut(whole))
    coordinates = [
        [[[round(x, 7), round(y, 7)] for x, y in ring.coords] for ring in (p.exterior, *p.interiors)]
        for p in (shapely.orient_polygons(q) for q in polygons)
    ]
    return {"type": "MultiPolygon", "coordinates": coordinates}


def line_geojson(points: Sequence[Point]) -> dict[str, Any]:
    """Return a polyline as a GeoJSON MultiLineString, lon before lat, cut at the antimeridian (RFC 7946)."""
    unwrapped: list[tuple[float, float]] = []
    for p in points:
        unwrapped.append((_near(p.lon, unwrapped[-1][0]) if unwrapped else p.lon, p.lat))
    lines = [part for part in _cut(shapely.LineString(unwrapped)) if part.length > 0]
    coordinates = [[[round(x, 7), round(y, 7)] for x, y in line.coords] for line in lines]
    return {"type": "MultiLineString", "coordinates": coordinates}


def _cut(shape: BaseGeometry) -> Iterator[BaseGeometry]:
    """Yield the parts of a shape that crosses the antimeridian, each with longitudes from -180 to 180."""
    for shift in (0.0, 360.0, -360.0):
        moved = shapely.transform(shape, lambda c, s=shift: c + np.array([s, 0.0]))
        yield from shapely.get_parts(moved.intersection(shapely.box(-180.0, -90.0, 180.0, 90.0)))


def _unwrapped(frame: LocalFrame, ring: BaseGeometry) -> list[tuple[float, float]]:
    """Return lon, lat of the points of a ring. Each longitude is within 180 degrees of the longitude before it."""
    lats, lons = frame.latlon_array(shapely.get_coordinates(ring))
    # Multiples of 360 degrees are exact numbers, so the ring stays closed.
    lons[1:] -= 360.0 * np.cumsum(np.round(np.diff(lons) / 360.0))
    return list(zip(lons.tolist(), lats.tolist(), strict=True))


def _parts(shapes: Iterable[BaseGeometry]) -> list[shapely.Polygon]:
    parts = shapely.get_parts(list(shapes))
    return [part for part in parts if isinstance(part, shapely.Polygon) and part.area > 0]


def _turns(ring: Sequence[tuple[float, float]]) -> bool:
    """Return True if an unwrapped ring encloses a pole. Its end is then 360 degrees from its start."""
    return abs(ring[-1][0] - ring[0][0]) > 180.0


def _beside_pole(rings: Iterable[Sequence[tuple[float, float]]]) -> BaseGeometry:
    """Return the area enclosed by rings in the longitude/latitude plane.

    No edge crosses the line that represents a pole in this plane.
    """
    exterior, *holes = rings
    # The longitudes of a hole may differ by 360 degrees from the longitudes of the exterior.
    turned = (_closed(_shifted(hole, shift)) for hole in holes for shift in (-360.0, 0.0, 360.0))
    return _closed(exterior).difference(shapely.union_all(list(turned)))


def _closed(ring: Sequence[tuple[float, float]]) -> BaseGeometry:
    over: list[tuple[float, float]] = []
    if _turns(ring):
        pole = math.copysign(90.0, sum(lat for _, lat in ring))
        over = [(ring[-1][0], pole), (ring[0][0], pole)]
    return shapely.make_valid(shapely.Polygon([*ring, *over]), method="structure", keep_collapsed=False)


def _shifted(ring: Sequence[tuple[float, float]], by: float) -> list[tuple[float, float]]:
    return [(lon + by, lat) for lon, lat in ring]


def _near(lon: float, reference: float) -> float:
    return lon + 360.0 * round((reference - lon) / 360.0)


def _points(frame: LocalFrame, ring: BaseGeometry) -> tuple[Point, ...]:
    """Return the corners of a ring without a repetition of the first corner."""
    lats, lons = frame.latlon_array(shapely.get_coordinates(ring)[:-1])
    return tuple(
        Point(lat=round(lat, 9), lon=round(lon, 9)) for lat, lon in zip(lats.tolist(), lons.tolist(), strict=True)
    )


def ground_point(position: Position) -> Point:
    """Return the point on the ground below a position."""
    return Point(lat=position.lat, lon=position.lon)


Line = npt.NDArray[np.float64]
"""The corners of a line in order, in metres, one per row."""

_AT_ONCE = 64
"""Number of pieces that are compared with all pieces in one step. For 30,000 pieces this makes a million pairs."""
_MAX_PAIRS = 2_500_000
"""Maximum number of pairs of pieces that are examined, which takes a second.

Two thousand parallel pieces reach the maximum.
"""


def count_crossings(lines: Sequence[Line], at_most: int) -> int:
    """Count the pairs of straight pieces that cross, within a line and between lines. Touching pieces do not count.

    The count is a cheap check before computations whose duration grows with the number of crossings. Pieces are looked
    up by their bounding boxes: n pieces with k nearby pairs cost O(n log n + k).

    Args:
        lines: Lines of two or more corners each.
        at_most: Count at which the search ends. A larger result means more crossings, or too many pairs to examine.
    """
    starts = np.concatenate([line[:-1] for line in lines]) if lines else np.empty((0, 2))
    ends = np.concatenate([line[1:] for line in lines]) if lines else np.empty((0, 2))
    pieces = shapely.linestrings(np.stack([starts, ends], axis=1)) if len(starts) else np.empty(0, dtype=object)
    tree = shapely.STRtree(pieces)
    count = 0
    examined = 0
    for first in range(0, len(pieces), _AT_ONCE):
        first_index, second_index = tree.query(pieces[first : first + _AT_ONCE])
        later = second_index > first_index + first
        first_index = first_index[later] + first
        second_index = second_index[later]
        examined += len(first_index)
        count += int(
            np.count_nonzero(_cross(starts[first_index], ends[first_index], starts[second_index], ends[second_index]))
        )
        if count > at_most or examined > _MAX_PAIRS:
            return at_most + 1
    return count


def _cross(a: Line, b: Line, c: Line, d: Line) -> npt.NDArray[np.bool_]:
    """Return True if the pieces from a to b cross the pieces from c to d.

    Two pieces cross if each piece has its ends on different sides of the other piece.
    """
    apart = _side(a, b, c) * _side(a, b, d) < 0
    return apart & (_side(c, d, a) * _side(c, d, b) < 0)


def _side(start: Line, end: Line, point: Line) -> npt.NDArray[np.float64]:
    """Return the side of the line from start to end on which a point lies: positive on the left."""
    direction = end - start
    offset = point - start
    return np.sign(direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0])
