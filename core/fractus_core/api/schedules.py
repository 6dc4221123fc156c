"""Validity of policies and activity of zones: time windows, weekdays and times of day, in UTC."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, Literal, get_args

from pydantic import Field

from fractus_core.api.model import Model, Timestamp
from fractus_core.api.rules import Violation, rule

Day = Literal["Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun"]
ClockTime = Annotated[str, Field(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$", max_length=5)]

_DAYS: tuple[Day, ...] = get_args(Day)
_DAY_S = 86_400.0
_THURSDAY = 3
"""Index in `_DAYS` of 1970-01-01, a Thursday."""


class Validity(Model):
    """A time window. A missing start or end leaves the window open on that side."""

    valid_from: Timestamp | None = Field(default=None, description="Start of the validity (RFC 3339); unset: no start.")
    valid_until: Timestamp | None = Field(default=None, description="End of the validity (RFC 3339); unset: no end.")

    @rule(
        # The schema also permits lists. The comparison with a timestamp rejects lists.
        "[has(self.validFrom) ? self.validFrom : timestamp(0), has(self.validUntil) ? self.validUntil : timestamp(0)]"
        ".all(t, t >= timestamp(0))",
        "validFrom and validUntil must be RFC 3339 times after 1970",
    )
    def _times(self) -> Violation:
        begin_s, end_s = self.window_s
        if -math.inf < begin_s < 0:
            return "validFrom"
        return "validUntil" if end_s < 0 else None

    @rule(
        "!has(self.validFrom) || !has(self.validUntil) || self.validFrom < self.validUntil",
        "validUntil must be after validFrom",
    )
    def _ordered(self) -> Violation:
        return "validUntil" if self.window_s[0] >= self.window_s[1] else None

    @property
    def window_s(self) -> tuple[float, float]:
        """Start (inclusive) and end (exclusive) in seconds since 1970 UTC, infinite if unset."""
        begin = -math.inf if self.valid_from is None else _unix(self.valid_from)
        return begin, math.inf if self.valid_until is None else _unix(self.valid_until)


class ActiveTime(Validity):
    """A time at which a zone is active. All fields must match. Times are UTC, as in ED-269."""

    days: tuple[Day, ...] = Field(default=(), max_length=7, description="Weekdays in UTC; default: every day.")
    start: ClockTime | None = Field(default=None, description="Start as HH:MM in UTC; default: midnight.")
    end: ClockTime | None = Field(
        default=None,
        description="End as HH:MM in UTC, on the next day if not later than start; default: midnight.",
    )

    @rule("has(self.start) == has(self.end)", "give start and end together, or neither")
    def _start_and_end(self) -> Violation:
        return "start" if (self.start is None) != (self.end is None) else None

    def active(self, time_s: float) -> bool:
        """Return True if a time, in seconds since 1970 UTC, is in the active time."""
        begin_s, end_s = self.window_s
        if not begin_s <= time_s < end_s:
            return False
        start = _clock_s(self.start or "00:00")
        end = _clock_s(self.end or "00:00")
        length = end - start if end > start else _DAY_S + end - start
        today = time_s // _DAY_S
        # An active time that started yesterday may last until today.
        for day in (today, today - 1):
            weekday = _DAYS[int(day + _THURSDAY) % 7]
            if 0 <= time_s - day * _DAY_S - start < length and (not self.days or weekday in self.days):
                return True
        return False


def active_at(schedule: Sequence[ActiveTime], time_s: float) -> bool:
    """Return True if a schedule is active at a time, in seconds since 1970 UTC. An empty schedule is always active."""
    return not schedule or any(time.active(time_s) for time in schedule)


def _clock_s(text: str) -> float:
    hours, minutes = text.split(":")
    return int(hours) * 3600.0 + int(minutes) * 60.0


def _unix(moment: datetime) -> float:
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
