"""The autopilot's own geofence: shapes, altitude band and home circle, and what a position breaches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fractus_mavlink.enums import FENCE_BREACH, FENCE_TYPE, MAV_CMD

NO_BREACH = FENCE_TYPE(0)
NAMES = {
    FENCE_TYPE.ALT_MAX: "Max Alt",
    FENCE_TYPE.CIRCLE: "Circle",
    FENCE_TYPE.POLYGON: "Polygon",
    FENCE_TYPE.ALT_MIN: "Min Alt",
}

Vertex = tuple[float, float]


def _to_edge_m(north: float, east: float, a: Vertex, b: Vertex) -> float:
    run_n, run_e = b[0] - a[0], b[1] - a[1]
    length2 = run_n * run_n + run_e * run_e
    share = 0.0 if length2 == 0.0 else ((north - a[0]) * run_n + (east - a[1]) * run_e) / length2
    share = min(1.0, max(0.0, share))
    return math.hypot(north - a[0] - share * run_n, east - a[1] - share * run_e)


class FenceShapeError(ValueError):
    """Fence items that do not form shapes."""


@dataclass(frozen=True, slots=True)
class Polygon:
    """A polygon in local metres (north, east)."""

    vertices: tuple[Vertex, ...]
    inclusion: bool

    def contains(self, north: float, east: float) -> bool:
        """Even-odd rule."""
        inside = False
        previous = self.vertices[-1]
        for vertex in self.vertices:
            if (vertex[1] > east) != (previous[1] > east):
                crossing = (previous[0] - vertex[0]) * (east - vertex[1]) / (previous[1] - vertex[1]) + vertex[0]
                if north < crossing:
                    inside = not inside
            previous = vertex
        return inside

    def edge_distance_m(self, north: float, east: float) -> float:
        """Distance to the nearest edge."""
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
        """Whether the point lies inside."""
        return math.hypot(north - self.north, east - self.east) <= self.radius_m

    def edge_distance_m(self, north: float, east: float) -> float:
        """Distance to the rim."""
        return abs(math.hypot(north - self.north, east - self.east) - self.radius_m)


Shape = Polygon | Circle


@dataclass(frozen=True, slots=True)
class FenceItem:
    """One uploaded item: command, first parameter, position in local metres."""

    command: int
    param1: float
    north: float
    east: float


def build_shapes(items: Sequence[FenceItem]) -> tuple[Shape, ...]:
    """Group the items of an upload into shapes.

    Raises:
        FenceShapeError: a polygon is incomplete or too small, a radius not positive, or a command foreign.
    """
    shapes: list[Shape] = []
    at = 0
    while at < len(items):
        item = items[at]
        if item.command in (MAV_CMD.NAV_FENCE_CIRCLE_INCLUSION, MAV_CMD.NAV_FENCE_CIRCLE_EXCLUSION):
            if not item.param1 > 0.0:
                raise FenceShapeError(f"fence item {at}: radius {item.param1} must be positive")
            inclusion = item.command == MAV_CMD.NAV_FENCE_CIRCLE_INCLUSION
            shapes.append(Circle(item.north, item.east, item.param1, inclusion))
            at += 1
        elif item.command in (
            MAV_CMD.NAV_FENCE_POLYGON_VERTEX_INCLUSION,
            MAV_CMD.NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
        ):
            count = int(item.param1)
            group = items[at : at + count]
            if count < 3 or len(group) < count or any(g.command != item.command or g.param1 != count for g in group):
                raise FenceShapeError(f"fence item {at}: polygon of {count} vertices is incomplete")
            inclusion = item.command == MAV_CMD.NAV_FENCE_POLYGON_VERTEX_INCLUSION
            shapes.append(Polygon(tuple((g.north, g.east) for g in group), inclusion))
            at += count
        elif item.command == MAV_CMD.NAV_FENCE_RETURN_POINT:
            at += 1
        else:
            raise FenceShapeError(f"fence item {at}: command {item.command} is no fence command")
    return tuple(shapes)


@dataclass(slots=True)
class Fence:
    """Settings, shapes and the breaches of the moment."""

    enabled: bool = False
    types: int = 7
    alt_max_m: float = 100.0
    alt_min_m: float = -10.0
    radius_m: float = 300.0
    shapes: tuple[Shape, ...] = ()
    breaches: FENCE_TYPE = NO_BREACH
    breach_count: int = 0
    breach_time_s: float = 0.0

    @property
    def present(self) -> bool:
        """Whether there is anything to enable: a limit, or a shape."""
        return bool(self.types & ~FENCE_TYPE.POLYGON) or (bool(self.types & FENCE_TYPE.POLYGON) and bool(self.shapes))

    def outside(self, north: float, east: float, altitude_m: float, home: Vertex = (0.0, 0.0)) -> FENCE_TYPE:
        """What a point (local metres, altitude above home) would breach if the fence is enabled."""
        found = NO_BREACH
        if not self.enabled:
            return found
        if self.types & FENCE_TYPE.ALT_MAX and altitude_m >= self.alt_max_m:
            found |= FENCE_TYPE.ALT_MAX
        if self.types & FENCE_TYPE.ALT_MIN and altitude_m <= self.alt_min_m:
            found |= FENCE_TYPE.ALT_MIN
        if self.types & FENCE_TYPE.CIRCLE and math.hypot(north - home[0], east - home[1]) >= self.radius_m:
            found |= FENCE_TYPE.CIRCLE
        if self.types & FENCE_TYPE.POLYGON and any(s.contains(north, east) != s.inclusion for s in self.shapes):
            found |= FENCE_TYPE.POLYGON
        return found

    def distance_m(self, north: float, east: float, altitude_m: float, home: Vertex = (0.0, 0.0)) -> float:
        """How far a point lies beyond the limits that it breaches, at least; 0 inside."""
        found = self.outside(north, east, altitude_m, home)
        beyond = [0.0]
        if FENCE_TYPE.ALT_MAX in found:
            beyond.append(altitude_m - self.alt_max_m)
        if FENCE_TYPE.ALT_MIN in found:
            beyond.append(self.alt_min_m - altitude_m)
        if FENCE_TYPE.CIRCLE in found:
            beyond.append(math.hypot(north - home[0], east - home[1]) - self.radius_m)
        if FENCE_TYPE.POLYGON in found:
            wrong = [shape for shape in self.shapes if shape.contains(north, east) != shape.inclusion]
            beyond += [shape.edge_distance_m(north, east) for shape in wrong]
        return max(beyond)

    def check(self, north: float, east: float, altitude_m: float, home: Vertex, now_s: float) -> FENCE_TYPE:
        """Update the breaches and return the new ones."""
        found = self.outside(north, east, altitude_m, home)
        new = found & ~self.breaches
        self.breaches = found
        if new:
            self.breach_count = min(self.breach_count + 1, 65535)
            self.breach_time_s = now_s
        return new

    @property
    def breach_type(self) -> FENCE_BREACH:
        """What FENCE_STATUS says of the breaches."""
        if self.breaches & FENCE_TYPE.ALT_MIN:
            return FENCE_BREACH.MINALT
        if self.breaches & FENCE_TYPE.ALT_MAX:
            return FENCE_BREACH.MAXALT
        return FENCE_BREACH.BOUNDARY if self.breaches else FENCE_BREACH.NONE


def breach_names(breaches: FENCE_TYPE) -> str:
    """The breaches as ArduPilot writes them: `Max Alt and Circle fences`."""
    names = [name for bit, name in NAMES.items() if breaches & bit]
    if len(names) <= 1:
        return f"{''.join(names)} fence".strip()
    return f"{', '.join(names[:-1])} and {names[-1]} fences"
