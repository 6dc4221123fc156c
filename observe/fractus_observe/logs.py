"""Logs that no one can fill the disk with: what a peer, a camera or an autopilot can make us say is limited."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

BURST = 50
"""Records of one line of the program that are written one after the other."""
RATE_PER_S = 0.5
"""Records of one line of the program that are written from then on."""


class LogLimit(logging.Filter):
    """Limits the records of each line of the program; the next one that is written tells how many were left out.

    Args:
        monotonic: seconds that never jump.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._monotonic = monotonic
        self._lines: dict[tuple[str, int], list[float]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write a record."""
        now_s = self._monotonic()
        # Left, since when, left out; by the line of code, of which there are not many, whatever the text.
        line = self._lines.setdefault((record.pathname, record.lineno), [BURST, now_s, 0])
        line[:2] = min(line[0] + (now_s - line[1]) * RATE_PER_S, BURST), now_s
        if line[0] < 1:
            line[2] += 1
            return False
        line[0] -= 1
        if line[2]:
            record.msg, record.args = f"{record.getMessage()} (left_out={line[2]:.0f})", None
            line[2] = 0
        return True


def configure(level: str | int) -> None:
    """Write the log to stderr, within the limit."""
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    for handler in logging.getLogger().handlers:
        handler.addFilter(LogLimit())
