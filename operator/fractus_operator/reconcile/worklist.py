"""A queue of keys to reconcile: each key once, one at a time; a failed one is tried again later."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.store import Backoff, KubeError
from fractus_operator.metrics import reconciling

logger = logging.getLogger(__name__)

_BACKOFF_S = (1.0, 60.0)


async def regularly(name: str, step: Callable[[], Awaitable[None]], period_s: float) -> None:
    """Repeat a step until cancelled; one that fails is made again later, with growing pauses.

    Args:
        name: Of the step, for the log.
        step: Looks at everything, and changes what is not as it should be.
        period_s: From the end of one to the next.
    """
    backoff = Backoff(period_s, _BACKOFF_S[1])
    while True:
        pause_s = period_s
        try:
            with reconciling(name):
                await step()
            backoff.succeeded()
        except Exception as error:
            pause_s = backoff.delay_s()
            expected = isinstance(error, KubeError)
            logger.log(
                logging.INFO if expected else logging.WARNING,
                "%s: step failed (retry_s=%.1f): %s",
                name,
                pause_s,
                error if expected else repr(error),
                exc_info=None if expected else error,
            )
        await asyncio.sleep(pause_s)


@contextmanager
def one_of_many(name: str, node: str) -> Iterator[None]:
    """One node's part of a step: what the API server refuses for one node keeps no other from its turn.

    Args:
        name: Of the step, for the log.
        node: Of the drone or edge node.

    Raises:
        KubeError: the API server gave no answer, so that it gives none for the others.
    """
    try:
        yield
    except (KubeError, ValueError) as error:
        if isinstance(error, KubeError) and not error.status:
            raise
        logger.warning("%s: failed for one node (node=%s): %s", name, node, error)


class Worklist:
    """Calls `reconcile(key)` for each key that was added since it was last reconciled.

    A failing key is tried again with growing, jittered pauses, up to a minute apart: what is
    reconciled is a level, so a later try can only find a newer one.

    Args:
        name: What the keys are of, for the log.
        reconcile: Brings one key to its desired state.
        after: What is waited for before each.
        at_once: How many keys are reconciled at a time; of one key never two.
    """

    def __init__(
        self,
        name: str,
        reconcile: Callable[[Key], Awaitable[None]],
        *,
        after: Callable[[], Awaitable[None]] | None = None,
        at_once: int = 1,
    ) -> None:
        self.name = name
        self.failures: dict[Key, Backoff] = {}
        self._reconcile = reconcile
        self._after = after
        self._at_once = at_once
        self._under_way: set[Key] = set()
        self._waiting: dict[Key, None] = {}
        self._added = asyncio.Event()
        self._later: dict[Key, asyncio.TimerHandle] = {}

    def add(self, key: Key) -> None:
        """Reconcile the key soon."""
        handle = self._later.pop(key, None)
        if handle is not None:
            handle.cancel()
        self._waiting[key] = None
        self._added.set()

    async def run(self) -> None:
        """Reconcile until cancelled."""
        async with asyncio.TaskGroup() as group:
            for _ in range(self._at_once):
                group.create_task(self._work())

    async def _work(self) -> None:
        while True:
            await self._added.wait()
            key = next((key for key in self._waiting if key not in self._under_way), None)
            if key is None:
                self._added.clear()
                continue
            del self._waiting[key]
            self._under_way.add(key)
            try:
                await self._attempt(key)
            finally:
                self._under_way.discard(key)
                if key in self._waiting:
                    self._added.set()

    async def _attempt(self, key: Key) -> None:
        try:
            if self._after is not None:
                await self._after()
            with reconciling(self.name):
                await self._reconcile(key)
        except Exception as error:
            backoff = self.failures.setdefault(key, Backoff(*_BACKOFF_S))
            pause_s = backoff.delay_s()
            expected = isinstance(error, KubeError)
            logger.log(
                logging.INFO if expected and backoff.attempts <= 2 else logging.WARNING,
                "worklist: reconcile failed (kind=%s name=%s retry_s=%.1f): %s",
                self.name,
                "/".join(filter(None, key)),
                pause_s,
                error if expected else repr(error),
                exc_info=None if expected else error,
            )
            if key not in self._waiting:
                self._later[key] = asyncio.get_running_loop().call_later(pause_s, self.add, key)
        else:
            self.failures.pop(key, None)
