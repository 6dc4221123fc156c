"""Legal shortest ways around exclusion zones, inside inclusion zones and the operation area with its corridor."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from fractus_core.policy.compiled import Air, CompiledGrant, Patch
from fractus_core.policy.fences import breaches
from fractus_core.policy.limits import forbids_height
from fractus_core.policy.motion import XY, Leg, height_margin_m, margin_m
from fractus_core.policy.returning import straight_home_blocked
from fractus_core.policy.values import Situation

Floats = NDArray[np.float64]

ROOM_M = (1.5, 0.25)
"""What legs keep beyond the engine's margin, where there is room, and else: a drone that reached a waypoint within a metre
finds the next leg legal."""

CORNER_M = 0.1
"""Waypoints lie this much further out than their legs must, so that rounding costs no leg."""

PATIENCE = 20_000
"""So many legs are tested before a search gives up, about half a second."""

_SIMPLER_M = 0.2
_PLAIN = 24
_MITRE = 2.0
_START, _TARGET = 0, 1


def route(
    start: XY, target: XY, now: Situation, grant: CompiledGrant, altitude_m: float, *, from_m: float | None = None
) -> tuple[XY, ...] | None:
    """The shortest legal way from one place to another, flown at one altitude with a stop at each waypoint.

    It keeps out of exclusion zones, out of zones whose altitude limits `altitude_m` breaks, and inside inclusion zones and
    `grant.passage` (operation area and corridor), each with the engine's margin. From a start that is itself too close to
    a fence the first leg leads away from it. Where the autopilot's way home is a straight line (not
    `now.airframe.retraces`), it must be legal from every waypoint, the target included.

    The same inputs always give the same way. `judge` permits each leg as a `Goto` from standstill, unless limits that hold
    everywhere correct its altitude or speed, under a grant whose operation area includes the corridor (`for_transit`): an
    application's own Gotos must end inside the operation area.

    Source: shortest paths among polygons turn at convex corners of obstacles only (Lozano-Perez and Wesley 1979). The search
    is A* over tangents between such corners; an obstacle joins when it first blocks a promising leg, so the time depends
    on the obstacles along the way, not on how many there are.

    Args:
        start: where the way begins, in metres of `grant.frame`; need not be where the drone is now.
        target: where it ends.
        now: time, position errors, airframe and home; the position in it is not used.
        grant: whose fences.
        altitude_m: altitude of the whole way, metres above home.
        from_m: altitude at the start, when it is another; the whole way is then legal at all altitudes between.

    Returns:
        The waypoints in metres of `grant.frame` (`grant.frame.latlon(x, y)` gives degrees), in order; the last one is the
        target, the start is left out. None when there is no legal way, when home or a limit's datum is unknown, or when
        the search gives up.
    """
    figures = (*start, *target, altitude_m, altitude_m if from_m is None else from_m)
    if now.home is None or not now.sound or not all(math.isfinite(figure) for figure in figures):
        return None
    low, high = sorted(figures[-2:])
    for room_m in ROOM_M:
        found = _Search(start, target, _Space.around(now, grant, low, high, room_m)).run()
        if found is not None:
            return found
    return None


@dataclass(frozen=True, slots=True)
class _Space:
    """Where a way may lead: the air between two altitudes, and the fences in it."""

    now: Situation
    grant: CompiledGrant
    lower_m: float
    upper_m: float
    margin_m: float
    height_margin_m: float
    kept_in: tuple[tuple[BaseGeometry, BaseGeometry], ...]

    @classmethod
    def around(cls, now: Situation, grant: CompiledGrant, lower_m: float, upper_m: float, room_m: float) -> _Space:
        """The space that a grant leaves, with so much room beyond the engine's margin."""
        moving = replace(grant, operation=grant.passage, operation_border=grant.passage_border)
        slack = height_margin_m(now)
        kept_in = [
            fence.at(lower_m - slack, upper_m + slack, now, grant.flat_terrain)
            for fence in grant.inclusions
            if fence.rule.in_force(now.time_s)
        ]
        if grant.passage is not None and grant.passage_border is not None:
            kept_in.append((grant.passage, grant.passage_border))
        return cls(now, moving, lower_m, upper_m, margin_m(now) + room_m, slack, tuple(kept_in))

    def blockers(self, line: BaseGeometry) -> list[Patch | int]:
        """What stands in the way of a line: patches to keep out of, and numbers of areas to stay in."""
        slack, flat = self.height_margin_m, self.grant.flat_terrain
        air = Air(line, self.margin_m, self.lower_m - slack, self.upper_m + slack)
        found: list[Patch | int] = list(self.grant.exclusions.near(air, self.now, flat))
        if self.grant.altitude_limits.patches:
            low, high = self.lower_m, self.upper_m
            limiting = self.grant.altitude_limits.near(air, self.now, flat)
            found += [patch for patch in limiting if forbids_height(patch, low, high, self.now, flat)]
        for i, (shape, border) in enumerate(self.kept_in):
            if not shape.covers(line) or border.dwithin(line, self.margin_m):
                found.append(i)
        return found

    def permits(self, start: XY, end: XY) -> bool:
        """Whether a leg from or to an end of the way is legal, which may lie too close to a fence or at home."""
        leg = Leg(start, start, start, end, self.lower_m, self.upper_m)
        if breaches(leg, self.now, self.grant, self.margin_m, self.height_margin_m):
            return False
        air = Air(leg.ground, self.margin_m, self.lower_m, self.upper_m)
        limiting = self.grant.altitude_limits.near(air, self.now, self.grant.flat_terrain)
        return not any(
            forbids_height(patch, self.lower_m, self.upper_m, self.now, self.grant.flat_terrain) for patch in limiting
        )

    def returns(self, place: XY) -> bool:
        """Whether the autopilot's own way home from a place is legal."""
        if self.now.airframe.retraces:
            return True
        margin, slack = self.margin_m, self.height_margin_m
        return straight_home_blocked(place, self.upper_m, self.now, self.grant, margin=margin, slack=slack) is None

    def corners(self, obstacle: Patch | int) -> Floats:
        """Where ways may turn around an obstacle: rows of x, y of a corner, the one before it and the one after."""
        away = self.margin_m + CORNER_M
        if isinstance(obstacle, Patch):
            return _corners(_outline(obstacle.shape, away), 1.0)
        return _corners(_outline(self.kept_in[obstacle][0], -away), -1.0)


def _outline(shape: BaseGeometry, away_m: float) -> BaseGeometry:
    """A shape grown or shrunk, with few corners."""
    if shapely.get_num_coordinates(shape) > _PLAIN:
        away_m += math.copysign(_SIMPLER_M, away_m)
        return shape.buffer(away_m, join_style="mitre", mitre_limit=_MITRE).simplify(_SIMPLER_M)
    return shape.buffer(away_m, join_style="mitre", mitre_limit=_MITRE)


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


class _Search:
    """A* from start to target over tangents between corners; obstacles are found on the way."""

    def __init__(self, start: XY, target: XY, space: _Space) -> None:
        self._space = space
        self._ends = (start, target)
        # The ends count as corners without neighbours: anything is tangent to them.
        self._nodes: Floats = np.asarray([start * 3, target * 3])
        self._cost = np.asarray([0.0, math.inf])
        self._parent = [-1, -1]
        self._expanded: list[int] = []
        self._heap: list[tuple[float, int, int, float]] = []
        self._known: set[int] = set()
        self._clear: dict[tuple[int, int], bool] = {}
        self._returns: dict[int, bool] = {}

    def run(self) -> tuple[XY, ...] | None:
        """The way, or None."""
        if self._ends[0] == self._ends[1]:
            return (self._ends[1],) if self._space.permits(*self._ends) else None
        here = shapely.Point(self._ends[1])
        if not self._space.returns(self._ends[1]) or (
            self._space.blockers(here) and not self._space.permits(self._ends[1], self._ends[1])
        ):
            return None
        self._expand(_START)
        while self._heap and len(self._clear) < PATIENCE:
            _, end, begin, cost = heapq.heappop(self._heap)
            if cost >= self._cost[end] - 1e-9 or not self._open(begin, end):
                continue
            self._cost[end], self._parent[end] = cost, begin
            if end == _TARGET:
                return self._way()
            self._expand(end)
        return None

    def _way(self) -> tuple[XY, ...]:
        at, way = _TARGET, []
        while at != _START:
            x, y = self._nodes[at, :2]
            way.append((float(x), float(y)))
            at = self._parent[at]
        return (*way[::-1][:-1], self._ends[1])

    def _expand(self, node: int) -> None:
        if node not in self._expanded:
            self._expanded.append(node)
        self._push(node, 1)

    def _push(self, begin: int, first: int) -> None:
        """Queue the tangents from a node to all nodes from a number on."""
        ends = self._nodes[first:]
        along = ends[:, :2] - self._nodes[begin, :2]
        away = np.hypot(along[:, 0], along[:, 1])
        cost = self._cost[begin] + away
        good = (cost < self._cost[first:] - 1e-9) & (away > 1e-6)
        good &= _tangent(along, self._nodes[begin]) & _tangent(along, ends)
        left = np.hypot(*(ends[:, :2] - self._nodes[_TARGET, :2]).T)
        for i in np.flatnonzero(good):
            heapq.heappush(self._heap, (float(cost[i] + left[i]), first + int(i), begin, float(cost[i])))

    def _open(self, begin: int, end: int) -> bool:
        key = (min(begin, end), max(begin, end))
        if key not in self._clear:
            self._clear[key] = self._test(begin, end)
        return self._clear[key]

    def _test(self, begin: int, end: int) -> bool:
        """Whether a leg is legal; what blocks it joins the obstacles."""
        a, b = (self._ends[n] if n <= _TARGET else self._place(n) for n in (begin, end))
        blockers = self._space.blockers(shapely.LineString((a, b)))
        if blockers and (min(begin, end) > _TARGET or not self._space.permits(a, b)):
            for obstacle in blockers:
                self._learn(obstacle)
            return False
        if end > _TARGET and end not in self._returns:
            self._returns[end] = self._space.returns(b)
        return self._returns.get(end, True)

    def _place(self, node: int) -> XY:
        x, y = self._nodes[node, :2]
        return float(x), float(y)

    def _learn(self, obstacle: Patch | int) -> None:
        name = obstacle if isinstance(obstacle, int) else id(obstacle)
        if name in self._known:
            return
        self._known.add(name)
        corners = self._space.corners(obstacle)
        first = len(self._nodes)
        self._nodes = np.vstack((self._nodes, corners))
        self._cost = np.concatenate((self._cost, np.full(len(corners), math.inf)))
        self._parent += [-1] * len(corners)
        for node in self._expanded:
            self._push(node, first)


def _tangent(along: Floats, corners: Floats) -> NDArray[np.bool_]:
    """Whether lines through corners leave both neighbours of the corner on one side."""
    corners = np.atleast_2d(corners)
    sides = []
    for columns in (slice(2, 4), slice(4, 6)):
        arm = corners[:, columns] - corners[:, :2]
        across = along[:, 0] * arm[:, 1] - along[:, 1] * arm[:, 0]
        across[np.abs(across) < 1e-9 * (1.0 + np.abs(along).max(initial=0.0) * np.abs(arm).max(initial=0.0))] = 0.0
        sides.append(across)
    tangent: NDArray[np.bool_] = sides[0] * sides[1] >= 0
    return tangent
