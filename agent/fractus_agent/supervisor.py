"""Runs the loops of the agent, and repeats steps that depend on the API server."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from fractus_agent.cluster.store import Backoff, KubeError

LOG = logging.getLogger(__name__)

FIRST_RETRY_S, MAX_RETRY_S = 0.5, 15.0


class Supervisor:
    """The loops of the agent. One that fails ends them all, and kubelet starts the agent again: nothing runs half."""

    def __init__(self) -> None:
        self._loops: dict[str, Callable[[], Coroutine[Any, Any, None]]] = {}

    def add(self, name: str, loop: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Add a loop that runs until it is cancelled."""
        self._loops[name] = loop

    async def run(self) -> None:
        """Run all loops.

        Raises:
            ExceptionGroup: one of them failed.
        """
        async with asyncio.TaskGroup() as tasks:
            for name, loop in self._loops.items():
                tasks.create_task(loop(), name=name)


async def repeat(name: str, step: Callable[[], Awaitable[float]], changed: asyncio.Event) -> None:
    """Repeat a step until cancelled: after the delay that it returns, or as soon as something changed.

    While the API server fails, the delay grows instead, and changes wait: a fleet must not storm a server that comes back.

    Args:
        name: of the step, for the log.
        step: does what is due; returns seconds until it is due again.
        changed: set when something changed.
    """
    backoff = Backoff(FIRST_RETRY_S, MAX_RETRY_S)
    while True:
        # Cleared before the step reads anything, so that a change during it is not lost.
        changed.clear()
        try:
            delay_s = await step()
            backoff.succeeded()
        except KubeError as error:
            level = logging.DEBUG if backoff.attempts else logging.WARNING
            LOG.log(level, "%s: the API server failed, trying again: %s", name, error)
            await asyncio.sleep(backoff.delay_s())
            continue
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(changed.wait(), delay_s)
