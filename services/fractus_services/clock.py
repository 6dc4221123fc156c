"""Wall-clock time that does not go back when the clock is set back."""

from __future__ import annotations

import logging
import time

from fractus_core.policy.values import Moment

log = logging.getLogger(__name__)

TRUST_AFTER_S = 120.0
"""A clock that was set back and has run this long since is right: what it showed before was a glitch."""

MAX_SLEW_S = 1.0
"""How far NTP sets a clock back in normal operation."""


class Clock:
    """Unix time in seconds.

    A clock that is set back must not bring expired certificates and policies back to life, and one that jumped ahead for
    a moment must not end them for good. Until it is clear which of the two happened, the time is a `Moment`: what it is
    as a number is the later reading, so that certificates are expired at either, and the policy engine counts both
    against the caller.
    """

    def __init__(self) -> None:
        self._offset_s = time.time() - time.monotonic()
        self._behind_since_s: float | None = None

    def __call__(self) -> float:
        """Now."""
        steady_s = time.monotonic()
        offset_s = time.time() - steady_s
        back_s = self._offset_s - offset_s
        if back_s <= MAX_SLEW_S:
            self._behind_since_s = None
        elif self._behind_since_s is None:
            self._behind_since_s = steady_s
        if self._behind_since_s is not None and steady_s - self._behind_since_s < TRUST_AFTER_S:
            return Moment(steady_s + self._offset_s, steady_s + offset_s)
        if back_s > MAX_SLEW_S:
            log.warning("clock: set back, now trusted (seconds=%.0f)", back_s)
        self._offset_s, self._behind_since_s = offset_s, None
        return steady_s + offset_s
