"""The free space that routes are searched in: what blocks a leg, and the corners around it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant, PolicyZone
from fractus_core.policy.decision_types import Situation
from fractus_core.policy.geofences import find_breaches
from fractus_core.policy.kinematics import XY, Leg, height_margin_m, margin_m
from fractus_core.policy.limits import limit_forbids_altitudes
from fractus_core.policy.return_route import check_straight_return

Floats = NDArray[np.float64]

CORNER_M = 0.1
"""Waypoints lie this much further out than their legs must, so that rounding costs no leg."""

_SIMPLER_M = 0.2
"""How far the outline of a shape of many corners is simplified; it is grown by as much first."""
_MAX_PLAIN_CORNERS = 24
"""Shapes of no more corners are taken as they are."""
_SEGMENTS = 3
"""Straight pieces around a corner, per quarter of a circle: each more is a corner more to search."""


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """Where a way may lead: the air between two altitudes, and the fences in it."""

    now: Situation
    grant: CompiledGrant
    lower_m: float
    upper_m: float
    margin_m: float
    height_margin_m: float
    required_areas: tuple[tuple[BaseGeometry, BaseGeometry], ...]

    @classmethod
    def between(cls, now: Situation, grant: CompiledGrant, lower_m: float, upper_m: float, room_m: float) -> FreeSpace:
        """The space that a grant leaves, with this much room beyond the engine's margin."""
        moving = replace(grant, operation_area=grant.flight_area, operation_area_border=grant.flight_area_border)
        slack = height_margin_m(now)
        required_areas = [
            fence.at(lower_m - slack, upper_m + slack, now, grant.flat_terrain)
            for fence in grant.inclusions
            if fence.rule.in_force(now.time_s)
        ]
        if grant.flight_area is not None and grant.flight_area_border is not None:
            required_areas.append((grant.flight_area, grant.flight_area_border))
        return cls(now, moving, lower_m, upper_m, margin_m(now) + room_m, slack, tuple(required_areas))

    def blockers(self, line: BaseGeometry) -> list[PolicyZone | int]:
        """What stands in the way of a line: zones to keep out of, and numbers of areas to stay in."""
        slack, flat = self.height_margin_m, self.grant.flat_terrain
        air = AirVolume(line, self.margin_m, self.lower_m - slack, self.upper_m + slack)
        found: list[PolicyZone | int] = list(self.grant.exclusions.near(air, self.now, flat))
        if self.grant.altitude_limits.zones:
            low, high = self.lower_m, self.upper_m
            limiting = self.grant.altitude_limits.near(air, self.now, flat)
            found += [zone for zone in limiting if limit_forbids_altitudes(zone, low, high, self.now, flat)]
        for i, (shape, border) in enumerate(self.required_areas):
            if not shape.covers(line) or border.dwithin(line, self.margin_m):
                found.append(i)
        return found

    def allows_leg(self, start: XY, end: XY) -> bool:
        """Whether a leg from or to an end of the way is legal, which may lie too close to a fence or at home."""
        leg = Leg(start, start, start, end, self.lower_m, self.upper_m)
        if find_breaches(leg, self.now, self.grant, self.margin_m, self.height_margin_m):
            return False
        air = AirVolume(leg.ground, self.margin_m, self.lower_m, self.upper_m)
        limiting = self.grant.altitude_limits.near(air, self.now, self.grant.flat_terrain)
        return not any(
            limit_forbids_altitudes(zone, self.lower_m, self.upper_m, self.now, self.grant.flat_terrain)
            for zone in limiting
        )

    def allows_return_from(self, place: XY) -> bool:
        """Whether the autopilot's own way home from a place is legal."""
        if self.now.airframe.retraces:
            return True
        margin, slack = self.margin_m, self.height_margin_m
        return check_straight_return(place, self.upper_m, self.now, self.grant, margin=margin, slack=slack) is None

    def corners(self, obstacle: PolicyZone | int) -> Floats:
        """Where ways may turn around an obstacle: rows of x, y of a corner, the one before it and the one after."""
        away = self.margin_m + CORNER_M
        if isinstance(obstacle, PolicyZone):
            return _corners(_outline(obstacle.shape, away), 1.0)
        return _corners(_outline(self.required_areas[obstacle][0], -away), -1.0)

    def nearest_exit(self, obstacle: PolicyZone | int, begin: shapely.Point) -> Floats:
        """The nearest place that an obstacle leaves free, as a corner without neighbours; none may be left."""
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
    """A shape grown or shrunk, with few corners, none nearer than that."""
    # GEOS rounds the number of pieces, so one may span half as much again as a quarter circle's share.
    away_m /= math.cos(0.75 * math.pi / 2 / _SEGMENTS)
    if shapely.get_num_coordinates(shape) > _MAX_PLAIN_CORNERS:
        return shape.buffer(away_m + math.copysign(_SIMPLER_M, away_m), quad_segs=_SEGMENTS).simplify(_SIMPLER_M)
    return shape.buffer(away_m, quad_segs=_SEGMENTS)


def _corners(shape: BaseGeometry, turning: float) -> Floats:
    """Corners that turn one way (1: left, with the shape on the left), each with its neighbours, shape (n, 6)."""
    found = [np.empty((0, 6))]
    for part in shapely.get_parts(shape):
        if not isinstance(part, shapely.Polygon) or part.is_empty:
            continue
        whole = shapely.orient_polygons(part)
        for ring in (whole.exterior, *whole.interiors):
            points = shapely.get_coordinates(ring)[:-1]
            before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
            there, away = points - before, after - points
            turn = there[:, 0] * away[:, 1] - there[:, 1] * away[:, 0]
            found.append(np.hstack((points, before, after))[turn * turning > 0])
    return np.vstack(found)
