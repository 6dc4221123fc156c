"""Free space of the route search: obstacles of a leg, and the corners around them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant, PolicyZone
from fractus_core.policy.decision_types import Situation
from fractus_core.policy.geofences import check_straight_return, find_breaches
from fractus_core.policy.kinematics import XY, Leg
from fractus_core.policy.limits import limit_forbids_altitudes, limiting_zones

Floats = NDArray[np.float64]

CORNER_M = 0.1
"""Distance that waypoints keep from fences in addition to the margin of legs, so that rounding makes no leg illegal."""

_SIMPLIFY_TOLERANCE_M = 0.2
"""Tolerance when simplifying a shape with many corners. The shape is grown by this amount before it is simplified."""
_MAX_EXACT_CORNERS = 24
"""Shapes with at most this number of corners are not simplified."""
_SEGMENTS = 3
"""Number of straight edges that replace a quarter of a circle at a corner. More edges make the search slower."""


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """The air between two altitudes through which a route may lead, and its fences."""

    now: Situation
    grant: CompiledGrant
    lower_m: float
    upper_m: float
    margin_m: float
    height_margin_m: float
    required_areas: tuple[tuple[BaseGeometry, BaseGeometry], ...]

    @classmethod
    def between(cls, now: Situation, grant: CompiledGrant, lower_m: float, upper_m: float, room_m: float) -> FreeSpace:
        """Return the space that a grant permits between two altitudes, with clearance in addition to the margin."""
        moving = replace(grant, operation_area=grant.flight_area, operation_area_border=grant.flight_area_border)
        slack = now.height_margin_m
        required_areas = [
            fence.at(lower_m - slack, upper_m + slack, now, grant.flat_terrain)
            for fence in grant.inclusions
            if fence.rule.in_force(now.time_s)
        ]
        if grant.flight_area is not None and grant.flight_area_border is not None:
            required_areas.append((grant.flight_area, grant.flight_area_border))
        return cls(now, moving, lower_m, upper_m, now.margin_m + room_m, slack, tuple(required_areas))

    def blockers(self, line: BaseGeometry) -> list[PolicyZone | int]:
        """Return what a line violates: the zones that it enters, and the indexes of the areas that it leaves."""
        flat = self.grant.flat_terrain
        air = AirVolume(line, self.margin_m, self.lower_m, self.upper_m).extended(self.height_margin_m)
        obstacles: list[PolicyZone | int] = list(self.grant.exclusions.near(air, self.now, flat))
        if self.grant.altitude_limits.zones:
            low = self.lower_m
            high = self.upper_m
            limiting = self.grant.altitude_limits.near(air, self.now, flat)
            obstacles += [zone for zone in limiting if limit_forbids_altitudes(zone, low, high, self.now, flat)]
        for i, (shape, border) in enumerate(self.required_areas):
            if not shape.covers(line) or border.dwithin(line, self.margin_m):
                obstacles.append(i)
        return obstacles

    def allows_leg(self, start: XY, end: XY) -> bool:
        """Return True if the engine permits a leg from the start or to the target of the route.

        For such legs the engine has exceptions: the start or the target may be too close to a fence, or at home.
        """
        leg = Leg(start, start, start, end, self.lower_m, self.upper_m)
        if find_breaches(leg, self.now, self.grant, self.margin_m, self.height_margin_m):
            return False
        air = AirVolume(leg.ground, self.margin_m, self.lower_m, self.upper_m)
        limits = self.grant.altitude_limits
        limiting = limiting_zones(limits, self.grant, self.now, air, self.height_margin_m)
        return not any(
            limit_forbids_altitudes(zone, self.lower_m, self.upper_m, self.now, self.grant.flat_terrain)
            for zone in limiting
        )

    def allows_return_from(self, point: XY) -> bool:
        """Return True if the autopilot's straight return from a point is legal."""
        if self.now.airframe.retraces:
            return True
        margin = self.margin_m
        slack = self.height_margin_m
        return check_straight_return(point, self.upper_m, self.now, self.grant, margin=margin, slack=slack) is None

    def corners(self, obstacle: PolicyZone | int) -> Floats:
        """Return the corners at which routes may turn around an obstacle.

        Returns:
            Rows of x and y of a corner, of the corner before it and of the corner after it.
        """
        away = self.margin_m + CORNER_M
        if isinstance(obstacle, PolicyZone):
            return _corners(_outline(obstacle.shape, away), 1.0)
        return _corners(_outline(self.required_areas[obstacle][0], -away), -1.0)

    def nearest_exit(self, obstacle: PolicyZone | int, begin: shapely.Point) -> Floats:
        """Return the nearest point outside an obstacle as a corner without neighbours. Empty if the obstacle fills all space."""
        away = self.margin_m + CORNER_M
        outline = (
            _outline(obstacle.shape, away)
            if isinstance(obstacle, PolicyZone)
            else _outline(self.required_areas[obstacle][0], -away)
        )
        if outline.is_empty:
            return np.empty((0, 6))
        near = shapely.get_coordinates(shapely.shortest_line(begin, outline.boundary))[-1]
        return np.tile(near, (1, 3))


def _outline(shape: BaseGeometry, away_m: float) -> BaseGeometry:
    """Return a shape grown or shrunk by at least a distance, with few corners."""
    # GEOS rounds the number of pieces, so a piece may span up to one and a half times its share of a quarter circle.
    away_m /= math.cos(0.75 * math.pi / 2 / _SEGMENTS)
    if shapely.get_num_coordinates(shape) > _MAX_EXACT_CORNERS:
        return shape.buffer(away_m + math.copysign(_SIMPLIFY_TOLERANCE_M, away_m), quad_segs=_SEGMENTS).simplify(
            _SIMPLIFY_TOLERANCE_M
        )
    return shape.buffer(away_m, quad_segs=_SEGMENTS)


def _corners(shape: BaseGeometry, turning: float) -> Floats:
    """Return the corners that turn in one direction, with their neighbours, shape (n, 6).

    The border is followed with the shape on the left. `turning` 1 selects left turns, -1 right turns.
    """
    corners = [np.empty((0, 6))]
    for part in shapely.get_parts(shape):
        if not isinstance(part, shapely.Polygon) or part.is_empty:
            continue
        polygon = shapely.orient_polygons(part)
        for ring in (polygon.exterior, *polygon.interiors):
            points = shapely.get_coordinates(ring)[:-1]
            before = np.roll(points, 1, axis=0)
            after = np.roll(points, -1, axis=0)
            incoming = points - before
            outgoing = after - points
            turn = incoming[:, 0] * outgoing[:, 1] - incoming[:, 1] * outgoing[:, 0]
            corners.append(np.hstack((points, before, after))[turn * turning > 0])
    return np.vstack(corners)
