"""Seeded random numbers: the same keys always give the same numbers, independent of the order of calls."""

from __future__ import annotations

import random

_MASK = (1 << 64) - 1


def mixed(*keys: int) -> int:
    """Return a 64-bit pseudo-random number: splitmix64 (Steele, Lea and Flood) over the keys."""
    state = 0x9E3779B97F4A7C15
    for key in keys:
        state = (state ^ (key & _MASK)) * 0xBF58476D1CE4E5B9 & _MASK
        state = (state ^ state >> 27) * 0x94D049BB133111EB & _MASK
        state ^= state >> 31
    return state


def unit(*keys: int) -> float:
    """Return a pseudo-random number from 0 to 1."""
    return mixed(*keys) / 2**64


def dice(*keys: int) -> random.Random:
    """Return a separate random number generator."""
    return random.Random(mixed(*keys))  # noqa: S311 - a landscape, not a secret


def smooth(seed: int, x: float, y: float) -> float:
    """Return smooth noise from 0 to 1 at a point: random values on a lattice of unit cells, interpolated."""
    i = int(x // 1)
    j = int(y // 1)
    a = x - i
    b = y - j
    a = a * a * (3 - 2 * a)
    b = b * b * (3 - 2 * b)
    low = unit(seed, i, j) * (1 - a) + unit(seed, i + 1, j) * a
    high = unit(seed, i, j + 1) * (1 - a) + unit(seed, i + 1, j + 1) * a
    return low * (1 - b) + high * b
