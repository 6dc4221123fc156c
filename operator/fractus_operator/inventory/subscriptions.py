"""Wakes the reconcilers of Applications when one of their inputs changes."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress

from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.labels import labelled


class Subscription:
    """Wakes one reconciler when an input of its object changed."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()
        self._urgent = asyncio.Event()

    def wake(self, *, urgent: bool = False) -> None:
        """Note a change; an urgent one ends a rest."""
        self._changed.set()
        if urgent:
            self._urgent.set()

    async def changed(self, timeout_s: float) -> bool:
        """Wait for a change since the last call; False after the timeout."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._changed.wait()
        except TimeoutError:
            return False
        finally:
            self._changed.clear()
        return True

    async def rest(self, duration_s: float) -> None:
        """Let changes gather, unless one is urgent."""
        with suppress(TimeoutError):
            async with asyncio.timeout(duration_s):
                await self._urgent.wait()
        self._urgent.clear()


class Subscriptions:
    """The subscriptions of all applications, by the name that their labels give them."""

    def __init__(self) -> None:
        self._of: dict[Key, list[Subscription]] = {}
        self._placed: set[Key] = set()
        self._full: dict[Key, Collection[str]] = {}
        self._in_turn: dict[Key, bool] = {}
        """Those that `wake_all` has yet to wake, and whether urgently."""

    @contextmanager
    def subscribe(self, key: Key) -> Iterator[Subscription]:
        """Changes that concern one application, as long as the context lasts."""
        label, subscription = labelled(key), Subscription()
        self._of.setdefault(label, []).append(subscription)
        try:
            yield subscription
        finally:
            self._of[label].remove(subscription)
            if not self._of[label]:
                del self._of[label]
                self._placed.discard(label)
                self._full.pop(label, None)

    def placed(self, key: Key, *, placed: bool, full: Collection[str] = frozenset()) -> None:
        """Note whether an application has a plan that suits it: of what others leave it wants nothing then but room.

        Args:
            key: The application.
            placed: Whether it has.
            full: Nodes that it would use, were there room on them.
        """
        label = labelled(key)
        (self._placed.add if placed else self._placed.discard)(label)
        self._full.pop(label, None)
        if full:
            self._full[label] = full

    def wake(self, key: Key, *, urgent: bool = False) -> None:
        """Wake one application."""
        self._wake(labelled(key), urgent=urgent)

    def wake_waiting(self) -> None:
        """Wake every application without a plan that suits it: another one left something that it may wait for."""
        for label in self._of.keys() - self._placed:
            for subscription in self._of[label]:
                subscription.wake()

    def wake_for_room(self, node: str) -> None:
        """Wake every application that would use a node, were there room on it: something has left it."""
        for label, full in self._full.items():
            if node in full:
                for subscription in self._of.get(label, ()):
                    subscription.wake()

    def wake_all(self, *, urgent: bool = False, first: Iterable[Key] = ()) -> None:
        """Wake every application, because something that all depend on changed.

        They are woken one at each turn of the event loop: hundreds that reconcile take seconds of it, for which an
        application that a user changes meanwhile does not wait.

        Args:
            urgent: End a rest.
            first: Those that are to see it before all others: what flies is to be judged by new rules at once.
        """
        idle, waiting = not self._in_turn, self._in_turn
        order = dict.fromkeys(filter(self._of.__contains__, map(labelled, first)))
        self._in_turn = {label: urgent or waiting.get(label, False) for label in {**order, **waiting, **self._of}}
        if idle:
            self._next_turn()

    def _next_turn(self) -> None:
        if self._in_turn:
            self._wake(next(iter(self._in_turn)))
        if self._in_turn:
            asyncio.get_running_loop().call_soon(self._next_turn)

    def _wake(self, label: Key, *, urgent: bool = False) -> None:
        # Who is woken for another reason sees at once what all are to see.
        urgent = self._in_turn.pop(label, False) or urgent
        for subscription in self._of.get(label, ()):
            subscription.wake(urgent=urgent)
