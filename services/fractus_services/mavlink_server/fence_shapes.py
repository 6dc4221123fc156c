"""Shapes of a fence, built from its uploaded items as ArduCopter does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Vertex = tuple[float, float]


def _to_edge_m(north: float, east: float, a: Vertex, b: Vertex) -> float:
    run_n = b[0] - a[0]
    run_e = b[1] - a[1]
    length2 = run_n * run_n + run_e * run_e
    share = 0.0 if length2 == 0.0 else ((north - a[0]) * run_n + (east - a[1]) * run_e) / length2
    share = min(1.0, max(0.0, share))
    return math.hypot(north - a[0] - share * run_n, east - a[1] - share * run_e)


def _ahead_m(position: Vertex, course: Vertex, a: Vertex, b: Vertex) -> float | None:
    """Return the distance along a course to its intersection with an edge.

    Return None if it does not intersect the edge.
    """
    run_n = b[0] - a[0]
    run_e = b[1] - a[1]
    turn = course[0] * run_e - course[1] * run_n
    if abs(turn) < 1e-9:
        return None
    to_n = a[0] - position[0]
    to_e = a[1] - position[1]
    ahead = (to_n * run_e - to_e * run_n) / turn
    share = (to_n * course[1] - to_e * course[0]) / turn
    return ahead if ahead >= 0.0 and 0.0 <= share <= 1.0 else None


class FenceShapeError(ValueError):
    """The fence items do not form valid shapes."""


@dataclass(frozen=True, slots=True)
class Polygon:
    """A polygon in local metres (north, east)."""

    vertices: tuple[Vertex, ...]
    inclusion: bool

    def contains(self, north: float, east: float) -> bool:
        """Return True if the point is inside (even-odd rule)."""
        inside = False
        previous = self.vertices[-1]
        for vertex in self.vertices:
            if (vertex[1] > east) != (previous[1] > east):
                crossing = (previous[0] - vertex[0]) * (east - vertex[1]) / (previous[1] - vertex[1]) + vertex[0]
                if north < crossing:
                    inside = not inside
            previous = vertex
        return inside

    def distance_along_m(self, position: Vertex, course: Vertex) -> float | None:
        """Return the distance along a course to the first edge, or None."""
        edges = zip(self.vertices, (*self.vertices[1:], self.vertices[0]), strict=True)
        return min((d for a, b in edges if (d := _ahead_m(position, course, a, b)) is not None), default=None)

    def edge_distance_m(self, north: float, east: float) -> float:
        """Return the distance to the nearest edge in metres."""
        edges = zip(self.vertices, (*self.vertices[1:], self.vertices[0]), strict=True)
        return min(_to_edge_m(north, east, a, b) for a, b in edges)


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle in local metres."""

    north: float
    east: float
    radius_m: float
    inclusion: bool

    def contains(self, north: float, east: float) -> bool:
        """Return True if the point is inside."""
        return math.hypot(north - self.north, east - self.east) <= self.radius_m

    def distance_along_m(self, position: Vertex, course: Vertex) -> float | None:
        """Return the distance along a course to the rim, or None."""
        north = position[0] - self.north
        east = position[1] - self.east
        along = north * course[0] + east * course[1]
        square = along * along - (north * north + east * east - self.radius_m * self.radius_m)
        if square < 0.0:
            return None
        distances = (-along - math.sqrt(square), -along + math.sqrt(square))
        return min((distance for distance in distances if distance >= 0.0), default=None)

    def edge_distance_m(self, north: float, east: float) -> float:
        """Return the distance to the rim in metres."""
        return abs(math.hypot(north - self.north, east - self.east) - self.radius_m)


Shape = Polygon | Circle


@dataclass(frozen=True, slots=True)
class FenceItem:
    """One uploaded fence item.

    Attributes:
        command: MAV_CMD of the item.
        param1: Vertex count or radius in metres.
        north: Local position in metres.
        east: Local position in metres.
        valid: False if latitude or longitude is out of range.
    """

    command: int
    param1: float
    north: float
    east: float
    valid: bool = True


def build_shapes(items: Sequence[FenceItem]) -> tuple[Shape, ...]:
    """Build fence shapes from the items of an upload.

    Raises:
        FenceShapeError: The items do not form valid shapes. The message is ArduPilot's STATUSTEXT.
    """
    shapes: list[Shape] = []
    if sum(item.command == mavlink.MAV_CMD_NAV_FENCE_RETURN_POINT for item in items) > 1:
        raise FenceShapeError("Multiple return points")
    at = 0
    while at < len(items):
        item = items[at]
        if not item.valid:
            raise FenceShapeError("Bad lat or lon")
        if item.command in (mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION):
            # ArduPilot SITL aborts if the radius is NaN.
            if not item.param1 > 0.0:
                raise FenceShapeError("Non-positive circle radius")
            inclusion = item.command == mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION
            shapes.append(Circle(item.north, item.east, item.param1, inclusion))
            at += 1
        elif item.command in (
            mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION,
            mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
        ):
            group = _vertices(items, at)
            inclusion = item.command == mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
            shapes.append(Polygon(tuple((g.north, g.east) for g in group), inclusion))
            at += len(group)
        elif item.command == mavlink.MAV_CMD_NAV_FENCE_RETURN_POINT:
            at += 1
        else:
            raise FenceShapeError(f"Bad command ({item.command})")
    return tuple(shapes)


def _vertices(items: Sequence[FenceItem], at: int) -> Sequence[FenceItem]:
    """Return the vertices of the polygon that starts at index `at`."""
    first = items[at]
    count = int(first.param1) if math.isfinite(first.param1) else 0
    if count < 3:
        raise FenceShapeError(f"Invalid vertex count ({count})")
    group = items[at : at + count]
    for other in group:
        if other.command != first.command:
            raise FenceShapeError("Incorrect item count")
        if other.param1 != first.param1:
            raise FenceShapeError(f"Unexpected vertex count want={count} got={other.param1:.0f}\n")
        if not other.valid:
            raise FenceShapeError("Bad lat or lon")
    if len(group) < count:
        raise FenceShapeError("Incorrect item count")
    return group
