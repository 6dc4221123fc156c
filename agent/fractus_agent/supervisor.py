"""Loops of the agent: supervision, retries while the API server is unavailable, and a watchdog of the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from fractus_runtime.backoff import Backoff

from fractus_agent.store import KubeError

log = logging.getLogger(__name__)

_FIRST_RETRY_S = 0.5
_MAX_RETRY_S = 15.0
WATCHDOG_INTERVAL_S = 10.0
WATCHDOG_TIMEOUT_S = 60.0


class Supervisor:
    """Runs the loops of the agent. If a loop fails, all loops end, and kubelet restarts the agent."""

    def __init__(self) -> None:
        self._loops: dict[str, Callable[[], Coroutine[Any, Any, None]]] = {}

    def add(self, name: str, loop: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Add a loop that runs until it is cancelled."""
        self._loops[name] = loop

    async def run(self) -> None:
        """Run all loops.

        Raises:
            ExceptionGroup: A loop failed.
        """
        async with asyncio.TaskGroup() as tasks:
            for name, loop in self._loops.items():
                tasks.create_task(loop(), name=name)


async def repeat(name: str, step: Callable[[], Awaitable[float]], changed: asyncio.Event) -> None:
    """Repeat a step until cancelled, each time after the delay that it returned, or earlier when something changed.

    While the API server fails, the delay grows and changes do not shorten it, so that a fleet does not overload a recovering
    server.

    Args:
        name: Name of the step, for the log.
        step: Does the work that is due. Returns the seconds until more work is due.
        changed: Event that is set when something changed.
    """
    backoff = Backoff(_FIRST_RETRY_S, _MAX_RETRY_S)
    while True:
        # Clear the event before the step reads anything, so that no change is missed.
        changed.clear()
        try:
            delay_s = await step()
            backoff.succeeded()
        except KubeError as error:
            level = logging.DEBUG if backoff.attempts else logging.WARNING
            log.log(level, "%s: API server failed, retrying (error=%s)", name, error)
            await asyncio.sleep(backoff.delay_s())
            continue
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(changed.wait(), delay_s)


async def run_watchdog(interval_s: float = WATCHDOG_INTERVAL_S, timeout_s: float = WATCHDOG_TIMEOUT_S) -> None:
    """Reset a watchdog timer until cancelled, so that kubelet restarts an agent whose event loop hangs.

    If the event loop does not reset the timer for `timeout_s`, the process prints all stacks to stderr and exits with
    status 1.
    """
    try:
        while True:
            faulthandler.dump_traceback_later(timeout_s, exit=True)
            await asyncio.sleep(interval_s)
    finally:
        faulthandler.cancel_dump_traceback_later()
