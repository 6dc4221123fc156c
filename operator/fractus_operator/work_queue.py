"""Start of reconciliations: periodic steps, queues of keys, and subscriptions of Applications to their inputs."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress

from fractus_runtime.backoff import Backoff

from fractus_operator.kinds import Key
from fractus_operator.labels import label_key
from fractus_operator.operator_metrics import reconciling
from fractus_operator.store import KubeError

log = logging.getLogger(__name__)

_FIRST_RETRY_S = 1.0
_MAX_RETRY_S = 60.0
_MAX_PAUSE_S = 0.1
"""Maximum pause after a key that can wait. An attempt whose write takes long needs less processor time than its duration."""


async def run_periodically(name: str, step: Callable[[], Awaitable[None]], period_s: float) -> None:
    """Repeat a step until cancelled. After a failure the pause grows.

    Args:
        name: Name of the step in the log.
        step: Reads the complete state and corrects it.
        period_s: Pause between the end of a step and the next one, in seconds.
    """
    backoff = Backoff(period_s, _MAX_RETRY_S)
    while True:
        pause_s = period_s
        try:
            with reconciling(name):
                await step()
            backoff.succeeded()
        except Exception as error:
            pause_s = backoff.delay_s()
            if isinstance(error, KubeError):
                log.info("%s: step failed (retry_s=%.1f error=%s)", name, pause_s, error)
            else:
                log.warning("%s: step failed (retry_s=%.1f error=%r)", name, pause_s, error, exc_info=True)
        await asyncio.sleep(pause_s)


@contextmanager
def skip_failed_node(name: str, node: str) -> Iterator[None]:
    """Log an error that occurs for one node, so that the step continues with the next node.

    Args:
        name: Name of the step in the log.
        node: Name of the drone or edge node.

    Raises:
        KubeError: The API server did not respond. The step ends, because requests for other nodes would fail too.
    """
    try:
        yield
    except (KubeError, ValueError) as error:
        if isinstance(error, KubeError) and not error.status:
            raise
        log.warning("%s: step failed for a node (node=%s error=%s)", name, node, error)


class WorkQueue:
    """A queue that calls `reconcile(key)` for each added key, never twice at the same time for one key.

    A failed key is retried after a growing pause with jitter. Reconciliation is level-triggered, so a later attempt
    uses the latest state.

    Keys that can wait are reconciled while no other key waits, and take at most half of the time of their worker. Thousands of
    them therefore neither delay other keys nor block the event loop.

    Args:
        name: Kind of the keys, in the log.
        reconcile: Brings one key to its desired state.
        after: Awaited before each call of `reconcile`.
        workers: Number of keys that are reconciled at the same time.

    Attributes:
        failures: The back-off of each key whose last attempt failed.
    """

    def __init__(
        self,
        name: str,
        reconcile: Callable[[Key], Awaitable[None]],
        *,
        after: Callable[[], Awaitable[None]] | None = None,
        workers: int = 1,
    ) -> None:
        self.name = name
        self.failures: dict[Key, Backoff] = {}
        self._reconcile = reconcile
        self._after = after
        self._workers = workers
        self._in_progress: set[Key] = set()
        self._waiting: dict[Key, None] = {}
        self._can_wait: dict[Key, None] = {}
        self._added = asyncio.Event()
        self._retries: dict[Key, asyncio.TimerHandle] = {}

    def add(self, key: Key, *, can_wait: bool = False) -> None:
        """Queue the key for reconciliation.

        Args:
            key: The key.
            can_wait: True if all other keys come first.
        """
        handle = self._retries.pop(key, None)
        if handle is not None:
            handle.cancel()
        if not can_wait:
            self._can_wait.pop(key, None)
            self._waiting[key] = None
        elif key not in self._waiting:
            self._can_wait[key] = None
        self._added.set()

    async def run(self) -> None:
        """Reconcile until cancelled."""
        async with asyncio.TaskGroup() as group:
            for _ in range(self._workers):
                group.create_task(self._work())

    async def _work(self) -> None:
        while True:
            await self._added.wait()
            found = self._next()
            if found is None:
                self._added.clear()
                continue
            queue, key = found
            del queue[key]
            self._in_progress.add(key)
            begin_s = time.monotonic()
            try:
                await self._attempt(key)
            finally:
                self._in_progress.discard(key)
                if self._queued(key):
                    self._added.set()
            # An attempt without a write never waits, so the event loop needs this pause.
            pause_s = min(time.monotonic() - begin_s, _MAX_PAUSE_S) if queue is self._can_wait else 0
            await asyncio.sleep(pause_s)

    def _next(self) -> tuple[dict[Key, None], Key] | None:
        """Return the next key with its queue, or None if all queued keys are in progress."""
        for queue in (self._waiting, self._can_wait):
            for key in queue:
                if key not in self._in_progress:
                    return queue, key
        return None

    def _queued(self, key: Key) -> bool:
        return key in self._waiting or key in self._can_wait

    async def _attempt(self, key: Key) -> None:
        try:
            if self._after is not None:
                await self._after()
            with reconciling(self.name):
                await self._reconcile(key)
        except Exception as error:
            backoff = self.failures.setdefault(key, Backoff(_FIRST_RETRY_S, _MAX_RETRY_S))
            pause_s = backoff.delay_s()
            name = "/".join(filter(None, key))
            message = "work queue: reconcile failed (kind=%s name=%s retry_s=%.1f error=%s)"
            if isinstance(error, KubeError):
                level = logging.INFO if backoff.attempts <= 2 else logging.WARNING
                log.log(level, message, self.name, name, pause_s, error)
            else:
                log.warning(message, self.name, name, pause_s, repr(error), exc_info=True)
            if not self._queued(key):
                self._retries[key] = asyncio.get_running_loop().call_later(pause_s, self.add, key)
        else:
            self.failures.pop(key, None)


class Subscription:
    """Wakes the reconciler of one Application when one of its inputs changed."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()
        self._urgent = asyncio.Event()

    def wake(self, *, urgent: bool = False) -> None:
        """Record a change. An urgent change also ends a pause."""
        self._changed.set()
        if urgent:
            self._urgent.set()

    async def changed(self, timeout_s: float, *, pause_s: float = 0.0) -> bool:
        """Wait for a change since the last call, and then for more changes until the pause ends or one is urgent.

        Args:
            timeout_s: Maximum time until the first change, in seconds.
            pause_s: Duration of the pause, in seconds.

        Returns:
            False if nothing changed in time.
        """
        try:
            async with asyncio.timeout(timeout_s):
                await self._changed.wait()
        except TimeoutError:
            return False
        finally:
            self._changed.clear()
        if pause_s > 0:
            with suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._urgent.wait()
            self._urgent.clear()
        return True


class Subscriptions:
    """The subscriptions of all Applications, by the value of their label."""

    def __init__(self) -> None:
        self._by_application: dict[Key, list[Subscription]] = {}
        self._placed: set[Key] = set()
        self._full_nodes: dict[Key, Collection[str]] = {}

    @contextmanager
    def subscribe(self, key: Key) -> Iterator[Subscription]:
        """Subscribe to changes that concern one Application, while the context lasts."""
        label = label_key(key)
        subscription = Subscription()
        self._by_application.setdefault(label, []).append(subscription)
        try:
            yield subscription
        finally:
            self._by_application[label].remove(subscription)
            if not self._by_application[label]:
                del self._by_application[label]
                self._placed.discard(label)
                self._full_nodes.pop(label, None)

    def set_placed(self, key: Key, *, placed: bool, full: Collection[str] = frozenset()) -> None:
        """Record which released resources wake an Application.

        If the Application has no suitable plan, all released resources wake it. Otherwise, only free capacity on the nodes `full`
        wakes it.

        Args:
            key: The Application.
            placed: True if it has a suitable plan.
            full: Full nodes on which it would run instances if they had free capacity.
        """
        label = label_key(key)
        if placed:
            self._placed.add(label)
        else:
            self._placed.discard(label)
        self._full_nodes.pop(label, None)
        if full:
            self._full_nodes[label] = full

    def wake(self, key: Key, *, urgent: bool = False) -> None:
        """Wake one Application."""
        for subscription in self._by_application.get(label_key(key), ()):
            subscription.wake(urgent=urgent)

    def wake_waiting(self) -> None:
        """Wake every Application without a suitable plan, because another Application released resources."""
        for label in self._by_application.keys() - self._placed:
            for subscription in self._by_application[label]:
                subscription.wake()

    def wake_for_capacity(self, node: str) -> None:
        """Wake every Application that would use a node if it had free capacity, because capacity was released."""
        for label, full in self._full_nodes.items():
            if node in full:
                for subscription in self._by_application.get(label, ()):
                    subscription.wake()

    def wake_all(self, *, urgent: bool = False, first: Iterable[Key] = ()) -> None:
        """Wake every Application, because an input of all of them changed.

        Args:
            urgent: End pauses.
            first: Applications to wake before the others, such as those whose drones are in flight.
        """
        in_order = dict.fromkeys((*map(label_key, first), *self._by_application))
        for label in in_order:
            for subscription in self._by_application.get(label, ()):
                subscription.wake(urgent=urgent)
