"""How often lines cross, told before anything is worked out that takes longer the more often they do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import shapely

Line = npt.NDArray[np.float64]
"""The corners of a line in order, in metres: one a row."""

_AT_ONCE = 64
"""Pieces that are compared with all others at a time: of 30,000, these make a million pairs."""
_MAX_PAIRS = 2_500_000
"""Pairs of pieces that are looked at, within a second: as many as a way of two thousand pieces side by side has."""


def crossings(lines: Sequence[Line], at_most: int) -> int:
    """How many pairs of straight pieces cross, within a line and between lines; pieces that only touch do not.

    Pieces are looked up by their bounding boxes: n pieces of which k pairs are near each other cost O(n log n + k).

    Args:
        lines: of two corners or more each.
        at_most: where the count ends; there are more, or more than can be looked at, where the result is larger.
    """
    starts = np.concatenate([line[:-1] for line in lines]) if lines else np.empty((0, 2))
    ends = np.concatenate([line[1:] for line in lines]) if lines else np.empty((0, 2))
    pieces = shapely.linestrings(np.stack([starts, ends], axis=1)) if len(starts) else np.empty(0, dtype=object)
    tree = shapely.STRtree(pieces)
    found = looked_at = 0
    for first in range(0, len(pieces), _AT_ONCE):
        one, other = tree.query(pieces[first : first + _AT_ONCE])
        one, other = one[other > one + first] + first, other[other > one + first]
        looked_at += len(one)
        found += int(np.count_nonzero(_cross(starts[one], ends[one], starts[other], ends[other])))
        if found > at_most or looked_at > _MAX_PAIRS:
            return at_most + 1
    return found


def _cross(a: Line, b: Line, c: Line, d: Line) -> npt.NDArray[np.bool_]:
    """Whether the pieces from a to b cross those from c to d: the ends of each are on both sides of the other."""
    apart = _side(a, b, c) * _side(a, b, d) < 0
    return apart & (_side(c, d, a) * _side(c, d, b) < 0)


def _side(start: Line, end: Line, place: Line) -> npt.NDArray[np.float64]:
    """On which side of the way from start to end a place is: positive on the left."""
    way, there = end - start, place - start
    return np.sign(way[:, 0] * there[:, 1] - way[:, 1] * there[:, 0])
