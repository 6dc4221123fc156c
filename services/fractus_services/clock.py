"""Wall-clock time that never runs backwards while the service lives."""

from __future__ import annotations

import time


class Clock:
    """Unix time in seconds.

    A clock that is set back must not bring expired certificates and policies back to life.
    """

    def __init__(self) -> None:
        self._offset_s = time.time() - time.monotonic()

    def __call__(self) -> float:
        """Now."""
        self._offset_s = max(self._offset_s, time.time() - time.monotonic())
        return time.monotonic() + self._offset_s
