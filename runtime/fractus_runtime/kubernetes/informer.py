"""Keeps a local copy of a collection current: list, then watch, and list again where the watch cannot go on."""

from __future__ import annotations

import asyncio
import logging
import math
import random
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from typing import Generic, TypeVar

from fractus_runtime.kubernetes.backoff import Backoff
from fractus_runtime.kubernetes.client import Client
from fractus_runtime.kubernetes.errors import Expired, KubeError
from fractus_runtime.kubernetes.objects import Body, Key, Kind, key_of

logger = logging.getLogger(__name__)

T = TypeVar("T")

_WATCH_TIMEOUT_S = (240, 300)
_SILENCE_S = 100.0
_BACKOFF_S = (0.4, 30.0)
_STEADY_S = 1.0
"""A watch that ends sooner, without an event, is followed by a pause, as a failure is."""


class Informer(Generic[T]):
    """A current local copy of a collection.

    Only what `parse` returns is kept, so a large collection costs what is used of it. Every
    difference is reported to `on_change(key, old, new)`, also those found by listing again. Of a namespaced kind it
    holds all namespaces, or one.
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
        """Whether a watch is open: what changes at the API server is heard of, as far as the connection holds."""
        self._client = client
        self._parse = parse
        self._on_change = on_change
        self._selectors = dict(selectors or {})
        self._rng = rng or random.Random()  # noqa: S311  (jitter)
        self._objects: dict[Key, T] = {}
        self._noted: dict[Key, int] = {}
        self._backoff = Backoff(*_BACKOFF_S, self._rng)
        self._reached = 0
        self._last_contact = float("-inf")

    def get(self, key: Key) -> T | None:
        """The object with this key, or None."""
        return self._objects.get(key)

    def __contains__(self, key: Key) -> bool:
        """Whether there is an object with this key, be it one that `parse` makes nothing of."""
        return key in self._objects

    def items(self) -> Iterator[tuple[Key, T]]:
        """Every object with its key."""
        return iter(self._objects.items())

    def values(self) -> Iterator[T]:
        """Every object."""
        return iter(self._objects.values())

    def __len__(self) -> int:
        """How many objects there are."""
        return len(self._objects)

    def record_write(self, key: Key, body: Body) -> None:
        """Take what a write of our own returned, ahead of the watch, which then has nothing older to say of it.

        An answer that comes after the watch or a list told of that moment is old news: it says nothing more.
        """
        version = _version(body)
        if 0 < version <= self._reached:
            return
        self._noted[key] = version
        self._put(key, body)

    def age_s(self) -> float:
        """Seconds since the API server last said anything about the collection."""
        return asyncio.get_running_loop().time() - self._last_contact

    async def run(self) -> None:
        """List and watch until cancelled; failures are retried with growing, jittered pauses."""
        version = ""
        loop = asyncio.get_running_loop()
        while True:
            opened_s = math.inf
            try:
                if not version:
                    version = await self._list()
                opened_s = loop.time()
                async for seen in self._watch(version):
                    version = seen
                    self._backoff.succeeded()
            except Expired:
                logger.info("reflector of %s: the watch expired; listing again", self.kind.plural)
                version, ended = "", False
            except KubeError as error:
                if error.status not in (0, 429) and error.status < 500:
                    version = ""
                log = logger.warning if self._backoff.attempts else logger.info
                log("reflector of %s: %s", self.kind.plural, error)
                ended = False
            else:
                ended = True
            self.watching = False
            steady = loop.time() - opened_s >= _STEADY_S
            if steady:
                self._backoff.succeeded()
            if self.age_s() >= _SILENCE_S:
                # An API server sends bookmarks. One that was restored from a backup says nothing until it comes to this version again.
                version = ""
            if not (steady and ended):
                await asyncio.sleep(self._backoff.delay_s())
            self.restarts += 1

    def _opened(self) -> None:
        self.watching = True
        self._heard()

    def _heard(self) -> None:
        self._last_contact = asyncio.get_running_loop().time()

    async def _list(self) -> str:
        listed: set[Key] = set()
        continue_ = ""
        while True:
            page = await self._client.list_page(
                self.kind, namespace=self._namespace, selectors=self._selectors, continue_=continue_
            )
            self._heard()
            # All pages show the same moment: what a later one brings is no older than an answer that comes meanwhile.
            self._reach(page.resource_version)
            for item in page.items:
                listed.add(key_of(item))
                self._take("MODIFIED", item)
            continue_ = page.continue_
            if not continue_:
                break
        version = _number(page.resource_version)
        for key in self._objects.keys() - listed:
            # What was made while the list was on its way is not in it.
            if self._noted.get(key, 0) <= version:
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
            opened=self._opened,
        ):
            self._heard()
            if type_ != "BOOKMARK":
                self._take(type_, body)
            self._reach(body["metadata"]["resourceVersion"])
            yield body["metadata"]["resourceVersion"]

    def _reach(self, version: str) -> None:
        """Remember up to which moment everything was told."""
        self._reached = max(self._reached, _number(version))

    def _take(self, type_: str, body: Body) -> None:
        key = key_of(body)
        version, noted = _version(body), self._noted.get(key, 0)
        if version < noted or (noted and version == noted and type_ != "DELETED"):
            return
        self._noted.pop(key, None)
        if type_ == "DELETED":
            self._drop(key)
        else:
            self._put(key, body)

    def _put(self, key: Key, body: Body) -> None:
        try:
            new = self._parse(self._typed(body))
        except Exception:
            # One object of an unforeseen shape must not hide all others: its last readable version stays.
            logger.exception("reflector of %s: %s cannot be read", self.kind.plural, "/".join(filter(None, key)))
            return
        old = self._objects.get(key)
        self._objects[key] = new
        if old is None or old != new:
            self._tell(key, old, new)

    def _drop(self, key: Key) -> None:
        self._noted.pop(key, None)
        if key in self._objects:
            self._tell(key, self._objects.pop(key), None)

    def _tell(self, key: Key, old: T | None, new: T | None) -> None:
        try:
            self._on_change(key, old, new)
        except Exception:
            logger.exception(
                "reflector of %s: a change of %s was not handled", self.kind.plural, "/".join(filter(None, key))
            )

    def _typed(self, item: Body) -> Body:
        """Items of a list come without their kind: give it to them. Who manages which field, half of an object, goes."""
        item["metadata"].pop("managedFields", None)
        item.setdefault("apiVersion", self.kind.api_version)
        item.setdefault("kind", self.kind.name)
        return item


def _version(body: Body) -> int:
    """An object's resource version as a number, which grows; 0 where it is none."""
    return _number(str(body["metadata"].get("resourceVersion", "")))


def _number(version: str) -> int:
    return int(version) if version.isdecimal() else 0
