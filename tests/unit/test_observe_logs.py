"""Logs that no one can fill the disk with, and that programs can read."""

from __future__ import annotations

import json
import logging
import math
from typing import Any

import pytest
from fractus_runtime.logs import BURST, MAX_LIMITS, RATE_PER_S, JsonFormatter, LogLimit, configure


class Log:
    """A log with a limit, and what is written to it."""

    def __init__(self) -> None:
        self.now_s = 10.0
        self.limit = LogLimit(lambda: self.now_s)

    def written(self, line: int, text: str = "peer %s", *args: object, limit_by: str = "") -> str | None:
        record = logging.LogRecord("n", logging.ERROR, "module.py", line, text, args or ("a",), None)
        if limit_by:
            record.limit_by = limit_by
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


def test_records_of_different_origin_are_limited_apart_up_to_a_number_of_origins() -> None:
    log = Log()
    assert [log.written(1, limit_by="a") for _ in range(BURST + 7)][BURST:] == [None] * 7
    assert log.written(1, limit_by="b") == "peer a"
    log.now_s += 1 / RATE_PER_S
    assert log.written(1, limit_by="a") == "peer a (left_out=7)"
    kept = [log.written(1, limit_by=f"origin-{number}") for number in range(10 * MAX_LIMITS)]
    assert MAX_LIMITS <= len([text for text in kept if text]) < MAX_LIMITS + BURST
    assert log.written(2) is not None, "a new line of the program is limited by itself"


@pytest.mark.parametrize(("text", "args", "told"), [
    ("disk 100% full", (), "disk 100% full (left_out=1)"), ("disk %(share)d%% full", ({"share": 9},), "disk 9% full (left_out=1)"),
])  # fmt: skip
def test_texts_that_are_no_templates_tell_it_too(text: str, args: tuple[object, ...], told: str) -> None:
    limit, lines = LogLimit(lambda: 10.0 + (len(lines) > BURST) * 1e6), list[str]()
    for _ in range(BURST + 2):
        record = logging.LogRecord("n", logging.ERROR, "module.py", 1, text, args, None)
        lines.append(record.getMessage() if limit.filter(record) else "")
    assert lines[-2:] == ["", told]


def test_a_day_of_a_flood_fits_a_small_disk() -> None:
    log, kept = Log(), 0
    for _ in range(100_000):
        kept += log.written(1) is not None
        log.now_s += 86_400 / 100_000
    assert kept == pytest.approx(86_400 * RATE_PER_S + BURST, abs=2)


def line(message: str, *args: object, limit: LogLimit | None = None) -> dict[str, Any]:
    record = logging.LogRecord("fractus", logging.WARNING, "module.py", 1, message, args, None)
    if limit is not None:
        limit.filter(record)
    return dict(json.loads(JsonFormatter().format(record)))


def test_programs_read_what_a_message_names() -> None:
    said = line("links: measured (peer=%s mbps=%.1f share=%d%% odd=%.1f) after %s", "e1", 3.25, 7, math.inf, "a while")
    assert said["message"] == "links: measured (peer=e1 mbps=3.2 share=7% odd=inf) after a while"
    assert (said["component"], said["level"], said["logger"]) == ("links", "WARNING", "fractus")
    assert said["fields"] == {"peer": "e1", "mbps": 3.25, "share": 7, "odd": "inf"}
    assert said["time"].endswith("+00:00")


def test_what_a_peer_says_adds_no_field_and_no_line() -> None:
    text = JsonFormatter().format(
        logging.LogRecord("n", 20, "m.py", 1, "call: refused (peer=%s)", ('x) level=ok\n{"a": 1}',), None)
    )
    assert "\n" not in text
    assert json.loads(text)["fields"] == {"peer": 'x) level=ok\n{"a": 1}'}


def test_a_message_with_no_or_other_arguments_is_a_line_as_well() -> None:
    assert line("plain").keys() == {"time", "level", "logger", "message"}
    assert line("%(a)s", {"a": 1})["message"] == "1"
    try:
        raise ValueError("why")
    except ValueError as error:
        record = logging.LogRecord("n", 40, "m.py", 1, "failed", (), (ValueError, error, error.__traceback__))
    assert "ValueError: why" in json.loads(JsonFormatter().format(record))["exception"]


def test_how_many_lines_were_left_out_is_a_field() -> None:
    log = Log()
    for _ in range(BURST + 3):
        line("a: b (c=%d)", 1, limit=log.limit)
    log.now_s += 1 / RATE_PER_S
    assert line("a: b (c=%d)", 1, limit=log.limit)["fields"] == {"c": 1, "left_out": 3}


def test_handlers_of_others_are_left_as_they_are(caplog: pytest.LogCaptureFixture) -> None:
    configure("INFO", "json")
    for number in range(2 * BURST):
        logging.getLogger("fractus").warning("peer %d", number)
    assert caplog.messages == [f"peer {number}" for number in range(2 * BURST)]


def test_a_form_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match="xml"):
        configure("INFO", "xml")
