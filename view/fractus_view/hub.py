"""Current state and recent changes for any number of pages. Memory does not depend on their number or speed."""

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
"""Number of stored events. A page that is further behind receives the current state."""

TRAIL = 600
"""Number of positions of a drone's path for a new page."""

_KEPT = {Verdict: 300, Note: 200, Picture: 60, Problem: 10}
"""Number of past verdicts, notes and pictures for a new page."""

_BATCH = 500


class Trail:
    """Path of a drone with a bounded number of positions: a longer path has fewer positions per minute."""

    def __init__(self) -> None:
        self._fixes: list[Fix] = []
        self._spacing_ms = 1_000
        self._last: Fix | None = None

    def add(self, fix: Fix) -> None:
        """Append a position."""
        if not self._fixes or fix.time_ms - self._fixes[-1].time_ms >= self._spacing_ms:
            self._fixes.append(fix)
        self._last = fix
        if len(self._fixes) >= TRAIL:
            del self._fixes[1::2]
            self._spacing_ms *= 2

    def __iter__(self) -> Iterator[Fix]:
        """Return the positions, oldest first, always including the newest."""
        yield from self._fixes
        if self._last is not None and self._last is not self._fixes[-1]:
            yield self._last


class Hub:
    """Distributes events of one source to pages.

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
        """Publish events to all pages."""
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
        """Return the events for a new page."""
        yield from self._holding.values()
        for trail in self._trails.values():
            yield from trail
        for happened in self._happened.values():
            yield from happened

    async def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Yield messages of the event stream while the client reads them.

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
        """Return the position of a page in the event stream; None if it has none in this hub."""
        epoch, _, place = last_id.partition("-")
        if epoch != self._epoch or not place.isdecimal() or int(place) > self._count:
            return None
        return int(place)
