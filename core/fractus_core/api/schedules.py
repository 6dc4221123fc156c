"""Validity of policies and activity of zones: time windows, weekdays and times of day, in UTC."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Annotated, Literal, get_args

from pydantic import Field

from fractus_core.api.formats import CLOCK_TIME
from fractus_core.api.model import Model, Timestamp
from fractus_core.api.rules import Violation, rule

Day = Literal["Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun"]
ClockTime = Annotated[str, Field(pattern=CLOCK_TIME, max_length=5)]

_DAYS: tuple[Day, ...] = get_args(Day)
_DAY_S = 86_400.0
_WEEK_S = 7 * _DAY_S
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
        return self.active_until(time_s) is not None

    def active_until(self, time_s: float) -> float | None:
        """Return the end of the active time that contains a time, or None if no active time contains it.

        All times are in seconds since 1970 UTC. The end is exclusive, and infinite if the zone stays active.
        """
        begin_s, end_s = self.window_s
        if not begin_s <= time_s < end_s:
            return None
        if not self.days and self._opens_and_closes_s == (0.0, _DAY_S):
            return end_s
        closing = [close_s for open_s, close_s in self._daily(time_s, time_s) if open_s <= time_s < close_s]
        return min(max(closing), end_s) if closing else None

    def active_between(self, first_s: float, last_s: float) -> bool:
        """Return True if any time from `first_s` to `last_s`, both inclusive, is in the active time."""
        begin_s, end_s = self.window_s
        first_s = max(first_s, begin_s)
        last_s = min(last_s, end_s)
        if first_s > last_s or first_s >= end_s:
            return False
        if last_s - first_s >= _WEEK_S:
            return True
        return any(
            open_s <= last_s and open_s < end_s and first_s < close_s
            for open_s, close_s in self._daily(first_s, last_s)
        )

    @property
    def _opens_and_closes_s(self) -> tuple[float, float]:
        """Start and end in seconds since midnight. The end is on the next day if it is not later than the start."""
        start_s = _clock_s(self.start or "00:00")
        end_s = _clock_s(self.end or "00:00")
        return start_s, end_s if end_s > start_s else end_s + _DAY_S

    def _daily(self, first_s: float, last_s: float) -> Iterator[tuple[float, float]]:
        """Yield start and end of the active time of each day that may overlap a span, without regard to the window."""
        opens_s, closes_s = self._opens_and_closes_s
        # An active time that started on the day before may last until the first day.
        for day in range(int(first_s // _DAY_S) - 1, int(last_s // _DAY_S) + 1):
            if not self.days or _DAYS[(day + _THURSDAY) % 7] in self.days:
                yield day * _DAY_S + opens_s, day * _DAY_S + closes_s


MAX_PERIODS = 64
"""Number of successive active times up to which `active_throughout` follows a schedule. A longer sequence counts as
interrupted."""


def active_at(schedule: Sequence[ActiveTime], time_s: float) -> bool:
    """Return True if a schedule is active at a time, in seconds since 1970 UTC. An empty schedule is always active."""
    return active_between(schedule, time_s, time_s)


def active_between(schedule: Sequence[ActiveTime], first_s: float, last_s: float) -> bool:
    """Return True if a schedule is active at any time from `first_s` to `last_s`, both inclusive."""
    return not schedule or any(time.active_between(first_s, last_s) for time in schedule)


def active_throughout(schedule: Sequence[ActiveTime], first_s: float, last_s: float) -> bool:
    """Return True if a schedule is active at all times from `first_s` to `last_s`, both inclusive."""
    if not schedule:
        return True
    reached_s = first_s
    for _ in range(MAX_PERIODS):
        ends_s = [end_s for time in schedule if (end_s := time.active_until(reached_s)) is not None]
        if not ends_s:
            return False
        reached_s = max(ends_s)
        if reached_s > last_s:
            return True
    return False


def _clock_s(text: str) -> float:
    hours, minutes = text.split(":")
    return int(hours) * 3600.0 + int(minutes) * 60.0


def _unix(moment: datetime) -> float:
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
