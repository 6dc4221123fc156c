"""Exponential back-off with jitter and a maximum.

The SDK must not import this package, so it has a separate back-off (`fractus.channel.backoff`).
"""

from __future__ import annotations

import random


class Backoff:
    """Delays between retries that double up to a maximum. Jitter shortens each delay by up to half, so that nodes diverge.

    Args:
        first_s: First delay, in seconds.
        cap_s: Maximum delay, in seconds.
        rng: Source of the jitter.
    """

    def __init__(self, first_s: float, cap_s: float, rng: random.Random | None = None) -> None:
        self._first_s = first_s
        self._cap_s = cap_s
        self._rng = rng or random.Random()  # noqa: S311 (jitter, not a secret)
        self._attempts = 0

    @property
    def attempts(self) -> int:
        """Number of delays since the last success."""
        return self._attempts

    def delay_s(self) -> float:
        """Return the next delay in seconds."""
        full_s = min(self._cap_s, self._first_s * 2.0 ** min(self._attempts, 32))
        self._attempts += 1
        return full_s * self._rng.uniform(0.5, 1.0)

    def succeeded(self) -> None:
        """Reset to the first delay."""
        self._attempts = 0
