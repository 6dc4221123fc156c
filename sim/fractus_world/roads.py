"""Road network of a seed: two families of winding roads that cross at the vertices of an irregular lattice."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fractus_world.randomness import smooth, unit

Points = NDArray[np.float64]
Family = Literal["east", "north"]

SPACING_M = 300.0
SHIFT_M = (-80.0, -95.0)
"""Offset of the centre of block (0, 0), so that two main roads cross near the world's origin."""
_CROSSING = (1, 1)
_JITTER = 0.2
_MAIN_EVERY = 3
EDGE_POINTS = 33
TOWN_RADIUS_M = 480.0


def centre(i: float, j: float) -> tuple[float, float]:
    """Return the centre of a lattice cell in metres east and north of the world's origin."""
    return i * SPACING_M + SHIFT_M[0], j * SPACING_M + SHIFT_M[1]


def cell(x: float, y: float) -> tuple[float, float]:
    """Return the lattice coordinates of a position. The inverse of `centre`."""
    return (x - SHIFT_M[0]) / SPACING_M, (y - SHIFT_M[1]) / SPACING_M


@dataclass(frozen=True, slots=True)
class Road:
    """A road across the whole network.

    Attributes:
        family: Approximate direction.
        index: Number in the family. Every third road of a family is a main road.
    """

    family: Family
    index: int

    @property
    def main(self) -> bool:
        """True if the road is paved outside of towns and has a centre line."""
        return self.index % _MAIN_EVERY == 1

    def vertex(self, step: int) -> tuple[int, int]:
        """Return the lattice coordinates of a vertex of the road."""
        return (step, self.index) if self.family == "east" else (self.index, step)


class Roads:
    """All roads of a seed."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.vertex = lru_cache(maxsize=65536)(self._vertex)
        self.edge = lru_cache(maxsize=4096)(self._edge)
        self._points = lru_cache(maxsize=4096)(lambda road, step: self.edge(road, step)[:, :2].tolist())
        self.town = lru_cache(maxsize=65536)(self._town)

    def _vertex(self, i: int, j: int) -> tuple[float, float]:
        x, y = centre(i - 0.5, j - 0.5)
        if (i, j) == _CROSSING:
            return x, y
        dx = unit(self.seed, 1, i, j) - 0.5
        dy = unit(self.seed, 2, i, j) - 0.5
        return x + 2 * _JITTER * dx * SPACING_M, y + 2 * _JITTER * dy * SPACING_M

    def _town(self, i: int, j: int) -> bool:
        x = i * SPACING_M
        y = j * SPACING_M
        return (
            smooth(self.seed + 3, x / 1500.0, y / 1500.0) + 0.6 * math.exp(-(x * x + y * y) / TOWN_RADIUS_M**2) > 0.62
        )

    def built_up(self, road: Road, step: int) -> bool:
        """Return True if at least one side of a road has houses from vertex `step` to the next vertex."""
        i, j = road.vertex(step)
        return self.town(i, j) or (self.town(i, j - 1) if road.family == "east" else self.town(i - 1, j))

    def width_m(self, road: Road, step: int) -> float:
        """Return the width of the carriageway from vertex `step` to the next."""
        if road.main:
            return 7.6
        return 6.0 if self.built_up(road, step) else 3.2

    def at(self, road: Road, along: float) -> tuple[float, float, float, float]:
        """Return the point at a fractional vertex number of a road, and its direction in metres per vertex.

        The road is a Catmull-Rom curve through its vertices, so adjacent segments have the same direction where they
        meet.
        """
        step = math.floor(along)
        t = along - step
        p = [self.vertex(*road.vertex(step + k)) for k in (-1, 0, 1, 2)]
        place = []
        direction = []
        for a, b, c, d in zip(*p, strict=True):
            k1 = (c - a) / 2
            k2 = a - 2.5 * b + 2 * c - d / 2
            k3 = (d - a) / 2 + 1.5 * (b - c)
            place.append(b + t * (k1 + t * (k2 + t * k3)))
            direction.append(k1 + t * (2 * k2 + t * 3 * k3))
        return place[0], place[1], direction[0], direction[1]

    def along(self, road: Road, along: float) -> tuple[float, float, float, float]:
        """Return the same values as `at`, linearly interpolated between points of the drawn road.

        It is 20 times faster.
        """
        step = math.floor(along)
        share = (along - step) * (EDGE_POINTS - 1)
        k = min(int(share), EDGE_POINTS - 2)
        (ax, ay), (bx, by) = self._points(road, step)[k : k + 2]
        share -= k
        dx = bx - ax
        dy = by - ay
        return ax + share * dx, ay + share * dy, dx * (EDGE_POINTS - 1), dy * (EDGE_POINTS - 1)

    def _edge(self, road: Road, step: int) -> Points:
        """Return points from vertex `step` to the next: x, y and the unit normal to the left, shape (n, 4)."""
        rows = []
        for k in range(EDGE_POINTS):
            x, y, dx, dy = self.at(road, step + k / (EDGE_POINTS - 1))
            length = math.hypot(dx, dy)
            rows.append((x, y, -dy / length, dx / length))
        return np.array(rows)

    def outline(self, i: int, j: int) -> Points:
        """Return the centre lines of the four roads around block (i, j), counter-clockwise, shape (n, 2)."""
        south = self.edge(Road("east", j), i)
        east = self.edge(Road("north", i + 1), j)
        north = self.edge(Road("east", j + 1), i)
        west = self.edge(Road("north", i), j)
        return np.vstack((south[:-1, :2], east[:-1, :2], north[:0:-1, :2], west[:0:-1, :2]))


def strip(edge: Points, left_m: float, right_m: float) -> Points:
    """Return the polygon between two lines that are parallel to a line. Both distances are positive to the left."""
    return np.vstack((edge[:, :2] + left_m * edge[:, 2:], (edge[:, :2] + right_m * edge[:, 2:])[::-1]))


def lengthened(edge: Points, by_m: float) -> Points:
    """Extend a line at both ends, so that the segments of a crossing meet."""
    ends = []
    for last, direction in ((edge[0], edge[0] - edge[1]), (edge[-1], edge[-1] - edge[-2])):
        step = direction[:2] / math.hypot(direction[0], direction[1]) * by_m
        ends.append(np.concatenate((last[:2] + step, last[2:])))
    return np.vstack((ends[0], edge, ends[1]))
