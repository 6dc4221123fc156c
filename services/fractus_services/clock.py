"""Wall-clock time of a machine whose clock may be stepped, and the steady time that no step moves."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from fractus_core.policy.decision_types import UncertainTime

log = logging.getLogger(__name__)

TRUST_AFTER_S = 120.0
"""A clock that has run on for this long after a step is right: what it showed before was wrong."""

MAX_SLEW_S = 1.0
"""How far NTP sets a clock in normal operation."""


def steady_s() -> float:
    """Seconds that no step of the clock moves; unlike the event loop's, they go on while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Clock:
    """Unix time in seconds.

    A clock that is stepped, back or ahead, must neither bring what has expired back to life nor end at once what restricts.
    Until it is clear which reading is right, the time is a `UncertainTime`: what it is as a number is the later reading, and the
    policy engine counts both against the caller. Who was let in before the step stays in by steady time (`auth.Callers`).

    Args:
        stepped: told of each step, in seconds, and whether the new reading counts from now on; 0: it was taken back. This may
            be from any thread.
    """

    def __init__(self, stepped: Callable[[float, bool], None] = lambda _step_s, _trusted: None) -> None:
        self._stepped = stepped
        self._offset_s = self._stepped_to_s = time.time() - steady_s()
        self._doubted_since_s: float | None = None

    def __call__(self) -> float:
        """Now."""
        now_s = steady_s()
        offset_s = time.time() - now_s
        step_s = offset_s - self._offset_s
        if abs(step_s) <= MAX_SLEW_S:
            if self._doubted_since_s is not None:
                self._doubted_since_s = None
                log.warning("clock: the step was taken back")
                self._stepped(0.0, True)
            self._offset_s = offset_s
            return now_s + offset_s
        if self._doubted_since_s is None or abs(offset_s - self._stepped_to_s) > MAX_SLEW_S:
            self._doubted_since_s, self._stepped_to_s = now_s, offset_s
            log.warning("clock: stepped, both readings count for now (seconds=%.0f for_s=%.0f)", step_s, TRUST_AFTER_S)
            self._stepped(step_s, False)
        if now_s - self._doubted_since_s < TRUST_AFTER_S:
            readings = now_s + self._offset_s, now_s + offset_s
            return UncertainTime(max(readings), min(readings))
        self._offset_s, self._doubted_since_s = offset_s, None
        log.warning("clock: the step lasted, the new reading counts (seconds=%.0f)", step_s)
        self._stepped(step_s, True)
        return now_s + offset_s
