"""Unix time that tolerates steps of the system clock, and steady time that steps do not affect."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from fractus_core.policy.decision_types import UncertainTime

log = logging.getLogger(__name__)

TRUST_AFTER_S = 120.0
"""Time after a step until the new reading is trusted."""

MAX_SLEW_S = 1.0
"""Maximum correction by NTP in normal operation."""


def steady_s() -> float:
    """Return steady seconds. Clock steps do not affect them, and they continue while the machine is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Clock:
    """Unix time in seconds.

    A clock step must neither revive an expired permission nor end a restriction early. Until the step is confirmed, the time is
    an `UncertainTime` from the earliest to the latest reading: the reading before the first step, and the readings after each
    step since then. The policy engine applies every restriction that is in force at any time between them.
    Callers that were authenticated before the step stay authenticated by steady time (`auth.Callers`).

    Args:
        stepped: Callback invoked for each step with its size in seconds, and True if the new reading is now trusted. A size of 0
            means that the step was reversed. It may be invoked from any thread.
    """

    def __init__(self, stepped: Callable[[float, bool], None] = lambda _step_s, _trusted: None) -> None:
        self._stepped = stepped
        self._offset_s = time.time() - steady_s()
        self._new_offset_s = self._offset_s
        self._offsets_s = (self._offset_s, self._offset_s)
        self._uncertain_since_s: float | None = None

    def __call__(self) -> float:
        """Return the current time."""
        now_s = steady_s()
        offset_s = time.time() - now_s
        step_s = offset_s - self._offset_s
        if abs(step_s) <= MAX_SLEW_S:
            if self._uncertain_since_s is not None:
                self._uncertain_since_s = None
                log.warning("clock: step reversed")
                self._stepped(0.0, True)
            self._offset_s = offset_s
            self._offsets_s = (offset_s, offset_s)
            return now_s + offset_s
        self._offsets_s = min(offset_s, self._offsets_s[0]), max(offset_s, self._offsets_s[1])
        if self._uncertain_since_s is None or abs(offset_s - self._new_offset_s) > MAX_SLEW_S:
            self._uncertain_since_s = now_s
            self._new_offset_s = offset_s
            log.warning(
                "clock: stepped, all times between the readings apply for now (seconds=%.0f for_s=%.0f)",
                step_s,
                TRUST_AFTER_S,
            )
            self._stepped(step_s, False)
        if now_s - self._uncertain_since_s < TRUST_AFTER_S:
            return UncertainTime(now_s + self._offsets_s[1], now_s + self._offsets_s[0])
        self._offset_s = offset_s
        self._offsets_s = (offset_s, offset_s)
        self._uncertain_since_s = None
        log.warning("clock: step confirmed, the new reading applies (seconds=%.0f)", step_s)
        self._stepped(step_s, True)
        return now_s + offset_s
