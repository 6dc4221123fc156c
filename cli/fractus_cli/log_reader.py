"""Reads logs of containers through the API server: what there is, merged by time, and what comes."""

from __future__ import annotations

import asyncio
import heapq
import re
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import aclosing
from dataclasses import dataclass
from datetime import timedelta
from http import HTTPStatus

from fractus_runtime.kubernetes import Client, Invalid, KubeError, NotFound

from fractus_cli.log_sources import Line, Source, by_node, read_line

_SILENCE_S = 15.0
_AT_ONCE = 16
_ANSWER_S = 5.0
_OUT_OF_REACH = re.compile("dial tcp|timeout|deadline exceeded|no route|connection re|EOF|error trying to reach", re.I)


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is read of what was written before.

    Attributes:
        tail: lines of each container, from its end; None: all.
        since: how old they may be; None: as old as they are.
        system_since: RFC 3339, from when parts of Fractus are read where `since` is None.
    """

    tail: int | None = None
    since: timedelta | None = None
    system_since: str = ""

    def params(self, source: Source) -> dict[str, str]:
        """The same as parameters of a request."""
        params = {} if self.tail is None else {"tailLines": str(self.tail)}
        if self.since is not None:
            params["sinceSeconds"] = str(int(self.since.total_seconds()))
        elif source.system and self.system_since:
            params["sinceTime"] = self.system_since
        return params


@dataclass(frozen=True, slots=True)
class _Position:
    """The last line that was read of a container: its time, and how many lines had just this time."""

    time_ns: int
    time: str
    lines: int


class Problems:
    """What could not be read, as sentences that are said once until it is solved."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._said: set[str] = set()
        self.any = False
        """Whether there was one."""

    def tell(self, what: str, sentence: str) -> None:
        """Say the sentence, unless the last one of `what` was not solved yet."""
        self.any = True
        if what not in self._said:
            self._said.add(what)
            self._say(sentence)

    def solved(self, what: str) -> None:
        """The next one of `what` is said again."""
        self._said.discard(what)


class LogReader:
    """Reads each line of each container once.

    Args:
        client: of the cluster.
        extent: how much of what was written before.
        problems: takes what cannot be read.
    """

    def __init__(self, client: Client, extent: Extent, problems: Problems) -> None:
        self._client = client
        self._extent = extent
        self._problems = problems
        self._slots = asyncio.Semaphore(_AT_ONCE)
        self._positions: dict[str, _Position] = {}
        self._asked: set[str] = set()
        """Containers of the history: the extent is for them, others are read from their beginning."""

    async def history(self, sources: Iterable[Source]) -> list[Line]:
        """What was written up to now, in the order of the nodes' clocks; each container's lines stay in their own order.

        Raises:
            KubeError: the API server does not answer, or does not let these logs be read.
        """
        chosen = [source for source in sources if source.run]
        self._asked = {run for source in chosen for run in (source.run, source.previous) if run}
        failed: dict[Source, str] = {}
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(self._whole(source, failed)) for source in chosen]
        for node, parts, why in by_node(failed):
            self._problems.tell(node, f"{_unread(node, why)}; without the lines of {', '.join(parts)}")
        return list(heapq.merge(*(task.result() for task in tasks)))

    async def _whole(self, source: Source, failed: dict[Source, str]) -> list[Line]:
        lines: list[Line] = []
        async with self._slots:
            try:
                async for line in self.unseen(source, follow=False):
                    lines.append(line)  # noqa: PERF401  (those before an error are shown)
            except KubeError as error:
                if await self._refused(source, error):
                    failed[source] = str(error)
        tail = self._extent.tail
        return lines if tail is None else lines[len(lines) - min(tail, len(lines)) :]

    async def unseen(self, source: Source, *, follow: bool) -> AsyncIterator[Line]:
        """Lines that were not read yet: those of the container before, then those of this one.

        Args:
            source: which container.
            follow: go on until the container ends.

        Raises:
            KubeError: they cannot be read.
        """
        if source.previous:
            try:
                async for line in self._read(source, source.previous, {"previous": "true"}):
                    yield line
            except (NotFound, Invalid):
                pass  # the node has removed it
        async for line in self._read(source, source.run, {"follow": "true"} if follow else {}):
            yield line

    async def _read(self, source: Source, run: str, how: Mapping[str, str]) -> AsyncIterator[Line]:
        start = self._positions.get(run)
        if start is not None:
            extent = {"sinceTime": start.time}
        else:
            extent = self._extent.params(source) if run in self._asked else {}
        params = {"container": source.container, "timestamps": "true", **extent, **how}
        silence_s = None if "follow" in how else _SILENCE_S
        before_ns = same = 0
        async with aclosing(self._client.log((source.namespace, source.pod), params, silence_s=silence_s)) as read:
            async for raw in read:
                line = read_line(raw, source, before_ns)
                same = same + 1 if line.time_ns == before_ns else 1
                before_ns = line.time_ns
                # The API server takes whole seconds: what was read of the last one comes again.
                if start is not None and (line.time_ns, same) <= (start.time_ns, start.lines):
                    continue
                if line.time:
                    self._positions[run] = _Position(line.time_ns, line.time, same)
                yield line

    async def failed(self, source: Source, error: KubeError) -> None:
        """Say that a followed log could not be read; it is tried again.

        Raises:
            KubeError: it will not be readable.
        """
        if error.status == 0 and not await self._client.answers(_ANSWER_S):
            self._problems.tell("", f"the API server does not answer ({error}); trying again")
        elif await self._refused(source, error):
            self._problems.tell(source.node, f"{_unread(source.node, str(error))}; trying again")

    def succeeded(self, source: Source) -> None:
        """Both the API server and the source's node answer."""
        self._problems.solved("")
        self._problems.solved(source.node)

    async def _refused(self, source: Source, error: KubeError) -> bool:
        """Whether it is for the node that a log could not be read; what is for the container alone is said here."""
        if isinstance(error, NotFound | Invalid):
            self._problems.tell(f"{source.uid}/{source.container}", f"{source.label} has no log: {error}")
            return False
        if error.status == HTTPStatus.FORBIDDEN and source.system:
            self._problems.tell(f"{source.namespace}/", f"{error}; without the lines of Fractus")
            return False
        if error.status in (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN):
            raise error
        if error.status == 0 and not await self._client.answers(_ANSWER_S):
            raise error
        return True


def _unread(node: str, why: str) -> str:
    return f"{node} is out of reach ({why})" if _OUT_OF_REACH.search(why) else f"{node} gives no logs ({why})"
