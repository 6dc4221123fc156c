"""Seeded schedule of faults. The same seed gives the same schedule."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass

FIRST_S = 10.0
"""Time of the first fault. The first mission is being deployed then."""

MAX_SHARE = 1 / 3
"""Maximum share of the run that a fault lasts."""

OVERLAP_S = 10.0
PAUSE_S = 25.0


@dataclass(frozen=True, slots=True)
class Planned:
    """A scheduled fault.

    Attributes:
        at_s: Seconds since the start of the run.
        fault: Name of the fault type.
        duration_s: Duration, seconds. 0 for instantaneous faults.
    """

    at_s: float
    fault: str
    duration_s: float


def schedule(seed: int, run_s: float, durations: Mapping[str, tuple[float, float]]) -> tuple[Planned, ...]:
    """Return the faults of a run: all types in random order, repeated, with pauses or overlaps.

    A fault type never overlaps itself, and all faults end before the run.

    Args:
        seed: Seed of all random values.
        run_s: Duration of the run, seconds.
        durations: Minimum and maximum duration of each fault type, seconds.
    """
    chance = random.Random(seed)  # noqa: S311 - chosen to repeat
    planned: list[Planned] = []
    waiting: list[str] = []
    ends: dict[str, float] = {}
    at_s = FIRST_S
    while durations:
        if not waiting:
            waiting = chance.sample(sorted(durations), len(durations))
        fault = waiting.pop()
        at_s = max(at_s, ends.get(fault, 0.0))
        shortest, longest = durations[fault]
        duration_s = round(chance.uniform(shortest, max(shortest, min(longest, run_s * MAX_SHARE))), 1)
        if at_s + duration_s > run_s:
            break
        planned.append(Planned(round(at_s, 1), fault, duration_s))
        ends[fault] = at_s + duration_s
        at_s = max(at_s, ends[fault] - OVERLAP_S) + chance.uniform(0, PAUSE_S)
    return tuple(planned)
