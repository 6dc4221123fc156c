"""Waypoints that cover a region with parallel lines."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import shapely
from shapely.affinity import rotate

from fractus.control_point import Circle, Region
from fractus.errors import InvalidRequest
from fractus.mission import EARTH_M, Waypoint
from fractus.values import AltitudeReference, Position

MAX_LINES = 2000
"""Largest number of lines. A smaller spacing is probably a mistake in the unit."""

_TOLERANCE_M = 1e-3
"""Distance by which a leg may leave the region. It covers the rounding errors of rotated coordinates."""


def survey(
    region: Region,
    spacing_m: float,
    altitude_m: float,
    *,
    margin_m: float | None = None,
    heading_deg: float | None = None,
    reference: AltitudeReference = AltitudeReference.HOME,
    speed_mps: float | None = None,
) -> tuple[Waypoint, ...]:
    """Return waypoints on parallel lines that cover a region: `await drone.mission(fractus.survey(region, 20, 30))`.

    All legs stay inside the region, also those between two lines. The extra `geometry` of fractus-drones must be installed;
    the base image of components contains it.

    Args:
        region: Region of the control point (`control.task.region`), up to about ten kilometres wide.
        spacing_m: Distance between two lines in metres: the width that the camera sees on the ground, less the overlap.
        altitude_m: Altitude of all waypoints in metres above `reference`.
        margin_m: Distance of the lines from the border of the region in metres; by default half the spacing.
        heading_deg: Direction of the lines in degrees clockwise from true north; by default the one with the fewest lines.
        reference: Datum of the altitude.
        speed_mps: Speed of the legs; by default the current speed setting.

    Returns:
        Both ends of each line, in flight order.

    Raises:
        InvalidRequest: An argument is out of range, or the legs would leave the region.
    """
    margin = spacing_m / 2 if margin_m is None else margin_m
    if not 0 < spacing_m < math.inf:
        raise InvalidRequest(f"survey: spacing_m must be above 0 m, not {spacing_m}")
    if not 0 <= margin < math.inf:
        raise InvalidRequest(f"survey: margin_m must be at least 0 m, not {margin}")
    if not math.isfinite(altitude_m):
        raise InvalidRequest(f"survey: altitude_m must be a number of metres, not {altitude_m}")
    frame = _Frame(region.center if isinstance(region, Circle) else region.exterior[0])
    area = _area(region, frame)
    inside = area.buffer(-margin)
    if inside.is_empty:
        raise InvalidRequest(
            f"survey: no point of the region is {margin:g} m from its border; decrease margin_m or spacing_m"
        )
    headings = _headings(inside) if heading_deg is None else [heading_deg]
    candidates = sorted((_lines(inside, heading, spacing_m) for heading in headings), key=len)
    for lines in candidates:
        path = _path(lines)
        if shapely.LineString(path).within(area.buffer(_TOLERANCE_M)):
            return tuple(Waypoint(frame.position(*point, altitude_m, reference), speed_mps=speed_mps) for point in path)
    raise InvalidRequest(
        "survey: a leg between two lines would leave the region, because of a hole or a concave border; "
        "split the region into parts, or set heading_deg"
    )


class _Frame:
    """Flat frame around an origin: metres east and north."""

    def __init__(self, origin: Position) -> None:
        self._lat = origin.lat
        self._lon = origin.lon
        self._east_m = EARTH_M * math.cos(math.radians(origin.lat))

    def metres(self, point: Position) -> tuple[float, float]:
        east_deg = (point.lon - self._lon + 180.0) % 360.0 - 180.0
        return math.radians(east_deg) * self._east_m, math.radians(point.lat - self._lat) * EARTH_M

    def position(self, east: float, north: float, alt: float, reference: AltitudeReference) -> Position:
        lon = (self._lon + math.degrees(east / self._east_m) + 180.0) % 360.0 - 180.0
        return Position(self._lat + math.degrees(north / EARTH_M), lon, alt, reference)


def _area(region: Region, frame: _Frame) -> shapely.Polygon:
    if isinstance(region, Circle):
        # The polygon of a buffer lies inside the circle.
        return shapely.Point(0, 0).buffer(region.radius_m, quad_segs=64)
    rings: list[Sequence[Position]] = [region.exterior, *region.holes]
    exterior, *holes = ([frame.metres(corner) for corner in ring] for ring in rings)
    area = shapely.Polygon(exterior, holes)
    if not area.is_valid:
        raise InvalidRequest("survey: the border of the region crosses itself")
    return area


def _headings(area: shapely.Geometry) -> Iterable[float]:
    """Return the directions of the edges of the convex hull. For a convex area, one of them has the fewest lines."""
    corners = shapely.get_coordinates(area.convex_hull)
    return {
        round(math.degrees(math.atan2(x2 - x1, y2 - y1)) % 180.0, 3)
        for (x1, y1), (x2, y2) in itertools.pairwise(corners)
    }


def _lines(area: shapely.Geometry, heading_deg: float, spacing_m: float) -> list[shapely.LineString]:
    """Return the lines through an area, from one side to the other."""
    turned = rotate(area, heading_deg, origin=(0, 0))  # now the lines run north
    west, south, east, north = turned.bounds
    count = math.floor((east - west) / spacing_m) + 1
    if count > MAX_LINES:
        raise InvalidRequest(f"survey: {count} lines are more than {MAX_LINES}; increase spacing_m ({spacing_m:g})")
    first = (west + east - (count - 1) * spacing_m) / 2
    scans = (
        shapely.LineString([(x, south - 1), (x, north + 1)]) for x in (first + i * spacing_m for i in range(count))
    )
    found = (part for scan in scans for part in shapely.get_parts(scan.intersection(turned)))
    return [rotate(part, -heading_deg, origin=(0, 0)) for part in found if isinstance(part, shapely.LineString)]


def _path(lines: Sequence[shapely.LineString]) -> list[tuple[float, float]]:
    """Return the ends of the lines in flight order. Every line starts at the end that is closer to the line before."""
    path: list[tuple[float, float]] = []
    for line in lines:
        ends = [(float(x), float(y)) for x, y in line.coords]
        if path and math.dist(path[-1], ends[-1]) < math.dist(path[-1], ends[0]):
            ends.reverse()
        path += ends
    return path
