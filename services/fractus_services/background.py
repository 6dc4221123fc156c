"""Background tasks of a service, and long computations that yield to the event loop."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine, Generator
from typing import Any, ParamSpec, TypeVar

from fractus_services.errors import AutopilotError

log = logging.getLogger(__name__)

SLICE_S = 0.004
"""Time for which a computation may block the event loop. Monitor (20 Hz), watchdogs and heartbeats run in between."""

P = ParamSpec("P")
T = TypeVar("T")


async def in_slices(work: Generator[None, None, T]) -> T:
    """Run a long computation in slices of `SLICE_S` seconds, and return its result."""
    while True:
        until = time.perf_counter() + SLICE_S
        while time.perf_counter() < until:
            try:
                next(work)
            except StopIteration as end:
                result: T = end.value
                return result
        await asyncio.sleep(0)


class Background:
    """Background tasks of a service. It keeps references to tasks, because the event loop has only weak references."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run a coroutine in the background. Failures are logged."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    async def complete(self, work: Coroutine[Any, Any, T]) -> T:
        """Return the result of a coroutine that is completed even if the caller is cancelled."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return await asyncio.shield(task)

    def drop(self, task: asyncio.Task[None] | None) -> None:
        """Cancel a task, unless it is the current task."""
        if task is not None and task is not asyncio.current_task():
            task.cancel()

    async def attempt(self, work: Callable[P, Awaitable[None]], *args: P.args, **kwargs: P.kwargs) -> None:
        """Run an autopilot command whose failure is harmless. A failure is logged."""
        try:
            await work(*args, **kwargs)
        except AutopilotError as error:
            log.warning("background: autopilot command failed (error=%s)", error)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            log.error("background: task failed", exc_info=task.exception())
