"""Recorded flight path of SmartRTL, from arming to the current position, simplified for the flight back.

Reimplements the method of ArduPilot (AP_SmartRTL). A point is recorded every SRTL_ACCURACY metres. Points within half
that distance of the line between their neighbours are removed (Ramer-Douglas-Peucker). A loop is cut where two segments
of the path come closer than SRTL_ACCURACY. Recording stops for the rest of the flight when SRTL_POINTS is exceeded.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

POINTS_MAX = 500
UPDATE_INTERVAL_S = 1.0 / 3.0
TIMEOUT_S = 15.0
CLEANUP_AFTER = 50  # new points
LOW_SPACE = 10  # free points
LOW_SPACE_TEXT_INTERVAL_S = 10.0
PRUNE_SHARE = 0.99  # segments that are closer than this share of the accuracy are joined
COMPARISONS_PER_TICK = 400  # bounds the cost of path cleanup in one control step

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Loop:
    """A loop in the path. The point `joint` can replace path[start] to path[end]."""

    start: int
    end: int
    joint: Point
    weight: float


class Breadcrumbs:
    """Recorded path in local metres (north, east, down), starting at home."""

    def __init__(self, params: Mapping[str, float], send_text: Callable[[int, str], None]) -> None:
        self._params = params
        self._send_text = send_text
        self.active = False
        self.path: list[Point] = []
        self._limit = min(max(int(params["SRTL_POINTS"]), 0), POINTS_MAX)  # read once at startup, like ArduPilot
        self._accuracy_m = 2.0
        self._simplified = 0  # number of points at the start of the path that are already simplified
        self._pruned = 0
        self._work: Iterator[None] | None = None
        self._next_s = 0.0
        self._good_s = self._saved_s = 0.0
        self._low_space_text_s = -math.inf

    def restart(self, now_s: float, position: Point | None) -> None:
        """Clear the path, and start a new path at the current position if it is known."""
        self._accuracy_m = self._params["SRTL_ACCURACY"]
        self.path.clear()
        self._simplified = self._pruned = 0
        self._work = None
        if self._limit == 0 or self._accuracy_m <= 0.0:
            self.active = False
        elif position is None:
            self._deactivate("bad position")
        else:
            self.active = True
            self._good_s = self._saved_s = now_s
            self.path.append(position)

    def step(self, now_s: float, position: Point | None, mode: int, *, armed: bool) -> None:
        """Record the position three times a second while armed, except in SMART_RTL mode, and simplify the path.

        Args:
            now_s: Vehicle time.
            position: Position (north, east, down); None if unknown.
            mode: Flight mode.
            armed: True while the motors run.
        """
        if now_s >= self._next_s:
            self._next_s = now_s + UPDATE_INTERVAL_S
            if not self.path and not armed and position is not None:
                self.restart(now_s, position)
            if self.active and armed and mode != mavlink.COPTER_MODE_SMART_RTL:
                self._record(now_s, position)
                self._work = self._work or self._routine_cleanup()
        if self._work is not None:
            try:
                next(self._work)
            except StopIteration:
                self._work = None

    def _record(self, now_s: float, position: Point | None) -> None:
        if position is None:
            if now_s - self._good_s > TIMEOUT_S:
                self._deactivate("bad position")
            return
        self._good_s = now_s
        if self.add(position):
            self._saved_s = now_s
        elif now_s - self._saved_s > TIMEOUT_S:
            self._deactivate("buffer full")
            return
        if len(self.path) >= self._limit - LOW_SPACE + 1 and now_s - self._low_space_text_s > LOW_SPACE_TEXT_INTERVAL_S:
            self._low_space_text_s = now_s
            self._send_text(mavlink.MAV_SEVERITY_INFO, "SmartRTL Low on space!")

    def _deactivate(self, reason: str) -> None:
        self.active = False
        self._work = None
        self._send_text(mavlink.MAV_SEVERITY_WARNING, f"SmartRTL deactivated: {reason}")

    def add(self, point: Point) -> bool:
        """Append a point unless it is too close to the last one. Return False if the path is full."""
        if self.path and math.dist(self.path[-1], point) < self._accuracy_m:
            return True
        if len(self.path) >= self._limit:
            return False
        self.path.append(point)
        return True

    def pop(self) -> Point:
        """Remove and return the newest point, the next target of the flight back."""
        point = self.path.pop()
        self._simplified = min(self._simplified, len(self.path))
        self._pruned = min(self._pruned, len(self.path))
        return point

    # -- simplification ----------------------------------------------------------------------------------------

    def simplify_fully(self) -> Iterator[None]:
        """Return an iterator that simplifies the whole path, with limited work per iteration."""
        self._work = None
        self.simplify()
        return self._prune(POINTS_MAX)

    def _routine_cleanup(self) -> Iterator[None] | None:
        fresh = len(self.path) - self._simplified
        low = self._limit - len(self.path) <= LOW_SPACE
        if fresh >= CLEANUP_AFTER or (low and fresh >= LOW_SPACE):
            self.simplify()
        elif low and self._pruned < len(self.path):
            return self._prune(LOW_SPACE)
        return None

    def simplify(self) -> None:
        """Remove new points that lie close to the line between their neighbours."""
        keep = set(range(len(self.path)))
        stack = [(max(self._simplified - 1, 0), len(self.path) - 1)]
        while stack:
            first, last = stack.pop()
            if last - first < 2:
                continue
            between = range(first + 1, last)
            apart = [distance_to_segment(self.path[at], self.path[first], self.path[last]) for at in between]
            farthest = between[apart.index(max(apart))]
            if max(apart) > self._accuracy_m / 2.0:
                stack += [(first, farthest), (farthest, last)]
            else:
                keep -= set(between)
        self.path = [point for at, point in enumerate(self.path) if at in keep]
        self._simplified = len(self.path)
        self._pruned = min(self._pruned, len(self.path))

    def _prune(self, enough: int) -> Iterator[None]:
        """Cut loops that end in new points, newest loop first, until `enough` points have been removed."""
        loops: list[Loop] = []
        count = 0
        done = len(self.path)
        for last in range(done - 1, max(self._pruned, 3) - 1, -1):
            for first in range(1, last - 1):
                count += 1
                if count % COMPARISONS_PER_TICK == 0:
                    yield
                gap_m, joint = segment_gap(self.path[last], self.path[last - 1], self.path[first - 1], self.path[first])
                if gap_m < self._accuracy_m * PRUNE_SHARE:
                    loops = _with_loop(loops, self._loop(first, last - 1, joint))
                    break
        removed = 0
        for loop in sorted(loops, key=lambda loop: loop.start, reverse=True):
            if removed >= enough:
                break
            self.path[loop.start : loop.end + 1] = [loop.joint]
            removed += loop.end - loop.start
        self._pruned = max(done - removed, 0) if removed < enough else 0
        self._simplified = min(self._simplified, len(self.path))

    def _loop(self, start: int, end: int, joint: Point) -> Loop:
        stretch = [joint, *self.path[start : end + 1], joint]
        weight = sum(math.dist(a, b) ** 2 for a, b in itertools.pairwise(stretch))
        return Loop(start, end, joint, weight)


def _with_loop(loops: list[Loop], new: Loop) -> list[Loop]:
    """Add a loop to the list. If loops overlap, keep the longer one."""
    if new.end <= new.start:
        return loops
    rivals = [loop for loop in loops if loop.start <= new.end and new.start <= loop.end]
    if sum(loop.weight for loop in rivals) > new.weight:
        return loops
    return [loop for loop in loops if loop not in rivals] + [new]


def distance_to_segment(point: Point, start: Point, end: Point) -> float:
    """Return the distance of a point from a line segment in space, in metres."""
    dx = end[0] - start[0]
    dy = end[1] - start[1]
    dz = end[2] - start[2]
    px = point[0] - start[0]
    py = point[1] - start[1]
    pz = point[2] - start[2]
    length2 = dx * dx + dy * dy + dz * dz
    share = 0.0 if length2 == 0.0 else min(1.0, max(0.0, (px * dx + py * dy + pz * dz) / length2))
    return math.hypot(px - share * dx, py - share * dy, pz - share * dz)


def segment_gap(a: Point, b: Point, c: Point, d: Point) -> tuple[float, Point]:
    """Return the distance between segments a-b and c-d, and the midpoint of their closest points.

    Algorithm: Ericson, "Real-Time Collision Detection", section 5.1.9.
    """
    ux = b[0] - a[0]
    uy = b[1] - a[1]
    uz = b[2] - a[2]
    vx = d[0] - c[0]
    vy = d[1] - c[1]
    vz = d[2] - c[2]
    wx = a[0] - c[0]
    wy = a[1] - c[1]
    wz = a[2] - c[2]
    uu = ux * ux + uy * uy + uz * uz
    vv = vx * vx + vy * vy + vz * vz
    uv = ux * vx + uy * vy + uz * vz
    uw = ux * wx + uy * wy + uz * wz
    vw = vx * wx + vy * wy + vz * wz
    slant = uu * vv - uv * uv
    s = min(1.0, max(0.0, (uv * vw - uw * vv) / slant)) if slant > 1e-12 else 0.0
    t = (uv * s + vw) / vv if vv > 0.0 else 0.0
    if not 0.0 <= t <= 1.0:
        t = min(1.0, max(0.0, t))
        s = min(1.0, max(0.0, (uv * t - uw) / uu)) if uu > 0.0 else 0.0
    one = (a[0] + s * ux, a[1] + s * uy, a[2] + s * uz)
    two = (c[0] + t * vx, c[1] + t * vy, c[2] + t * vz)
    joint = ((one[0] + two[0]) / 2.0, (one[1] + two[1]) / 2.0, (one[2] + two[2]) / 2.0)
    return math.dist(one, two), joint
