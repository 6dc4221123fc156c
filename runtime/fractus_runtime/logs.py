"""Log output as text or JSON, with a rate limit for lines that a caller can cause."""

from __future__ import annotations

import json
import logging
import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

FORMATS = ("text", "json")
BURST = 50
"""Number of records per caller that are written without delay."""
RATE_PER_S = 0.5
"""Records per caller and second that are written after the burst."""
MAX_CALLERS = 1_000
"""Number of callers that have separate limits. Further callers share one limit."""


@dataclass(slots=True)
class _Bucket:
    tokens: float
    updated_s: float
    suppressed: int = 0


class CallerLogLimit(logging.Filter):
    """Limits the records of each caller, so that a refused component cannot fill the disk.

    Only records with an attribute `limit_by` (from `extra` of the log call) are limited. Each value of it and each line of code has
    a separate limit. The next record that is written states how many records were suppressed.

    Args:
        monotonic: Monotonic clock in seconds.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._monotonic = monotonic
        self._buckets: dict[tuple[str, int, str], _Bucket] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if the record is to be written."""
        caller = getattr(record, "limit_by", "")
        if not caller:
            return True
        now_s = self._monotonic()
        key = (record.pathname, record.lineno, caller)
        if key not in self._buckets and len(self._buckets) >= MAX_CALLERS:
            key = (record.pathname, record.lineno, "")
        bucket = self._buckets.setdefault(key, _Bucket(BURST, now_s))
        bucket.tokens = min(bucket.tokens + (now_s - bucket.updated_s) * RATE_PER_S, BURST)
        bucket.updated_s = now_s
        if bucket.tokens < 1:
            bucket.suppressed += 1
            return False
        bucket.tokens -= 1
        if bucket.suppressed and record.args and isinstance(record.args, tuple):
            # The number is an argument, so that it becomes a field of the JSON format.
            record.msg = f"{record.msg} (suppressed=%d)"
            record.args = (*record.args, bucket.suppressed)
            bucket.suppressed = 0
        return True


_PLACEHOLDER = re.compile(r"%%|(?:(\w+)=)?%[-#0 +]*\d*(?:\.\d+)?[a-zA-Z]")
_COMPONENT = re.compile(r"([a-z][a-z ]*): ")


class JsonFormatter(logging.Formatter):
    """Formats a record as one line of JSON: time, level, logger, message, and each `name=value` of the message as a field.

    Names are taken from the template and values from the arguments, so that text from a peer cannot add a field.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as JSON."""
        template = record.msg if isinstance(record.msg, str) else ""
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if match := _COMPONENT.match(template):
            entry["component"] = match[1]
        if fields := dict(_fields(template, record.args)):
            entry["fields"] = fields
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry, ensure_ascii=False, default=str)


def _fields(template: str, args: object) -> Iterator[tuple[str, object]]:
    """Yield the arguments that the template names, by name."""
    if not isinstance(args, tuple):
        return
    names = [match[1] for match in _PLACEHOLDER.finditer(template) if match[0] != "%%"]
    for name, value in zip(names, args, strict=False):
        if name is not None:
            yield name, value if isinstance(value, int | str) or _finite(value) else str(value)


def _finite(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def configure(level: str | int, log_format: str = "text") -> None:
    """Write the log to stderr, unless the program has configured logging already.

    Args:
        level: Lowest level that is written.
        log_format: text or json.

    Raises:
        ValueError: Unknown level or format.
    """
    if log_format not in FORMATS:
        raise ValueError(f"unknown log format {log_format!r}; use {' or '.join(FORMATS)}")
    handler = logging.StreamHandler()
    handler.addFilter(CallerLogLimit())
    if log_format == "json":
        handler.setFormatter(JsonFormatter())
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])
    # The kubelet checks the health every few seconds.
    logging.getLogger("aiohttp.access").setLevel(logging.WARNING)
