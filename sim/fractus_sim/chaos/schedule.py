"""Which fault happens when: the same seed gives the same schedule."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass

FIRST_S = 10.0
"""The first fault meets a mission that is being deployed."""

MAX_SHARE = 1 / 3
"""Of a run: no fault lasts longer."""

OVERLAP_S = 10.0
PAUSE_S = 25.0


@dataclass(frozen=True, slots=True)
class Planned:
    """One fault.

    Attributes:
        at_s: seconds after the beginning of the run.
        fault: its name.
        duration_s: how long it lasts; 0 for one that is over at once.
    """

    at_s: float
    fault: str
    duration_s: float


def schedule(seed: int, run_s: float, durations: Mapping[str, tuple[float, float]]) -> tuple[Planned, ...]:
    """The faults of a run: each kind once in random order, then again, a little apart or one within another.

    A fault never meets itself, and all are over before the run is.

    Args:
        seed: of all that is random.
        run_s: how long the run is, seconds.
        durations: for each fault its shortest and longest duration, seconds.
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
