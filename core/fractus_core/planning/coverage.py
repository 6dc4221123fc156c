"""Selection of nodes that cover an area: greedy coverage by communication discs (thesis Algorithm 10)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]

SAMPLES = 8192
"""Approximate number of samples of an area. Long and narrow areas have more."""

_MAX_SAMPLES = 200_000
_MAX_CROSSINGS = 1_000_000
"""Maximum number of crossings of outline and lattice rows.

Without this maximum, a region that is a millimetre wide and kilometres long would need too many rows.
"""
_ACROSS = 4
"""Number of samples across a narrow area. With fewer samples, a corridor could lie between two rows."""
_TILT_RAD = math.atan((math.sqrt(5) - 1) / 2)
"""Tilt of the lattice rows. No usual direction of roads or paths is parallel to them, so straight legs are sampled evenly."""

_BATCH = 256
"""Number of outdated bounds that one numpy call updates. One call per bound would be slower."""
_CHUNK = 2048
"""Number of candidates whose runs of covered samples are computed by one numpy call. The number limits the memory."""
_TABLE = 2_000_000
"""Maximum lattice size for a table of ranks. Larger lattices use binary search."""
_REMEMBERED = 4_000_000
"""Maximum number of runs that are cached (about 64 MB). If there are more runs, they are computed again when needed."""


class Samples:
    """A square lattice of points inside an area, with which coverage is counted.

    Counts are integers, so ties are exact and a plan does not depend on rounding. Shares are within 1 % of exact areas.
    """

    __slots__ = ("_columns", "_first", "_keys", "_ranks", "_rows", "spacing_m")

    def __init__(self, shape: BaseGeometry) -> None:
        area = float(shape.area)
        outline = float(shape.length)
        width = 2 * area / outline
        finest = max(math.sqrt(area / _MAX_SAMPLES), outline / _MAX_CROSSINGS)
        self.spacing_m = max(finest, min(math.sqrt(area / SAMPLES), width / _ACROSS))
        rows, columns = _lattice(shape, self.spacing_m)
        self._first = (int(rows.min()), int(columns.min()))
        self._rows = int(rows.max()) - self._first[0] + 1
        self._columns = int(columns.max()) - self._first[1] + 1
        self._keys: _Integers = (rows - self._first[0]) * self._columns + (columns - self._first[1])
        self._ranks: _Integers | None = None
        if self._rows * self._columns <= _TABLE:
            taken = np.zeros(self._rows * self._columns + 1, dtype=np.int64)
            taken[self._keys + 1] = 1
            self._ranks = np.cumsum(taken)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self._keys)

    def xy(self) -> _Floats:
        """Return the samples in metres east and north, shape (n, 2)."""
        rows = self._keys // self._columns + self._first[0]
        columns = self._keys % self._columns + self._first[1]
        return _turned(np.column_stack((columns + 0.5, rows + 0.5)) * self.spacing_m, _TILT_RAD)

    def runs(self, xy: _Floats, reach_m: _Floats) -> tuple[_Integers, _Integers, _Integers]:
        """Return the samples in range of each node as runs of consecutive samples, one per node and lattice row.

        Returns:
            For each run, the node (its row in xy), the first sample, and the sample after the last one.
        """
        turned = _turned(xy, -_TILT_RAD) / self.spacing_m - 0.5
        reach = reach_m / self.spacing_m
        lowest = np.maximum(np.ceil(turned[:, 1] - reach).astype(np.int64), self._first[0])
        highest = np.minimum(np.floor(turned[:, 1] + reach).astype(np.int64), self._first[0] + self._rows - 1)
        node, row = _ranges(lowest, highest + 1)
        x = turned[node, 0]
        y = turned[node, 1]
        r = reach[node]
        half = np.sqrt(np.maximum(r * r - (row - y) ** 2, 0.0))
        left = np.clip(np.ceil(x - half) - self._first[1], 0, self._columns).astype(np.int64)
        right = np.clip(np.floor(x + half) - self._first[1] + 1, 0, self._columns).astype(np.int64)
        base = (row - self._first[0]) * self._columns
        some = right > left
        node = node[some]
        base = base[some]
        left = left[some]
        right = right[some]
        return node, self._rank(base + left), self._rank(base + right)

    def _rank(self, keys: _Integers) -> _Integers:
        """Return the number of samples before each lattice position."""
        return np.searchsorted(self._keys, keys) if self._ranks is None else self._ranks[keys]


@dataclass(frozen=True, slots=True)
class CoverScene:
    """Input of a coverage strategy.

    Attributes:
        samples: Samples of the area.
        names: Candidates; the earlier one of equal candidates is preferred.
        xy: Positions in metres east and north, shape (n, 2).
        reach_m: Range of direct links to the drone in metres, shape (n,).
        share: Share of the area to cover, 0 to 1.
        kept: Candidates that have an instance already. A candidate keeps its instance if the instance adds coverage.
        covered_by: Discs that are already covered: x, y, range, shape (m, 3).
        newly_covered_by: Discs that new instances cover: x, y, range. They count after the kept candidates were
            selected.
    """

    samples: Samples
    names: Sequence[str]
    xy: _Floats
    reach_m: _Floats
    share: float
    kept: frozenset[str] = frozenset()
    covered_by: _Floats | None = None
    newly_covered_by: _Floats | None = None


@dataclass(frozen=True, slots=True)
class Pick:
    """A selected candidate and the share of the area that it adds to the coverage."""

    name: str
    share: float


CoverStrategy = Callable[[CoverScene, Callable[[str], bool]], Sequence[Pick]]
"""Function that selects candidates of a scene in order.

Its second argument is a function that returns True if a candidate fits. This function is called once for each
candidate.
"""


def greedy_cover(scene: CoverScene, fits: Callable[[str], bool]) -> list[Pick]:
    """Select the candidate that adds most coverage, repeatedly, until the share is reached or no candidate adds coverage.

    Kept candidates come first, so a new plan moves as few instances as possible. Gains never grow, so an earlier gain is an
    upper bound, and only the candidates with the highest bounds are evaluated again (lazy evaluation: M. Minoux 1978;
    CELF: J. Leskovec et al., KDD 2007).
    """
    state = _State(scene)
    picks: list[Pick] = []
    kept = np.array([name in scene.kept for name in scene.names], dtype=bool)
    for group, discs in (
        (np.flatnonzero(kept), scene.covered_by),
        (np.arange(len(scene.names)), scene.newly_covered_by),
    ):
        state.cover(discs)
        state.consider(group)
        while not state.enough():
            best = state.best()
            if best is None:
                break
            if fits(scene.names[best]):
                picks.append(Pick(scene.names[best], state.take(best)))
            else:
                state.drop(best)
    return picks


class _State:
    """Covered samples, and an upper bound of the gain of each candidate."""

    def __init__(self, scene: CoverScene) -> None:
        self._scene = scene
        self._open = np.ones(len(scene.samples), dtype=np.int64)
        self._before = np.zeros(len(scene.samples) + 1, dtype=np.int64)
        self._gone = np.zeros(len(scene.names), dtype=bool)
        self._bounds = np.full(len(scene.names), -1, dtype=np.int64)
        self._fresh = np.zeros(len(scene.names), dtype=bool)
        self._runs = _Runs(scene)
        self._count()

    def cover(self, discs: _Floats | None) -> None:
        """Mark the samples in discs as covered."""
        if discs is not None and len(discs):
            self._cover(*self._scene.samples.runs(discs[:, :2], discs[:, 2])[1:])

    def consider(self, candidates: _Integers) -> None:
        """Add candidates, unless they were selected or dropped before."""
        candidates = candidates[~self._gone[candidates] & ~self._fresh[candidates]]
        for start in range(0, len(candidates), _CHUNK):
            self._refresh(candidates[start : start + _CHUNK])

    def enough(self) -> bool:
        """Return True if the requested share is covered."""
        total = len(self._open)
        return total - int(self._before[-1]) >= self._scene.share * total

    def best(self) -> int | None:
        """Return the first candidate that adds most coverage, or None if no candidate adds coverage."""
        while True:
            best = int(np.argmax(self._bounds)) if len(self._bounds) else -1
            if best < 0 or self._bounds[best] <= 0:
                return None
            if self._fresh[best]:
                return best
            stale = np.flatnonzero(~self._fresh & (self._bounds > 0))
            if len(stale) > _BATCH:
                highest = np.argpartition(self._bounds[stale], len(stale) - _BATCH)[-_BATCH:]
                stale = np.union1d(stale[highest], [best])
            self._refresh(stale)

    def take(self, candidate: int) -> float:
        """Cover the disc of a candidate, and return the share of the area that it adds."""
        gain = int(self._bounds[candidate])
        self._cover(*self._runs.of(np.array([candidate]))[1:])
        self.drop(candidate)
        return gain / len(self._open)

    def drop(self, candidate: int) -> None:
        """Exclude a candidate."""
        self._gone[candidate] = True
        self._bounds[candidate] = -1

    def _refresh(self, candidates: _Integers) -> None:
        node, first, end = self._runs.of(candidates)
        gains = np.bincount(node, weights=self._before[end] - self._before[first], minlength=len(candidates))
        self._bounds[candidates] = gains.astype(np.int64)
        self._fresh[candidates] = True

    def _cover(self, first: _Integers, end: _Integers) -> None:
        for a, b in zip(first.tolist(), end.tolist(), strict=True):
            self._open[a:b] = 0
        self._count()
        self._fresh[:] = False

    def _count(self) -> None:
        np.cumsum(self._open, out=self._before[1:])


class _Runs:
    """Runs of samples in range of each candidate, cached unless there are too many."""

    def __init__(self, scene: CoverScene) -> None:
        self._scene = scene
        rows = 2 * float(scene.reach_m.sum()) / scene.samples.spacing_m + len(scene.names)
        self._starts: _Integers | None = None
        if rows <= _REMEMBERED:
            parts = [
                scene.samples.runs(scene.xy[i : i + _CHUNK], scene.reach_m[i : i + _CHUNK])
                for i in range(0, len(scene.names), _CHUNK)
            ] or [(np.empty(0, dtype=np.int64),) * 3]
            counts = [np.bincount(part[0], minlength=min(_CHUNK, len(scene.names))) for part in parts]
            self._starts = np.concatenate(([0], np.cumsum(np.concatenate(counts)[: len(scene.names)])))
            self._first = np.concatenate([part[1] for part in parts])
            self._end = np.concatenate([part[2] for part in parts])

    def of(self, candidates: _Integers) -> tuple[_Integers, _Integers, _Integers]:
        """Return the result of `Samples.runs` for some candidates."""
        if self._starts is None:
            return self._scene.samples.runs(self._scene.xy[candidates], self._scene.reach_m[candidates])
        node, run = _ranges(self._starts[candidates], self._starts[candidates + 1])
        return node, self._first[run], self._end[run]


def _lattice(shape: BaseGeometry, spacing_m: float) -> tuple[_Integers, _Integers]:
    """Return rows and columns of the tilted lattice's points in a shape, in order, by scan lines in O(points + edges)."""
    coordinates, ring = shapely.get_coordinates(
        shapely.get_rings(shapely.get_parts(shapely.get_parts(shape))), return_index=True
    )
    turned = _turned(coordinates, -_TILT_RAD) / spacing_m - 0.5
    joined = ring[1:] == ring[:-1]
    a = turned[:-1][joined]
    b = turned[1:][joined]
    upwards = (a[:, 1] <= b[:, 1])[:, None]
    low = np.where(upwards, a, b)
    high = np.where(upwards, b, a)
    edge, row = _ranges(np.ceil(low[:, 1]).astype(np.int64), np.ceil(high[:, 1]).astype(np.int64))
    rise = (row - low[edge, 1]) / (high[edge, 1] - low[edge, 1])
    crossing = low[edge, 0] + rise * (high[edge, 0] - low[edge, 0])
    order = np.lexsort((crossing, row))
    row = row[order]
    crossing = crossing[order]
    run, column = _ranges(np.ceil(crossing[0::2]).astype(np.int64), np.ceil(crossing[1::2]).astype(np.int64))
    if len(column) == 0:
        inside = _turned(shapely.get_coordinates(shape.representative_point()), -_TILT_RAD) / spacing_m
        corner = np.floor(inside[0]).astype(np.int64)
        return corner[1:2], corner[0:1]
    return row[0::2][run], column


def _ranges(starts: _Integers, ends: _Integers) -> tuple[_Integers, _Integers]:
    """Concatenate the integers of half-open ranges. Return the range index of each integer, and the integers."""
    counts = np.maximum(ends - starts, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    offset = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, starts[owner] + offset


def _turned(xy: _Floats, angle_rad: float) -> _Floats:
    cos = math.cos(angle_rad)
    sin = math.sin(angle_rad)
    return np.column_stack((cos * xy[:, 0] - sin * xy[:, 1], sin * xy[:, 0] + cos * xy[:, 1]))
