"""Current state and recent events for any number of pages. Memory does not depend on the number or speed of the pages."""

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
    PictureSource,
    Policies,
    Problem,
    Records,
    State,
    Verdict,
    encode,
    stream_message,
)

RECENT = 4_000
"""Number of stored events. A page that is further behind receives the current state."""

TRAIL = 600
"""Maximum number of positions of a drone's path that a new page receives."""

_HISTORY_SIZES = {Verdict: 300, Note: 200, Picture: 60, Problem: 10}
"""Number of past events by type that a new page receives."""

_BATCH = 500


class Trail:
    """Path of a drone with a bounded number of positions. A longer path has fewer positions per minute."""

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
        """Yield the positions, oldest first. The newest position is always included."""
        yield from self._fixes
        if self._last is not None and self._last is not self._fixes[-1]:
            yield self._last


class Hub:
    """Distributes events of one source to pages.

    All pages read the same buffer of recent events, each from its own position. There is no queue per page. If a page is so
    slow that its next event is no longer buffered, it receives the current state.
    """

    def __init__(self) -> None:
        self._epoch = secrets.token_hex(4)
        self._count = 0
        self._recent: deque[str] = deque(maxlen=RECENT)
        self._trails: dict[str, Trail] = {}
        self._current: dict[tuple[type, str], Event] = {}
        self._history: dict[type, deque[Event]] = {kind: deque(maxlen=size) for kind, size in _HISTORY_SIZES.items()}
        self._published = asyncio.Event()

    def publish(self, events: Iterable[Event]) -> None:
        """Publish events to all pages."""
        for event in events:
            self._store(event)
            self._recent.append(encode(event))
            self._count += 1
        self._published.set()
        self._published = asyncio.Event()

    def _store(self, event: Event) -> None:
        match event:
            case Fix():
                self._trails.setdefault(event.drone, Trail()).add(event)
            case State():
                self._current[State, event.drone] = event
            case Areas():
                self._current[Areas, event.origin] = event
            case Applications() | Links() | Policies() | Contact() | Records() | PictureSource():
                self._current[type(event), ""] = event
            case Gone():
                self._trails.pop(event.drone, None)
                self._current.pop((State, event.drone), None)
            case _:
                self._history[type(event)].append(event)

    def snapshot(self) -> Iterator[Event]:
        """Yield the events for a new page."""
        yield from self._current.values()
        for trail in self._trails.values():
            yield from trail
        for events in self._history.values():
            yield from events

    async def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Yield messages of the event stream while the client reads them.

        Args:
            last_id: Id of the last message that the page received, or an empty string.
        """
        position = self._position(last_id)
        if position is not None:
            yield stream_message(self._id(position), [LIVE])
        while True:
            published = self._published
            if position is None or position < self._count - len(self._recent):
                position = self._count
                yield stream_message(self._id(position), [RESET, *map(encode, self.snapshot()), LIVE])
            elif position < self._count:
                first = position - (self._count - len(self._recent))
                batch = [self._recent[i] for i in range(first, min(first + _BATCH, len(self._recent)))]
                position += len(batch)
                yield stream_message(self._id(position), batch)
            else:
                await published.wait()

    def _id(self, position: int) -> str:
        return f"{self._epoch}-{position}"

    def _position(self, last_id: str) -> int | None:
        """Return the number of events that a page has received, or None if the id is not from this hub."""
        epoch, _, position = last_id.partition("-")
        if epoch != self._epoch or not position.isdecimal() or int(position) > self._count:
            return None
        return int(position)
