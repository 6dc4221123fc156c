"""Those that wait for messages of the vehicle of some kinds."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from fractus_runtime.mavlink_codec import Message


class Listeners:
    """Queues of messages, each for as long as someone listens.

    Args:
        sysid: the system that listens. What the vehicle answers to other stations on the same link is not for it: their command may
            have been accepted where ours was lost.
    """

    def __init__(self, sysid: int) -> None:
        self._sysid = sysid
        self._open: list[tuple[frozenset[str], asyncio.Queue[Message]]] = []

    def take(self, message: Message) -> None:
        """Hand a message to those that listen for its kind."""
        if message.has("target_system") and message.integer("target_system") not in {0, self._sysid}:
            return
        for kinds, queue in self._open:
            if message.name in kinds:
                queue.put_nowait(message)

    @contextmanager
    def listening(self, *kinds: str) -> Iterator[asyncio.Queue[Message]]:
        """The messages of some kinds, from now until the block ends."""
        listener = frozenset(kinds), asyncio.Queue[Message]()
        self._open.append(listener)
        try:
            yield listener[1]
        finally:
            self._open.remove(listener)
