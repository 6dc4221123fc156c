"""Which nodes together reach most of an area: greedy coverage by communication discs (thesis Algorithm 10)."""

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
"""About how many samples an area gets; more if it is long and narrow."""

_MAX_SAMPLES = 200_000
_MAX_CROSSINGS = 1_000_000
"""How often the outline may cross the lattice's rows: a region may be a millimetre wide and many kilometres long."""
_ACROSS = 4
"""Samples across the width of a narrow area, so that a corridor is not missed between two rows."""
_TILT_RAD = math.atan((math.sqrt(5) - 1) / 2)
"""The lattice's rows follow no direction that roads and manifests like, so that straight legs are sampled evenly."""

_BATCH = 256
"""Stale bounds looked at again at once: numpy's overhead for one call is that of hundreds of numbers."""
_CHUNK = 2048
"""Candidates whose runs are found at once; bounds the memory of one step."""
_TABLE = 2_000_000
"""Places of a lattice up to which ranks come from a table; beyond, from a binary search."""
_REMEMBERED = 4_000_000
"""Runs up to which all of them are kept, some 64 MB; beyond, they are found again when needed."""


class Samples:
    """A square lattice of points inside an area: how much of the area something covers becomes a count.

    Counting makes gains whole numbers, so that ties are ties and a plan does not depend on rounding. Shares are within
    1 % of the exact areas.
    """

    __slots__ = ("_columns", "_first", "_keys", "_ranks", "_rows", "spacing_m")

    def __init__(self, shape: BaseGeometry) -> None:
        area, outline = float(shape.area), float(shape.length)
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
        """How many samples there are."""
        return len(self._keys)

    def xy(self) -> _Floats:
        """The samples in metres east and north, shape (n, 2)."""
        rows = self._keys // self._columns + self._first[0]
        columns = self._keys % self._columns + self._first[1]
        return _turned(np.column_stack((columns + 0.5, rows + 0.5)) * self.spacing_m, _TILT_RAD)

    def runs(self, xy: _Floats, reach_m: _Floats) -> tuple[_Integers, _Integers, _Integers]:
        """The samples within reach of each node, as runs of consecutive ones: one run a node and row of the lattice.

        Returns:
            For each run the node (its row in xy), the first sample, and the one after the last.
        """
        turned = _turned(xy, -_TILT_RAD) / self.spacing_m - 0.5
        reach = reach_m / self.spacing_m
        lowest = np.maximum(np.ceil(turned[:, 1] - reach).astype(np.int64), self._first[0])
        highest = np.minimum(np.floor(turned[:, 1] + reach).astype(np.int64), self._first[0] + self._rows - 1)
        node, row = _ranges(lowest, highest + 1)
        x, y, r = turned[node, 0], turned[node, 1], reach[node]
        half = np.sqrt(np.maximum(r * r - (row - y) ** 2, 0.0))
        left = np.clip(np.ceil(x - half) - self._first[1], 0, self._columns).astype(np.int64)
        right = np.clip(np.floor(x + half) - self._first[1] + 1, 0, self._columns).astype(np.int64)
        base = (row - self._first[0]) * self._columns
        some = right > left
        node, base, left, right = node[some], base[some], left[some], right[some]
        return node, self._rank(base + left), self._rank(base + right)

    def _rank(self, keys: _Integers) -> _Integers:
        """How many samples come before each place of the lattice."""
        return np.searchsorted(self._keys, keys) if self._ranks is None else self._ranks[keys]


@dataclass(frozen=True, slots=True)
class CoverScene:
    """What a coverage strategy decides on.

    Attributes:
        samples: the area.
        names: the candidates; among equals the earlier one is to be preferred.
        xy: where they are, metres east and north, shape (n, 2).
        reach_m: how far each can talk directly to what moves in the area, shape (n,).
        share: the share of the area to reach.
        kept: candidates that have an instance already and should keep it while it is of use.
        covered_by: discs that are covered anyway: x, y, reach, shape (m, 3).
        newly_covered_by: discs that new instances cover; what is kept need not yield to them.
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
    """A chosen candidate and the share of the area that it adds to those chosen before."""

    name: str
    share: float


CoverStrategy = Callable[[CoverScene, Callable[[str], bool]], Sequence[Pick]]
"""Chooses candidates of a scene in order; the function says whether a candidate fits, and is asked once for each."""


def greedy_cover(scene: CoverScene, fits: Callable[[str], bool]) -> list[Pick]:
    """Pick the candidate that adds most, again and again, until the share is reached or nothing is added.

    Candidates that are kept come first, so that a new plan moves as little as it can. Gains only shrink as picks
    are made, so that a gain known from before is an upper bound, and only the candidates with the highest bounds are
    looked at again (lazy evaluation: M. Minoux 1978; CELF: J. Leskovec et al., KDD 2007).
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
    """What is covered so far, and for each candidate a bound on what it would add."""

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
        """Cover what some discs reach."""
        if discs is not None and len(discs):
            self._cover(*self._scene.samples.runs(discs[:, :2], discs[:, 2])[1:])

    def consider(self, candidates: _Integers) -> None:
        """Let these candidates take part, unless they were taken or dropped."""
        candidates = candidates[~self._gone[candidates] & ~self._fresh[candidates]]
        for start in range(0, len(candidates), _CHUNK):
            self._refresh(candidates[start : start + _CHUNK])

    def enough(self) -> bool:
        """Whether the wanted share is covered."""
        total = len(self._open)
        return total - int(self._before[-1]) >= self._scene.share * total

    def best(self) -> int | None:
        """The candidate that adds most, the first among equals; None when none adds anything."""
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
        """Cover what the candidate reaches; the share of the area that this adds."""
        gain = int(self._bounds[candidate])
        self._cover(*self._runs.of(np.array([candidate]))[1:])
        self.drop(candidate)
        return gain / len(self._open)

    def drop(self, candidate: int) -> None:
        """Let a candidate take part no longer."""
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
    """The runs of samples that each candidate reaches: found once, and remembered unless there are too many."""

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
        """As Samples.runs, of these candidates."""
        if self._starts is None:
            return self._scene.samples.runs(self._scene.xy[candidates], self._scene.reach_m[candidates])
        node, run = _ranges(self._starts[candidates], self._starts[candidates + 1])
        return node, self._first[run], self._end[run]


def _lattice(shape: BaseGeometry, spacing_m: float) -> tuple[_Integers, _Integers]:
    """Rows and columns of the tilted lattice's points in the shape, in order; found by scan lines, O(points + edges)."""
    coordinates, ring = shapely.get_coordinates(
        shapely.get_rings(shapely.get_parts(shapely.get_parts(shape))), return_index=True
    )
    turned = _turned(coordinates, -_TILT_RAD) / spacing_m - 0.5
    joined = ring[1:] == ring[:-1]
    a, b = turned[:-1][joined], turned[1:][joined]
    upwards = (a[:, 1] <= b[:, 1])[:, None]
    low, high = np.where(upwards, a, b), np.where(upwards, b, a)
    edge, row = _ranges(np.ceil(low[:, 1]).astype(np.int64), np.ceil(high[:, 1]).astype(np.int64))
    rise = (row - low[edge, 1]) / (high[edge, 1] - low[edge, 1])
    crossing = low[edge, 0] + rise * (high[edge, 0] - low[edge, 0])
    order = np.lexsort((crossing, row))
    row, crossing = row[order], crossing[order]
    run, column = _ranges(np.ceil(crossing[0::2]).astype(np.int64), np.ceil(crossing[1::2]).astype(np.int64))
    if len(column) == 0:
        inside = _turned(shapely.get_coordinates(shape.representative_point()), -_TILT_RAD) / spacing_m
        corner = np.floor(inside[0]).astype(np.int64)
        return corner[1:2], corner[0:1]
    return row[0::2][run], column


def _ranges(starts: _Integers, ends: _Integers) -> tuple[_Integers, _Integers]:
    """The whole numbers of many half-open ranges in a row, each with the range it is of."""
    counts = np.maximum(ends - starts, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    offset = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, starts[owner] + offset


def _turned(xy: _Floats, angle_rad: float) -> _Floats:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.column_stack((cos * xy[:, 0] - sin * xy[:, 1], sin * xy[:, 0] + cos * xy[:, 1]))
