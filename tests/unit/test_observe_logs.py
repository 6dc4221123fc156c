"""Logs that no one can fill the disk with."""

from __future__ import annotations

import logging

import pytest
from fractus_storage.logs import BURST, RATE_PER_S, LogLimit


class Log:
    """A log with a limit, and what is written to it."""

    def __init__(self) -> None:
        self.now_s = 10.0
        self.limit = LogLimit(lambda: self.now_s)

    def written(self, line: int, text: str = "peer %s", *args: object) -> str | None:
        record = logging.LogRecord("n", logging.ERROR, "module.py", line, text, args or ("a",), None)
        return record.getMessage() if self.limit.filter(record) else None


def test_a_line_is_written_so_often_at_most_and_tells_what_was_left_out() -> None:
    log = Log()
    assert [log.written(1, "peer %s", number) for number in range(BURST)] == [f"peer {n}" for n in range(BURST)]
    assert [log.written(1) for _ in range(1000)] == [None] * 1000
    assert log.written(2) == "peer a", "other lines have their own limit"
    log.now_s += 1 / RATE_PER_S
    assert [log.written(1), log.written(1)] == ["peer a (left_out=1000)", None]
    log.now_s += 1e6
    assert [log.written(1) for _ in range(BURST + 1)] == ["peer a (left_out=1)", *["peer a"] * (BURST - 1), None]


def test_a_day_of_a_flood_fits_a_small_disk() -> None:
    log, kept = Log(), 0
    for _ in range(100_000):
        kept += log.written(1) is not None
        log.now_s += 86_400 / 100_000
    assert kept == pytest.approx(86_400 * RATE_PER_S + BURST, abs=2)
