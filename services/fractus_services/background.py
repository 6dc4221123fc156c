"""Tasks beside the calls: kept until they end, failures logged, and long computations cut into slices."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine, Generator
from typing import Any, ParamSpec, TypeVar

from fractus_services.errors import AutopilotError

log = logging.getLogger(__name__)

SLICE_S = 0.004
"""How long a computation may hold the event loop: monitor (20 Hz), watchdogs and heartbeats run in between."""

P = ParamSpec("P")
T = TypeVar("T")


async def in_slices(work: Generator[None, None, T]) -> T:
    """The outcome of a long computation, done in slices between everything else."""
    while True:
        until = time.perf_counter() + SLICE_S
        while time.perf_counter() < until:
            try:
                next(work)
            except StopIteration as end:
                outcome: T = end.value
                return outcome
        await asyncio.sleep(0)


class Background:
    """Tasks of one service, which keeps a reference to each: the event loop itself holds them only weakly."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run something in the background; failures are logged."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    async def complete(self, work: Coroutine[Any, Any, T]) -> T:
        """The result of work that is completed also when its caller hangs up and is cancelled."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return await asyncio.shield(task)

    def drop(self, task: asyncio.Task[None] | None) -> None:
        """Cancel a task, unless it is the one that asks."""
        if task is not None and task is not asyncio.current_task():
            task.cancel()

    async def attempt(self, work: Callable[P, Awaitable[None]], *args: P.args, **kwargs: P.kwargs) -> None:
        """Do something with the autopilot whose failure is harmless: it is logged."""
        try:
            await work(*args, **kwargs)
        except AutopilotError as error:
            log.warning("background: the autopilot did not follow (error=%s)", error)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            log.error("background: a task failed", exc_info=task.exception())
