"""Log formats, and the rate limit of log lines that callers cause."""

from __future__ import annotations

import json
import logging
import math
from typing import Any

import pytest
from fractus_runtime.logs import BURST, MAX_CALLERS, RATE_PER_S, CallerLogLimit, JsonFormatter, configure


class LimitedLog:
    """Log filter with a rate limit and a clock set by the test."""

    def __init__(self) -> None:
        self.now_s = 10.0
        self.limit = CallerLogLimit(lambda: self.now_s)

    def write(self, caller: str, line: int = 1) -> str | None:
        """Log a record of a caller. Return its message, or None if the limit suppresses the record."""
        record = logging.LogRecord("n", logging.ERROR, "module.py", line, "refused (caller=%s)", (caller,), None)
        if caller:
            record.limit_by = caller
        return record.getMessage() if self.limit.filter(record) else None


def test_log_limit_suppresses_records_of_a_caller_after_a_burst() -> None:
    log = LimitedLog()
    assert [log.write("a") for _ in range(BURST)] == ["refused (caller=a)"] * BURST
    assert [log.write("a") for _ in range(1000)] == [None] * 1000
    log.now_s += 1 / RATE_PER_S
    assert log.write("a") == "refused (caller=a) (suppressed=1000)"
    assert log.write("a") is None
    log.now_s += 1e6
    assert log.write("a") == "refused (caller=a) (suppressed=1)"
    assert len([text for text in (log.write("a") for _ in range(2 * BURST)) if text]) == BURST - 1


def test_log_limit_is_separate_for_each_caller_and_line() -> None:
    log = LimitedLog()
    assert [log.write("a") for _ in range(BURST + 7)][BURST:] == [None] * 7
    assert log.write("b") == "refused (caller=b)"
    assert log.write("a", line=2) == "refused (caller=a)"


def test_log_limit_does_not_apply_to_records_without_a_caller() -> None:
    log = LimitedLog()
    assert None not in [log.write("") for _ in range(10 * BURST)]


def test_log_limit_uses_bounded_memory_for_many_callers() -> None:
    log = LimitedLog()
    written = [log.write(f"caller-{number}") for number in range(10 * MAX_CALLERS)]
    assert MAX_CALLERS <= len([text for text in written if text]) <= MAX_CALLERS + BURST


def test_log_limit_bounds_the_records_of_a_day() -> None:
    log = LimitedLog()
    written = 0
    for _ in range(100_000):
        written += log.write("a") is not None
        log.now_s += 86_400 / 100_000
    assert written == pytest.approx(86_400 * RATE_PER_S + BURST, abs=2)


def test_log_limit_keeps_records_without_arguments_unchanged() -> None:
    limit = CallerLogLimit(lambda: now_s)
    messages = []
    for number in range(BURST + 2):
        now_s = 10.0 + (number > BURST) * 1e6
        record = logging.LogRecord("n", logging.ERROR, "module.py", 1, "disk 100% full", (), None)
        record.limit_by = "a"
        messages.append(record.getMessage() if limit.filter(record) else None)
    assert messages[-2:] == [None, "disk 100% full"]


def formatted(message: str, *args: object) -> dict[str, Any]:
    record = logging.LogRecord("fractus", logging.WARNING, "module.py", 1, message, args, None)
    return dict(json.loads(JsonFormatter().format(record)))


def test_json_log_has_the_values_of_a_message_as_fields() -> None:
    entry = formatted(
        "links: measured (peer=%s mbps=%.1f share=%d%% odd=%.1f) after %s", "e1", 3.25, 7, math.inf, "a while"
    )
    assert entry["message"] == "links: measured (peer=e1 mbps=3.2 share=7% odd=inf) after a while"
    assert (entry["component"], entry["level"], entry["logger"]) == ("links", "WARNING", "fractus")
    assert entry["fields"] == {"peer": "e1", "mbps": 3.25, "share": 7, "odd": "inf"}
    assert entry["time"].endswith("+00:00")


def test_text_from_a_peer_adds_no_json_fields() -> None:
    text = JsonFormatter().format(
        logging.LogRecord("n", 20, "m.py", 1, "call: refused (peer=%s)", ('x) level=ok\n{"a": 1}',), None)
    )
    assert "\n" not in text
    assert json.loads(text)["fields"] == {"peer": 'x) level=ok\n{"a": 1}'}


def test_json_log_formats_messages_without_named_values() -> None:
    assert formatted("plain").keys() == {"time", "level", "logger", "message"}
    assert formatted("%(a)s", {"a": 1})["message"] == "1"
    try:
        raise ValueError("reason")
    except ValueError as error:
        record = logging.LogRecord("n", 40, "m.py", 1, "failed", (), (ValueError, error, error.__traceback__))
    assert "ValueError: reason" in json.loads(JsonFormatter().format(record))["exception"]


def test_configure_keeps_existing_handlers(caplog: pytest.LogCaptureFixture) -> None:
    configure("INFO", "json")
    for number in range(2 * BURST):
        logging.getLogger("fractus").warning("peer %d", number)
    assert caplog.messages == [f"peer {number}" for number in range(2 * BURST)]


def test_configure_rejects_an_unknown_format() -> None:
    with pytest.raises(ValueError, match="xml"):
        configure("INFO", "xml")
