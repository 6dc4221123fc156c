"""Who comes next: one at a time, in rounds over the callers, so that the flood of one does not stall the others."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager


class QueueFull(Exception):
    """A caller has as many requests waiting as it may have."""


class FairQueue:
    """A lock that is handed from caller to caller in rounds.

    Args:
        most: requests of one caller that may wait or be under way.
        most_waiting: requests of all callers that may.
    """

    def __init__(self, most: int, most_waiting: int) -> None:
        self._most = most
        self._most_waiting = most_waiting
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}
        self._count: dict[str, int] = {}
        self._busy = False

    @property
    def busy(self) -> bool:
        """Whether somebody has the turn."""
        return self._busy

    def __len__(self) -> int:
        """Requests that wait or are under way."""
        return sum(self._count.values())

    @asynccontextmanager
    async def turn(self, owner: str) -> AsyncIterator[None]:
        """Wait for a turn and hold it.

        Raises:
            QueueFull: too many of this caller, or of all callers, wait already.
        """
        if self._count.get(owner, 0) >= self._most:
            raise QueueFull(f"{self._most} pictures of this component are under way; wait for them and try again")
        if len(self) >= self._most_waiting:
            raise QueueFull(f"{self._most_waiting} pictures are under way on this node; try again")
        self._count[owner] = self._count.get(owner, 0) + 1
        try:
            await self._take(owner)
            try:
                yield
            finally:
                self._pass_on(owner)
        finally:
            self._count[owner] -= 1
            if not self._count[owner]:
                del self._count[owner]

    async def _take(self, owner: str) -> None:
        if not self._busy:
            self._busy = True
            return
        place: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(owner, deque()).append(place)
        try:
            await place
        except asyncio.CancelledError:
            if place.done() and not place.cancelled():
                self._pass_on(owner)
            raise

    def _pass_on(self, last: str) -> None:
        if last in self._waiting:
            self._waiting[last] = self._waiting.pop(last)
        while self._waiting:
            owner = next(iter(self._waiting))
            queue = self._waiting.pop(owner)
            place = queue.popleft()
            if queue:
                self._waiting[owner] = queue  # back to the end of the round
            if not place.done():
                place.set_result(None)
                return
        self._busy = False
