"""Lock that is granted round-robin, so that many requests of one owner do not delay the requests of others."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fractus_services.errors import ResourceExhausted


class QueueFull(ResourceExhausted):
    """The maximum number of requests of one owner or of all owners is reached."""

    def __init__(self, reason: str) -> None:
        super().__init__("ShutterBusy", reason)


class FairQueue:
    """Serves one request at a time, round-robin over the owners of requests.

    Args:
        max_per_owner: Maximum number of requests of one owner that wait or are being served.
        max_requests: Maximum number of requests of all owners that wait or are being served.
    """

    def __init__(self, max_per_owner: int, max_requests: int) -> None:
        self._max_per_owner = max_per_owner
        self._max_requests = max_requests
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}
        self._count: dict[str, int] = {}
        self._busy = False

    def __len__(self) -> int:
        """Return the number of requests that wait or are being served."""
        return sum(self._count.values())

    @asynccontextmanager
    async def turn(self, owner: str) -> AsyncIterator[None]:
        """Wait for the owner's turn, and hold it within the block.

        Raises:
            QueueFull: Too many requests of this owner, or of all owners, wait or are being served.
        """
        if self._count.get(owner, 0) >= self._max_per_owner:
            raise QueueFull(
                f"{self._max_per_owner} images of this component are in progress; wait for them and try again"
            )
        if len(self) >= self._max_requests:
            raise QueueFull(f"{self._max_requests} images are in progress on this node; try again")
        self._count[owner] = self._count.get(owner, 0) + 1
        try:
            await self._acquire(owner)
            try:
                yield
            finally:
                self._release(owner)
        finally:
            self._count[owner] -= 1
            if not self._count[owner]:
                del self._count[owner]

    async def _acquire(self, owner: str) -> None:
        if not self._busy:
            self._busy = True
            return
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(owner, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            # If the turn was granted just before the cancellation, grant it to the next request. Otherwise the queue would stop.
            if turn.done() and not turn.cancelled():
                self._release(owner)
            raise

    def _release(self, last_owner: str) -> None:
        """Grant the turn to the next owner."""
        if last_owner in self._waiting:
            # Move the last owner to the end of the round. Dictionaries keep the order of insertion.
            self._waiting[last_owner] = self._waiting.pop(last_owner)
        while self._waiting:
            owner = next(iter(self._waiting))
            turns = self._waiting.pop(owner)
            turn = turns.popleft()
            if turns:
                self._waiting[owner] = turns
            if not turn.done():
                turn.set_result(None)
                return
        self._busy = False
