"""Informer: keeps a local copy of a collection up to date with list and watch."""

from __future__ import annotations

import asyncio
import logging
import math
import random
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from typing import Generic, TypeVar

from fractus_runtime.backoff import Backoff
from fractus_runtime.kubernetes.client import Client
from fractus_runtime.kubernetes.errors import Expired, KubeError
from fractus_runtime.kubernetes.objects import Body, Key, Kind, key_of, version_number, version_of

log = logging.getLogger(__name__)

T = TypeVar("T")

_WATCH_TIMEOUT_S = (240, 300)
_SILENCE_S = 100.0
_BACKOFF_S = (0.4, 30.0)
_STEADY_S = 1.0
"""Minimum duration of a watch in seconds. A shorter watch without an event counts as a failure, so a pause follows."""


class Informer(Generic[T]):
    """A local copy of a collection, updated by a watch.

    Only the results of `parse` are kept, so that a large collection takes little memory. Every change is reported to
    `on_change(key, old, new)`, including changes that are found by listing again.

    Args:
        client: The API server.
        kind: Kind of the objects.
        parse: Returns the part of an object to keep.
        on_change: Called with the key, the old and the new value of each changed object. The old value of a created object
            and the new value of a deleted one are None.
        selectors: labelSelector and fieldSelector, if any.
        namespace: Namespace of the objects. Empty: all namespaces.
        rng: Source of the jitter.

    Attributes:
        synced: Set when the collection was listed once.
        restarts: Number of ended watches.
        watching: True while a watch is open.
    """

    def __init__(
        self,
        client: Client,
        kind: Kind,
        parse: Callable[[Body], T],
        on_change: Callable[[Key, T | None, T | None], None],
        *,
        selectors: Mapping[str, str] | None = None,
        namespace: str = "",
        rng: random.Random | None = None,
    ) -> None:
        self.kind = kind
        self._namespace = namespace
        self.synced = asyncio.Event()
        self.restarts = 0
        self.watching = False
        self._client = client
        self._parse = parse
        self._on_change = on_change
        self._selectors = dict(selectors or {})
        self._rng = rng or random.Random()  # noqa: S311  (jitter)
        self._objects: dict[Key, T] = {}
        self._own_writes: dict[Key, int] = {}
        self._backoff = Backoff(*_BACKOFF_S, self._rng)
        self._reached = 0
        self._last_contact = float("-inf")

    def get(self, key: Key) -> T | None:
        """Return the object with this key, or None."""
        return self._objects.get(key)

    def __contains__(self, key: Key) -> bool:
        """Return True if there is an object with this key, even if `parse` returned None for it."""
        return key in self._objects

    def items(self) -> Iterator[tuple[Key, T]]:
        """Iterate over all objects with their keys."""
        return iter(self._objects.items())

    def values(self) -> Iterator[T]:
        """Iterate over all objects."""
        return iter(self._objects.values())

    def __len__(self) -> int:
        """Return the number of objects."""
        return len(self._objects)

    def record_write(self, key: Key, body: Body) -> None:
        """Add the result of a write by this process before the watch reports it. Older events are then ignored.

        A result is ignored if the watch or a list has already reported a later state.
        """
        version = version_of(body)
        if 0 < version <= self._reached:
            return
        self._own_writes[key] = version
        self._put(key, body)

    def age_s(self) -> float:
        """Return the seconds since the last message of the API server about the collection."""
        return asyncio.get_running_loop().time() - self._last_contact

    async def run(self) -> None:
        """List and watch until cancelled. The pause before the next attempt grows with each failure."""
        version = ""
        loop = asyncio.get_running_loop()
        while True:
            opened_s = math.inf
            try:
                if not version:
                    version = await self._list()
                opened_s = loop.time()
                async for latest in self._watch(version):
                    version = latest
                    self._backoff.succeeded()
            except Expired:
                log.info("informer: watch expired, listing again (kind=%s)", self.kind.plural)
                version = ""
                ended = False
            except KubeError as error:
                if error.status not in (0, 429) and error.status < 500:
                    version = ""
                report = log.warning if self._backoff.attempts else log.info
                report("informer: list or watch failed (kind=%s error=%s)", self.kind.plural, error)
                ended = False
            else:
                ended = True
            self.watching = False
            steady = loop.time() - opened_s >= _STEADY_S
            if steady:
                self._backoff.succeeded()
            if self.age_s() >= _SILENCE_S:
                # The API server sends a bookmark about every minute. After a restore from a backup it sends nothing until
                # it reaches this version again.
                version = ""
            if not (steady and ended):
                await asyncio.sleep(self._backoff.delay_s())
            self.restarts += 1

    def _on_opened(self) -> None:
        self.watching = True
        self._record_contact()

    def _record_contact(self) -> None:
        self._last_contact = asyncio.get_running_loop().time()

    async def _list(self) -> str:
        listed: set[Key] = set()
        continue_ = ""
        while True:
            page = await self._client.list_page(
                self.kind, namespace=self._namespace, selectors=self._selectors, continue_=continue_
            )
            self._record_contact()
            # Record the version of the list before its items are complete. A write result that arrives meanwhile may be
            # older than the list, and is ignored then.
            self._reach(page.resource_version)
            for item in page.items:
                listed.add(key_of(item))
                self._take("MODIFIED", item)
            continue_ = page.continue_
            if not continue_:
                break
        version = version_number(page.resource_version)
        for key in self._objects.keys() - listed:
            # An object that was created after the list is missing in it.
            if self._own_writes.get(key, 0) <= version:
                self._drop(key)
        self.synced.set()
        return page.resource_version

    async def _watch(self, version: str) -> AsyncIterator[str]:
        timeout_s = self._rng.randint(*_WATCH_TIMEOUT_S)
        async for type_, body in self._client.watch(
            self.kind,
            namespace=self._namespace,
            resource_version=version,
            selectors=self._selectors,
            timeout_s=timeout_s,
            silence_s=_SILENCE_S,
            opened=self._on_opened,
        ):
            self._record_contact()
            if type_ != "BOOKMARK":
                self._take(type_, body)
            self._reach(body["metadata"]["resourceVersion"])
            yield body["metadata"]["resourceVersion"]

    def _reach(self, version: str) -> None:
        """Record the resource version up to which all changes are known."""
        self._reached = max(self._reached, version_number(version))

    def _take(self, type_: str, body: Body) -> None:
        key = key_of(body)
        version = version_of(body)
        own_write = self._own_writes.get(key, 0)
        if version < own_write or (own_write and version == own_write and type_ != "DELETED"):
            return
        self._own_writes.pop(key, None)
        if type_ == "DELETED":
            self._drop(key)
        else:
            self._put(key, body)

    def _put(self, key: Key, body: Body) -> None:
        try:
            new = self._parse(self._typed(body))
        except Exception:
            # An invalid object must not stop the informer. The last valid version of the object is kept.
            log.exception(
                "informer: object cannot be parsed (kind=%s name=%s)", self.kind.plural, "/".join(filter(None, key))
            )
            return
        old = self._objects.get(key)
        self._objects[key] = new
        if old is None or old != new:
            self._notify(key, old, new)

    def _drop(self, key: Key) -> None:
        self._own_writes.pop(key, None)
        if key in self._objects:
            self._notify(key, self._objects.pop(key), None)

    def _notify(self, key: Key, old: T | None, new: T | None) -> None:
        try:
            self._on_change(key, old, new)
        except Exception:
            log.exception(
                "informer: handler of a change failed (kind=%s name=%s)", self.kind.plural, "/".join(filter(None, key))
            )

    def _typed(self, item: Body) -> Body:
        """Add apiVersion and kind, which items of a list do not have. Remove managedFields, half of the size of an object."""
        item["metadata"].pop("managedFields", None)
        item.setdefault("apiVersion", self.kind.api_version)
        item.setdefault("kind", self.kind.name)
        return item
