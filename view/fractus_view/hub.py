"""What is known now, and what changed lately, for any number of pages: their number and speed cost no memory."""

from __future__ import annotations

import asyncio
import secrets
from collections import deque
from collections.abc import AsyncIterator, Iterable, Iterator

from fractus_view.events import (
    LIVE,
    RESET,
    Applications,
    Areas,
    Contact,
    Event,
    Fix,
    Gone,
    Links,
    Note,
    Picture,
    Policies,
    Problem,
    State,
    Verdict,
    encode,
    message,
)

RECENT = 4_000
"""Events that are kept for pages: one that falls behind by more, or comes back later, gets what is known by then."""

TRAIL = 600
"""Positions of a drone's path that a new page gets."""

_KEPT = {Verdict: 300, Note: 200, Picture: 60, Problem: 10}
"""How many of those that happen, rather than hold, a new page gets."""

_BATCH = 500


class Trail:
    """A drone's path in a bounded number of positions: the longer it is, the fewer for each minute."""

    def __init__(self) -> None:
        self._fixes: list[Fix] = []
        self._spacing_ms = 1_000
        self._last: Fix | None = None

    def add(self, fix: Fix) -> None:
        """Take the newest position."""
        if not self._fixes or fix.time_ms - self._fixes[-1].time_ms >= self._spacing_ms:
            self._fixes.append(fix)
        self._last = fix
        if len(self._fixes) >= TRAIL:
            del self._fixes[1::2]
            self._spacing_ms *= 2

    def __iter__(self) -> Iterator[Fix]:
        """Oldest first, the newest always among them."""
        yield from self._fixes
        if self._last is not None and self._last is not self._fixes[-1]:
            yield self._last


class Hub:
    """Takes events from one source, and gives them to pages.

    All pages read the same short memory of events, each from where it is. One that is slower than the source finds its
    place forgotten, and starts over with what is known: nothing is queued for anyone.
    """

    def __init__(self) -> None:
        self._epoch = secrets.token_hex(4)
        self._count = 0
        self._recent: deque[str] = deque(maxlen=RECENT)
        self._trails: dict[str, Trail] = {}
        self._holding: dict[tuple[type, str], Event] = {}
        self._happened: dict[type, deque[Event]] = {kind: deque(maxlen=bound) for kind, bound in _KEPT.items()}
        self._news = asyncio.Event()

    def publish(self, events: Iterable[Event]) -> None:
        """Tell all pages."""
        for event in events:
            self._remember(event)
            self._recent.append(encode(event))
            self._count += 1
        self._news.set()
        self._news = asyncio.Event()

    def _remember(self, event: Event) -> None:
        match event:
            case Fix():
                self._trails.setdefault(event.drone, Trail()).add(event)
            case State():
                self._holding[State, event.drone] = event
            case Areas():
                self._holding[Areas, event.origin] = event
            case Applications() | Links() | Policies() | Contact():
                self._holding[type(event), ""] = event
            case Gone():
                self._trails.pop(event.drone, None)
                self._holding.pop((State, event.drone), None)
            case _:
                self._happened[type(event)].append(event)

    def snapshot(self) -> Iterator[Event]:
        """What a page needs that knows nothing."""
        yield from self._holding.values()
        for trail in self._trails.values():
            yield from trail
        for happened in self._happened.values():
            yield from happened

    async def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Messages of an event stream, for as long as they are read.

        Args:
            last_id: of the last message that the page heard; empty if none.
        """
        place = self._place(last_id)
        if place is not None:
            yield message(self._id(place), [LIVE])
        while True:
            news = self._news
            if place is None or place < self._count - len(self._recent):
                place = self._count
                yield message(self._id(place), [RESET, *map(encode, self.snapshot()), LIVE])
            elif place < self._count:
                first = place - (self._count - len(self._recent))
                batch = [self._recent[i] for i in range(first, min(first + _BATCH, len(self._recent)))]
                place += len(batch)
                yield message(self._id(place), batch)
            else:
                await news.wait()

    def _id(self, place: int) -> str:
        return f"{self._epoch}-{place}"

    def _place(self, last_id: str) -> int | None:
        """Where a page was; None where it knows nothing of this hub."""
        epoch, _, place = last_id.partition("-")
        if epoch != self._epoch or not place.isdecimal() or int(place) > self._count:
            return None
        return int(place)
