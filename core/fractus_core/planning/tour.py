"""A short way through points that may be visited in any order."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_MAX_EXACT = 9
_MAX_PASSES = 50


def short_tour(xy: Sequence[tuple[float, float]]) -> list[int]:
    """The order in which to visit points, starting with the first and ending anywhere.

    The shortest for up to nine points (dynamic programming, M. Held and R. Karp 1962); for more the nearest neighbour's
    tour, untangled by 2-opt, O(n^2) a pass. The same points always give the same order.
    """
    places = np.array(xy, dtype=np.float64).reshape(-1, 2)
    distance = np.hypot(*(places[:, None, :] - places[None, :, :]).transpose(2, 0, 1))
    if len(places) <= 2:
        return list(range(len(places)))
    if len(places) <= _MAX_EXACT:
        return _shortest(distance)
    return _untangled(_greedy(distance), distance)


def _shortest(distance: NDArray[np.float64]) -> list[int]:
    count = len(distance)
    best: dict[tuple[int, int], tuple[float, tuple[int, ...]]] = {(1, 0): (0.0, (0,))}
    for size in range(1, count):
        for chosen in itertools.combinations(range(1, count), size):
            visited = 1 | sum(1 << i for i in chosen)
            for last in chosen:
                before = visited & ~(1 << last)
                best[visited, last] = min(
                    (length + float(distance[i, last]), (*tour, last))
                    for i in range(count)
                    if (before, i) in best
                    for length, tour in (best[before, i],)
                )
    full = (1 << count) - 1
    return list(min(best[full, last] for last in range(1, count))[1])


def _greedy(distance: NDArray[np.float64]) -> list[int]:
    tour = [0]
    left = np.ones(len(distance), dtype=bool)
    left[0] = False
    while left.any():
        nearest = int(np.argmin(np.where(left, distance[tour[-1]], np.inf)))
        tour.append(nearest)
        left[nearest] = False
    return tour


def _untangled(tour: list[int], distance: NDArray[np.float64]) -> list[int]:
    order = np.array(tour)
    for _ in range(_MAX_PASSES):
        improved = False
        for i in range(len(order) - 2):
            # Reverse order[i+1..j]: the edges (i, i+1) and (j, j+1) become (i, j) and (i+1, j+1); the end is open.
            a, b = order[i], order[i + 1]
            ends, after = order[i + 2 :], order[i + 3 :]
            change = distance[a, ends] - distance[a, b]
            change[:-1] += distance[b, after] - distance[ends[:-1], after]
            j = int(np.argmin(change))
            if change[j] < -1e-9:
                order[i + 1 : i + 3 + j] = order[i + 1 : i + 3 + j][::-1]
                improved = True
        if not improved:
            break
    return [int(i) for i in order]
