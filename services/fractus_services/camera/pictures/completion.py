"""Work that is completed even when its caller hangs up."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from typing import Any, TypeVar

log = logging.getLogger(__name__)

_T = TypeVar("_T")


class Completion:
    """Keeps work running until it ends: a caller that hangs up does not free the camera before the picture is done."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    async def complete(self, work: Coroutine[Any, Any, _T]) -> _T:
        """The result of the work, which goes on when the caller is cancelled."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return await asyncio.shield(task)

    def _ended(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        # Reading the exception also tells asyncio that it was not lost, when the caller is gone.
        if not task.cancelled() and task.exception() is not None:
            log.debug("camera: no picture: %s", task.exception())
