"""Follows the logs of pods as they come, restart and go."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from fractus_runtime.kubernetes import POD, Backoff, Client, Key, KubeError, Reflector

from fractus_cli.log_reader import LogReader, Problems
from fractus_cli.log_sources import Line, Source, sources

MAX_FOLLOWED = 90
"""Containers at once: each has a connection to the API server."""

_BACKOFF_S = (0.5, 10.0)
_STATUS_S = 10.0
"""After a container ended, its pod's status is waited for as long; then the log is asked for again, be it for a kubelet that restarted."""


@dataclass(frozen=True, slots=True)
class Place:
    """Some pods.

    Attributes:
        namespace: where they are.
        selector: their labels.
    """

    namespace: str
    selector: str

    @property
    def selectors(self) -> Mapping[str, str]:
        """The same as a parameter of a request."""
        return {"labelSelector": self.selector}


class Follower:
    """Shows lines as they are written, until cancelled.

    Args:
        client: of the cluster.
        reader: knows what was read before.
        show: takes a line.
        chosen: which of the containers are followed.
        problems: takes what cannot be read.
    """

    def __init__(
        self,
        client: Client,
        reader: LogReader,
        show: Callable[[Line], None],
        chosen: Callable[[list[Source]], list[Source]],
        problems: Problems,
    ) -> None:
        self._client = client
        self._reader = reader
        self._show = show
        self._chosen = chosen
        self._problems = problems
        self._sources: dict[tuple[str, str], Source] = {}
        self._changes: dict[tuple[str, str], asyncio.Event] = {}

    async def run(self, places: list[Place]) -> None:
        """Follow the pods of some places, and those that come."""
        async with asyncio.TaskGroup() as group:
            for place in places:
                watched = Reflector(
                    self._client,
                    POD,
                    sources,
                    partial(self._changed, group),
                    selectors=place.selectors,
                    namespace=place.namespace,
                )
                group.create_task(watched.run())

    def _changed(
        self, group: asyncio.TaskGroup, _pod: Key, old: tuple[Source, ...] | None, new: tuple[Source, ...] | None
    ) -> None:
        for source in old or ():
            self._sources.pop(source.key, None)
        for source in new or ():
            self._sources[source.key] = source
        for source in (*(old or ()), *(new or ())):
            if source.key in self._changes:
                self._changes[source.key].set()
        for source in self._chosen([*self._sources.values()]):
            if source.key not in self._changes and self._room():
                self._changes[source.key] = asyncio.Event()
                group.create_task(self._follow(source.key))

    def _room(self) -> bool:
        if len(self._changes) < MAX_FOLLOWED:
            return True
        self._problems.tell(
            "too many",
            f"more than {MAX_FOLLOWED} containers at once: the others are not followed; choose by --component",
        )
        return False

    async def _follow(self, key: tuple[str, str]) -> None:
        backoff = Backoff(*_BACKOFF_S)
        ended = ""
        while (source := self._sources.get(key)) is not None:
            if source.run and source.run != ended:
                try:
                    async for line in self._reader.unseen(source, follow=True):
                        self._reader.succeeded(source)
                        backoff.succeeded()
                        self._show(line)
                except KubeError as error:
                    await self._reader.failed(source, error)
                    await asyncio.sleep(backoff.delay_s())
                    continue
                self._reader.succeeded(source)
                ended = "" if source.running else source.run
            await self._wait(source, _STATUS_S if source.running else None)
        del self._changes[key]

    async def _wait(self, source: Source, timeout_s: float | None) -> None:
        change = self._changes[source.key]
        change.clear()
        if self._sources.get(source.key) != source:
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await change.wait()
