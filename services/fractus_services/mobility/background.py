"""Work that goes on beside the calls: kept until it ends, and its failures told."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from typing import Any

from fractus_services.mobility.autopilot import AutopilotError

log = logging.getLogger(__name__)


class Background:
    """Tasks of the drone's control."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[None]] = set()

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run something in the background; failures are logged."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    def keep(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run something that its caller waits for, and that goes on when the caller does not."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def drop(self, task: asyncio.Task[None] | None) -> None:
        """Cancel a task, unless it is the one that asks."""
        if task is not None and task is not asyncio.current_task():
            task.cancel()

    async def attempt(self, work: Coroutine[Any, Any, None]) -> None:
        """Await something of the autopilot that may fail without harm."""
        try:
            await work
        except AutopilotError as error:
            log.warning("%s", error)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            log.error("a task of the drone's control failed", exc_info=task.exception())
