"""Logs for people or programs, that no one can fill the disk with: what a peer, a camera or an autopilot can make us say is limited."""

from __future__ import annotations

import json
import logging
import math
import re
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Any

FORMS = ("text", "json")
BURST = 50
"""Records of one line of the program that are written one after the other."""
RATE_PER_S = 0.5
"""Records of one line of the program that are written from then on."""
MAX_LIMITS = 1_000
"""Limits that are kept; what would need one more shares that of its line of the program."""


class LogLimit(logging.Filter):
    """Limits the records of each line of the program; the next one that is written tells how many were left out.

    A record with an attribute `limit_by` (`extra` of the call that logs it) is limited together with those of the same value only.

    Args:
        monotonic: seconds that never jump.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._monotonic = monotonic
        self._lines: dict[tuple[str, int, str], list[float]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write a record."""
        now_s = self._monotonic()
        # Left, since when, left out; by the line of code, of which there are not many, whatever the text.
        key = (record.pathname, record.lineno, getattr(record, "limit_by", ""))
        if key not in self._lines and len(self._lines) >= MAX_LIMITS:
            key = (record.pathname, record.lineno, "")
        line = self._lines.setdefault(key, [BURST, now_s, 0])
        line[:2] = min(line[0] + (now_s - line[1]) * RATE_PER_S, BURST), now_s
        if line[0] < 1:
            line[2] += 1
            return False
        line[0] -= 1
        if line[2]:
            # The number is an argument like others, so that programs find it as a field. Without arguments the text is no
            # template, and a mapping takes no further ones.
            template = isinstance(record.args, tuple) and bool(record.args)
            text = str(record.msg) if template else record.getMessage().replace("%", "%%")
            args = record.args if template and isinstance(record.args, tuple) else ()
            record.msg, record.args = f"{text} (left_out=%d)", (*args, int(line[2]))
            line[2] = 0
        return True


_PLACEHOLDER = re.compile(r"%%|(?:(\w+)=)?%[-#0 +]*\d*(?:\.\d+)?[a-zA-Z]")
_COMPONENT = re.compile(r"([a-z][a-z ]*): ")


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, logger, message, and what the message says as `name=value` as fields of their own.

    The names are those of the program's text, the values those that it was given: nothing that a peer says can add a field.
    """

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record."""
        template = record.msg if isinstance(record.msg, str) else ""
        said: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if found := _COMPONENT.match(template):
            said["component"] = found[1]
        if fields := dict(_fields(template, record.args)):
            said["fields"] = fields
        if record.exc_info:
            said["exception"] = self.formatException(record.exc_info)
        return json.dumps(said, ensure_ascii=False, default=str)


def _fields(template: str, args: object) -> Iterator[tuple[str, object]]:
    """The arguments that a template names."""
    if not isinstance(args, tuple):
        return
    names = [found[1] for found in _PLACEHOLDER.finditer(template) if found[0] != "%%"]
    for name, value in zip(names, args, strict=False):
        if name is not None:
            yield name, value if isinstance(value, int | str) or _finite(value) else str(value)


def _finite(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def configure(level: str | int, form: str = "text") -> None:
    """Write the log to stderr, within the limit, unless the program that this is a part of writes its log already.

    Args:
        level: from which on records are written.
        form: text or json.

    Raises:
        ValueError: the level or the form is none.
    """
    if form not in FORMS:
        raise ValueError(f"{form!r} is no form of logs: use {' or '.join(FORMS)}")
    handler = logging.StreamHandler()
    handler.addFilter(LogLimit())
    if form == "json":
        handler.setFormatter(JsonFormatter())
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])
    # Health checks of the kubelet, every few seconds.
    logging.getLogger("aiohttp.access").setLevel(logging.WARNING)
