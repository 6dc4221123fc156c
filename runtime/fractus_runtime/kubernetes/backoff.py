"""How long to wait before trying again: exponential, with jitter and a cap."""

from __future__ import annotations

import random


class Backoff:
    """Delays that double from first_s up to cap_s, each cut by up to half so that nodes do not march in step."""

    def __init__(self, first_s: float, cap_s: float, rng: random.Random | None = None) -> None:
        self._first_s = first_s
        self._cap_s = cap_s
        self._rng = rng or random.Random()  # noqa: S311 (jitter, not a secret)
        self._attempts = 0

    @property
    def attempts(self) -> int:
        """Delays given since the last success."""
        return self._attempts

    def delay_s(self) -> float:
        """The next delay in seconds."""
        full_s = min(self._cap_s, self._first_s * 2.0 ** min(self._attempts, 32))
        self._attempts += 1
        return full_s * self._rng.uniform(0.5, 1.0)

    def succeeded(self) -> None:
        """Start from the first delay again."""
        self._attempts = 0
