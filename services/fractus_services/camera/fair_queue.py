"""A lock that is handed from owner to owner in rounds, so that a flood from one does not stall the others."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fractus_services.errors import ResourceExhausted

MAX_PER_OWNER = 4
"""Requests of one component instance that wait or are being served."""


class QueueFull(ResourceExhausted):
    """A caller has as many requests waiting as it may have."""

    def __init__(self, reason: str) -> None:
        super().__init__("ShutterBusy", reason)


class FairQueue:
    """One request at a time, in rounds over the owners of requests.

    Args:
        max_per_owner: requests of one owner that may wait or be served.
        max_requests: requests of all owners that may.
    """

    def __init__(self, max_per_owner: int, max_requests: int) -> None:
        self._max_per_owner = max_per_owner
        self._max_requests = max_requests
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}
        self._count: dict[str, int] = {}
        self._busy = False

    def __len__(self) -> int:
        """Requests that wait or are being served."""
        return sum(self._count.values())

    @asynccontextmanager
    async def turn(self, owner: str) -> AsyncIterator[None]:
        """Wait for a turn and hold it.

        Raises:
            QueueFull: too many of this owner, or of all owners, wait already.
        """
        if self._count.get(owner, 0) >= self._max_per_owner:
            raise QueueFull(
                f"{self._max_per_owner} pictures of this component are under way; wait for them and try again"
            )
        if len(self) >= self._max_requests:
            raise QueueFull(f"{self._max_requests} pictures are under way on this node; try again")
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
            # The turn may have been handed to this request just before it was cancelled: it must not be lost.
            if place.done() and not place.cancelled():
                self._pass_on(owner)
            raise

    def _pass_on(self, last: str) -> None:
        if last in self._waiting:
            # Who just had a turn goes to the end of the round: dictionaries keep the order of insertion.
            self._waiting[last] = self._waiting.pop(last)
        while self._waiting:
            owner = next(iter(self._waiting))
            queue = self._waiting.pop(owner)
            place = queue.popleft()
            if queue:
                self._waiting[owner] = queue
            if not place.done():
                place.set_result(None)
                return
        self._busy = False
