"""Geofence of the autopilot: shapes, altitude limits, home circle and the breaches of a position."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from fractus_services.mavlink_server.fence_shapes import Circle, Shape, Vertex
from pymavlink.dialects.v20 import ardupilotmega as mavlink

NO_BREACH = 0
NAMES = {
    mavlink.FENCE_TYPE_ALT_MAX: "Max Alt",
    mavlink.FENCE_TYPE_CIRCLE: "Circle",
    mavlink.FENCE_TYPE_POLYGON: "Polygon",
    mavlink.FENCE_TYPE_ALT_MIN: "Min Alt",
}


@dataclass(slots=True)
class Fence:
    """Settings, shapes and current breaches of the geofence."""

    enabled: bool = False
    types: int = 7
    alt_max_m: float = 100.0
    alt_min_m: float = -10.0
    radius_m: float = 300.0
    shapes: tuple[Shape, ...] = ()
    breaches: int = NO_BREACH
    breach_count: int = 0
    breach_time_s: float = 0.0
    margin_m: float = 2.0
    avoid: bool = True  # limit velocities in front of the fence
    limiting: bool = False
    recovery_until_s: float = -math.inf  # after a mode change during a breach, checks are suspended until this time

    @property
    def present(self) -> bool:
        """True if the fence has an enabled limit or shape."""
        return bool(self.types & ~mavlink.FENCE_TYPE_POLYGON) or (
            bool(self.types & mavlink.FENCE_TYPE_POLYGON) and bool(self.shapes)
        )

    def outside(self, north: float, east: float, altitude_m: float, home: Vertex = (0.0, 0.0)) -> int:
        """Return the FENCE_TYPE bits that a point would breach, or NO_BREACH if the fence is disabled.

        Args:
            north: Local position in metres.
            east: Local position in metres.
            altitude_m: Altitude above home.
            home: Home position in local metres.
        """
        breaches = NO_BREACH
        if not self.enabled:
            return breaches
        if self.types & mavlink.FENCE_TYPE_ALT_MAX and altitude_m >= self.alt_max_m:
            breaches |= mavlink.FENCE_TYPE_ALT_MAX
        if self.types & mavlink.FENCE_TYPE_ALT_MIN and altitude_m <= self.alt_min_m:
            breaches |= mavlink.FENCE_TYPE_ALT_MIN
        if self.types & mavlink.FENCE_TYPE_CIRCLE and math.hypot(north - home[0], east - home[1]) >= self.radius_m:
            breaches |= mavlink.FENCE_TYPE_CIRCLE
        if self.types & mavlink.FENCE_TYPE_POLYGON and any(s.contains(north, east) != s.inclusion for s in self.shapes):
            breaches |= mavlink.FENCE_TYPE_POLYGON
        return breaches

    def distance_m(self, north: float, east: float, altitude_m: float, home: Vertex = (0.0, 0.0)) -> float:
        """Return the distance in metres by which a point exceeds the breached limits. It is 0 inside the fence."""
        breaches = self.outside(north, east, altitude_m, home)
        beyond = [0.0]
        if breaches & mavlink.FENCE_TYPE_ALT_MAX:
            beyond.append(altitude_m - self.alt_max_m)
        if breaches & mavlink.FENCE_TYPE_ALT_MIN:
            beyond.append(self.alt_min_m - altitude_m)
        if breaches & mavlink.FENCE_TYPE_CIRCLE:
            beyond.append(math.hypot(north - home[0], east - home[1]) - self.radius_m)
        if breaches & mavlink.FENCE_TYPE_POLYGON:
            wrong = [shape for shape in self.shapes if shape.contains(north, east) != shape.inclusion]
            beyond += [shape.edge_distance_m(north, east) for shape in wrong]
        return max(beyond)

    def speed_allowed(
        self, north: float, east: float, home: Vertex, course: Vertex, brake: Callable[[float], float]
    ) -> float:
        """Return the maximum speed (m/s) along a course from which the vehicle can stop at the margin before the fence.

        Args:
            north: Local position in metres.
            east: Local position in metres.
            home: Home position in local metres.
            course: Unit vector of the course.
            brake: Returns the maximum speed from which the vehicle stops within a distance.
        """
        if not (self.enabled and self.avoid):
            return math.inf
        shapes: list[Shape] = list(self.shapes) if self.types & mavlink.FENCE_TYPE_POLYGON else []
        if self.types & mavlink.FENCE_TYPE_CIRCLE:
            shapes.append(Circle(home[0], home[1], self.radius_m, inclusion=True))
        allowed = math.inf
        for shape in shapes:
            if shape.contains(north, east) != shape.inclusion:
                continue  # the vehicle is on the wrong side of this shape, which is a breach
            ahead = shape.distance_along_m((north, east), course)
            if ahead is not None:
                allowed = min(allowed, brake(max(ahead - self.margin_m, 0.0)))
        return allowed

    def check(self, north: float, east: float, altitude_m: float, home: Vertex, now_s: float) -> int:
        """Update the breaches, and return the breaches that are new."""
        breaches = self.outside(north, east, altitude_m, home)
        new = breaches & ~self.breaches
        self.breaches = breaches
        if new:
            self.breach_count = min(self.breach_count + 1, 65535)
            self.breach_time_s = now_s
        return new

    @property
    def breach_type(self) -> int:
        """Breach type reported in FENCE_STATUS."""
        if self.breaches & mavlink.FENCE_TYPE_ALT_MIN:
            return mavlink.FENCE_BREACH_MINALT
        if self.breaches & mavlink.FENCE_TYPE_ALT_MAX:
            return mavlink.FENCE_BREACH_MAXALT
        return mavlink.FENCE_BREACH_BOUNDARY if self.breaches else mavlink.FENCE_BREACH_NONE


def breach_names(breaches: int) -> str:
    """Return the breached fences in ArduPilot's wording, for example `Max Alt and Circle fences`."""
    names = [name for bit, name in NAMES.items() if breaches & bit]
    if len(names) <= 1:
        return f"{''.join(names)} fence".strip()
    return f"{', '.join(names[:-1])} and {names[-1]} fences"
