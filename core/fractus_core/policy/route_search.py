"""Shortest legal routes around exclusion zones, inside inclusion zones and the operation area with its corridor."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Generator

import numpy as np
import shapely
from numpy.typing import NDArray

from fractus_core.policy.compiled_grant import CompiledGrant, PolicyZone
from fractus_core.policy.decision_types import Situation
from fractus_core.policy.free_space import Floats, FreeSpace
from fractus_core.policy.kinematics import XY

CLEARANCES_M = (1.5, 0.25)
"""Distances from fences that legs keep in addition to the engine's margin: the preferred and the smallest distance. A
drone that reached a waypoint within a metre then finds its next leg legal."""

MAX_LEGS_TESTED = 3000
"""A search gives up after this number of legs, about half a second of work."""

MAX_EXCESS = 1.2
"""Maximum ratio of the length of a route to the length of the shortest route. A higher ratio makes the search quicker.
Usually the route is only a percent or two longer than the shortest route."""

QUICK_MAX_LEGS_TESTED = 250
QUICK_MAX_EXCESS = 5.0
"""Values of `MAX_LEGS_TESTED` and `MAX_EXCESS` for a search that only decides if a route exists.

Such a search takes about 25 ms, while its caller waits.
"""

_MAX_CLEARANCE_DETOUR = 1.2
_MAX_ROUNDING_M = 1.5
_ROUNDING = 1e-6
_START = 0
_TARGET = 1


RouteSteps = Generator[None, None, tuple[XY, ...] | None]


def find_route(
    start: XY, target: XY, now: Situation, grant: CompiledGrant, altitude_m: float, *, from_m: float | None = None
) -> tuple[XY, ...] | None:
    """Return the shortest legal route between two points, flown at one altitude with a stop at each waypoint.

    The route keeps out of exclusion zones and of zones whose altitude limits `altitude_m` breaks, and inside inclusion
    zones and `grant.flight_area` (operation area and corridor), each with the engine's margin. From a start that is
    itself too close to a fence the first leg leads away from it. If the autopilot returns in a straight line (not
    `now.airframe.retraces`), its return must be legal from every waypoint, including the target.

    If the route with the preferred clearance is a fifth longer than the route with the smallest clearance, the shorter one
    is returned.

    The result is deterministic. `judge` permits each leg as a `Goto` from standstill, unless limits that hold
    everywhere correct its altitude or speed, under a grant whose operation area includes the corridor
    (`compile_transit_grant`). An application's own Gotos must end inside the operation area.

    Source: shortest paths among polygons turn at convex corners of obstacles only (Lozano-Perez and Wesley 1979). The
    search is A* (weighted: at most a fifth too long) over tangents between such corners. An obstacle joins when it
    first blocks a promising leg, so the time depends on the obstacles along the route and not on their total number.

    Args:
        start: Start of the route, in metres of `grant.frame`. It may differ from the drone's position.
        target: End of the route.
        now: Time, position errors, airframe and home. The position in it is not used.
        grant: Permissions and restrictions that apply.
        altitude_m: Altitude of the whole route, metres above home.
        from_m: Altitude at the start if it differs. The first leg is then legal at all altitudes between.

    Returns:
        The waypoints in metres of `grant.frame` (`grant.frame.latlon(x, y)` returns degrees), in order. The last one is
        the target. The start is not included. None if no legal route exists, if home or a limit's datum is unknown, or
        if the search gives up.
    """
    return _run_to_end(route_steps(start, target, now, grant, altitude_m, from_m=from_m))


def route_steps(
    start: XY, target: XY, now: Situation, grant: CompiledGrant, altitude_m: float, *, from_m: float | None = None
) -> RouteSteps:
    """Run the search of `find_route` as a generator that returns the route.

    Each step takes a fraction of a millisecond.
    """
    numbers = (*start, *target, altitude_m, altitude_m if from_m is None else from_m)
    if now.home is None or not now.is_plausible or not all(math.isfinite(number) for number in numbers):
        return None
    roomy, narrow = (_Search(start, target, _spaces(now, grant, numbers[-2:], room_m)) for room_m in CLEARANCES_M)
    result = yield from roomy.steps()
    if result is not None and _length_m(start, result) <= _MAX_CLEARANCE_DETOUR * math.dist(start, target):
        return (yield from roomy.rounded(result))
    shorter = (yield from narrow.steps()) if not roomy.exhausted else None
    if shorter is not None and (
        result is None or _length_m(start, shorter) < _length_m(start, result) / _MAX_CLEARANCE_DETOUR
    ):
        return (yield from narrow.rounded(shorter))
    return (yield from roomy.rounded(result)) if result is not None else None


def route_exists(start: XY, target: XY, now: Situation, grant: CompiledGrant, altitude_m: float) -> bool:
    """Return True if a short search, of `QUICK_MAX_LEGS_TESTED` legs, finds any legal route between two points."""
    return quick_route(start, target, now, grant, altitude_m, max_excess=QUICK_MAX_EXCESS) is not None


def quick_route(
    start: XY,
    target: XY,
    now: Situation,
    grant: CompiledGrant,
    altitude_m: float,
    *,
    from_m: float | None = None,
    max_excess: float = MAX_EXCESS,
) -> tuple[XY, ...] | None:
    """Run the search of `find_route` with the smallest clearance, and give up after `QUICK_MAX_LEGS_TESTED` legs."""
    if now.home is None or not now.is_plausible:
        return None
    heights_m = (altitude_m, altitude_m if from_m is None else from_m)
    spaces = _spaces(now, grant, heights_m, CLEARANCES_M[1])
    return _run_to_end(_Search(start, target, spaces, max_excess=max_excess, max_legs=QUICK_MAX_LEGS_TESTED).steps())


def _spaces(
    now: Situation, grant: CompiledGrant, heights_m: tuple[float, float], room_m: float
) -> tuple[FreeSpace, FreeSpace]:
    """Return the free space of a route at the first altitude, and the free space of its first leg.

    The first leg starts at the second altitude.
    """
    low, high = sorted(heights_m)
    cruise = FreeSpace.between(now, grant, heights_m[0], heights_m[0], room_m)
    return cruise, cruise if low == high else FreeSpace.between(now, grant, low, high, room_m)


def _run_to_end(search: RouteSteps) -> tuple[XY, ...] | None:
    while True:
        try:
            next(search)
        except StopIteration as end:
            result: tuple[XY, ...] | None = end.value
            return result


def _length_m(start: XY, route: tuple[XY, ...]) -> float:
    return sum(math.dist(a, b) for a, b in itertools.pairwise((start, *route)))


def _intersection(before: XY, first: XY, second: XY, after: XY) -> XY | None:
    """Return the point where two extended legs meet. Return None if the point is far away or behind the first leg."""
    ux = first[0] - before[0]
    uy = first[1] - before[1]
    vx = second[0] - after[0]
    vy = second[1] - after[1]
    across = ux * vy - uy * vx
    if abs(across) < 1e-9:
        return None
    along = ((after[0] - before[0]) * vy - (after[1] - before[1]) * vx) / across
    corner = (before[0] + ux * along, before[1] + uy * along)
    extra = math.dist(first, corner) + math.dist(corner, second) - math.dist(first, second)
    return corner if along >= 1.0 and extra <= _MAX_ROUNDING_M else None


class _Search:
    """A* search from start to target over tangents between corners. Obstacles are added when they block a leg."""

    def __init__(
        self,
        start: XY,
        target: XY,
        spaces: tuple[FreeSpace, FreeSpace],
        *,
        max_excess: float = MAX_EXCESS,
        max_legs: int = MAX_LEGS_TESTED,
    ) -> None:
        self._space, self._leaving = spaces
        self._max_excess = max_excess
        self._max_legs = max_legs
        self._ends = (start, target)
        # The ends count as corners without neighbours, so that every line counts as a tangent at an end.
        self._nodes: Floats = np.asarray([start * 3, target * 3])
        self._cost = np.asarray([0.0, math.inf])
        self._parent = [-1, -1]
        self._expanded: list[int] = []
        self._heap: list[tuple[float, int, int, float]] = []
        self._known: set[tuple[int, int]] = set()
        self._clear: dict[tuple[int, int], bool] = {}
        self._returns: dict[int, bool] = {}
        # Ends of the route that are too close to a fence. The engine's rules judge the legs from and to them.
        self._blocked_ends: set[int] = set()

    def steps(self) -> RouteSteps:
        """Search leg by leg. The generator returns the route, or None."""
        if self._ends[0] == self._ends[1]:
            return (self._ends[1],) if self._leaving.allows_leg(*self._ends) else None
        begin = shapely.points(self._ends[0])
        start_blockers = self._leaving.blockers(begin)
        target_blockers = self._space.blockers(shapely.points(self._ends[1]))
        self._blocked_ends = {node for node, result in ((_START, start_blockers), (_TARGET, target_blockers)) if result}
        if not self._space.allows_return_from(self._ends[1]) or (
            target_blockers and not self._space.allows_leg(self._ends[1], self._ends[1])
        ):
            return None
        for obstacle in start_blockers:
            # Add the nearest exit first, because the obstacle may have no corner near it.
            self._add(self._leaving.nearest_exit(obstacle, begin))
            self._learn([obstacle], self._ends[0], self._leaving)
        self._expand(_START)
        while self._heap and not self.exhausted:
            yield
            _, end, begin, cost = heapq.heappop(self._heap)
            if cost >= self._cost[end] - 1e-9 or not self._open(begin, end):
                continue
            self._cost[end] = cost
            self._parent[end] = begin
            if end == _TARGET:
                return self._route()
            self._expand(end)
        return None

    @property
    def exhausted(self) -> bool:
        """True if the search gave up."""
        return len(self._clear) >= self._max_legs

    def rounded(self, route: tuple[XY, ...]) -> RouteSteps:
        """Merge neighbouring waypoints if their extended legs meet nearby, because the drone stops at each waypoint."""
        points = [self._ends[0], *route]
        i = 1
        while i + 2 < len(points):
            yield
            before, first, second, after = points[i - 1 : i + 3]
            corner = _intersection(before, first, second, after)
            if corner is not None and self._clears(before, corner) and self._clears(corner, after):
                points[i : i + 2] = [corner]
            else:
                i += 1
        return tuple(points[1:])

    def _clears(self, a: XY, b: XY) -> bool:
        blocked = (_START in self._blocked_ends and a == self._ends[0]) or (
            _TARGET in self._blocked_ends and b == self._ends[1]
        )
        space = self._leaving if a == self._ends[0] else self._space
        free = not space.blockers(shapely.linestrings((a, b))) or (blocked and space.allows_leg(a, b))
        return free and space.allows_return_from(b)

    def _route(self) -> tuple[XY, ...]:
        at = _TARGET
        route = []
        while at != _START:
            x, y = self._nodes[at, :2]
            route.append((float(x), float(y)))
            at = self._parent[at]
        return (*route[::-1][:-1], self._ends[1])

    def _expand(self, node: int) -> None:
        if node not in self._expanded:
            self._expanded.append(node)
        self._push([node], 1)

    def _push(self, begins: list[int], first: int) -> None:
        """Queue the tangents from the nodes `begins` to all nodes whose index is at least `first`."""
        froms = self._nodes[begins]
        tos = self._nodes[first:]
        along = tos[None, :, :2] - froms[:, None, :2]
        away = np.hypot(along[..., 0], along[..., 1])
        cost = self._cost[begins][:, None] + away
        good = (cost < self._cost[first:] - 1e-9) & (away > 1e-6)
        good &= _tangent(along, froms[:, None]) & _tangent(along, tos[None])
        left = np.hypot(*(tos[:, :2] - self._nodes[_TARGET, :2]).T)
        for i, j in np.argwhere(good).tolist():
            heapq.heappush(
                self._heap, (float(cost[i, j] + self._max_excess * left[j]), first + j, begins[i], float(cost[i, j]))
            )

    def _open(self, begin: int, end: int) -> bool:
        key = (min(begin, end), max(begin, end))
        if key not in self._clear:
            self._clear[key] = self._test(begin, end)
        return self._clear[key]

    def _test(self, begin: int, end: int) -> bool:
        """Return True if a leg and, where required, the return flight from its end are legal.

        Obstacles that block the leg are added to the search.
        """
        a, b = (self._ends[n] if n <= _TARGET else self._position(n) for n in (begin, end))
        space = self._leaving if begin == _START else self._space
        blockers = space.blockers(shapely.linestrings((a, b)))
        if blockers and (self._blocked_ends.isdisjoint((begin, end)) or not space.allows_leg(a, b)):
            self._learn(blockers, a, space)
            return False
        if end > _TARGET and end not in self._returns:
            self._returns[end] = self._space.allows_return_from(b)
        return self._returns.get(end, True)

    def _position(self, node: int) -> XY:
        x, y = self._nodes[node, :2]
        return float(x), float(y)

    def _learn(self, obstacles: list[PolicyZone | int], begin: XY, space: FreeSpace) -> None:
        """Add the obstacles that block a leg: all areas to stay in, and the nearest zone.

        A route around the nearest zone meets the next zone.
        """

        def key(obstacle: PolicyZone | int) -> tuple[int, int]:
            # The shape of an area to stay in depends on the altitude.
            return (obstacle, id(space)) if isinstance(obstacle, int) else (id(obstacle), 0)

        new = [o for o in obstacles if key(o) not in self._known]
        if not new:
            return
        origin = shapely.points(begin)
        zones = [o for o in new if isinstance(o, PolicyZone)]
        nearest = min(zones, key=lambda o: (o.shape.distance(origin), o.rule.name, o.name), default=None)
        new = [o for o in new if o is nearest or isinstance(o, int)]
        self._known.update(key(o) for o in new)
        corners = np.vstack([space.corners(obstacle) for obstacle in new])
        first = len(self._nodes)
        self._add(corners)
        if self._expanded:
            self._push(self._expanded, first)

    def _add(self, corners: Floats) -> None:
        self._nodes = np.vstack((self._nodes, corners))
        self._cost = np.concatenate((self._cost, np.full(len(corners), math.inf)))
        self._parent += [-1] * len(corners)


def _tangent(along: Floats, corners: Floats) -> NDArray[np.bool_]:
    """Return True for each line through a corner that has both neighbours of the corner on one side.

    Arrays are broadcast.
    """
    before = corners[..., 2:4] - corners[..., :2]
    after = corners[..., 4:] - corners[..., :2]
    left = along[..., 0] * before[..., 1] - along[..., 1] * before[..., 0]
    right = along[..., 0] * after[..., 1] - along[..., 1] * after[..., 0]
    tangent: NDArray[np.bool_] = left * right >= -_ROUNDING
    return tangent
