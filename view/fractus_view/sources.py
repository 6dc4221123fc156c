"""Sources of events: complete recordings, or recordings that services write now."""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import logging
import time
from base64 import b64decode
from collections.abc import AsyncIterator, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from fractus_view.events import END, RESET, Event, Problem, encode, message
from fractus_view.hub import Hub
from fractus_view.mcap_tail import Damaged, Place, Tail, message_at
from fractus_view.translation import Translation

log = logging.getLogger(__name__)

POLL_S = 0.5
"""Seconds between two scans of the directory. Services write every 3 s."""

CURRENT_S = 60.0
"""A file without writes for more seconds belongs to an earlier flight."""

_BATCH = 1_000


class Source(Protocol):
    """Source of the page's events."""

    def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Yield messages of the event stream, after `last_id` if possible."""
        ...

    def picture(self, id_: str) -> bytes | None:
        """Return a picture (JPEG) by its id, or None. The method may read a file."""
        ...

    async def run(self) -> None:
        """Update the source until cancelled."""
        ...


class Files:
    """Files with pictures, by number."""

    def __init__(self, paths: Sequence[Path] = ()) -> None:
        self.paths = list(paths)

    def picture(self, id_: str) -> bytes | None:
        """Return a picture by the id that `Translation` assigned, or None if it does not exist."""
        parts = id_.split("-")
        if len(parts) != 3 or not all(part.isascii() and part.isdecimal() and len(part) < 16 for part in parts):
            return None
        file, offset, index = map(int, parts)
        try:
            content = message_at(self.paths[file], Place(offset, index))
            return b64decode(content["data"], validate=True) if content and content.get("format") == "jpeg" else None
        except (Damaged, OSError, IndexError, KeyError, ValueError, TypeError):
            return None


class Replay:
    """Complete recordings. Each page receives all events in chronological order.

    Args:
        paths: MCAP files, of one or more drones and services.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._files = Files(paths)

    def picture(self, id_: str) -> bytes | None:
        """Return a picture of the recordings."""
        return self._files.picture(id_)

    async def run(self) -> None:
        """Do nothing, because recordings do not change."""

    async def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Yield all events with numbers, and the end."""
        told = int(last_id) if last_id.isascii() and last_id.isdecimal() and len(last_id) < 16 else 0
        events = itertools.islice(self.events(), told, None)
        first = [] if told else [RESET]
        while batch := await asyncio.to_thread(lambda: [encode(event) for event in itertools.islice(events, _BATCH)]):
            told += len(batch)
            yield message(str(told), [*first, *batch])
            first = []
        yield message(str(told), [*first, END])

    def events(self) -> Iterator[Event]:
        """Yield the events of all files, merged by time."""
        found = (_events(Tail(path), Translation(number)) for number, path in enumerate(self._files.paths))
        return heapq.merge(*found, key=lambda event: event.time_ms)


def _events(tail: Tail, translation: Translation) -> Iterator[Event]:
    """Yield the events of a file, and one `Problem` if it is damaged."""
    last_ms = 0
    try:
        for told in tail.read():
            last_ms = told.time_ms
            yield from translation.events(told)
    except (Damaged, OSError) as error:
        tail.finished = True
        yield Problem(last_ms, f"a recording is damaged and cannot be read further: {error}")


class Following:
    """Recordings below one directory that services write now.

    Args:
        directory: looked through with all directories in it.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._hub = Hub()
        self._files = Files()
        self._open: dict[Path, tuple[Tail, Translation]] = {}
        self._problem = ""

    def picture(self, id_: str) -> bytes | None:
        """Return a picture of the recordings while its file exists."""
        return self._files.picture(id_)

    def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Yield the current state, then changes."""
        return self._hub.stream(last_id)

    async def run(self) -> None:
        """Read files as they grow."""
        while True:
            events = await asyncio.to_thread(self._read)
            if events:
                self._hub.publish(events)
            await asyncio.sleep(POLL_S)

    def _read(self) -> list[Event]:
        events: list[Event] = []
        try:
            self._look()
            self._problem = ""
        except OSError as error:
            text = f"recordings cannot be read: {error}"
            if text != self._problem:
                self._problem = text
                log.warning("view: %s", text)
                events.append(Problem(round(time.time() * 1000), text))
        for tail, translation in self._open.values():
            if not tail.finished:
                events += _events(tail, translation)
        return sorted(events, key=lambda event: event.time_ms)

    def _look(self) -> None:
        """Open new files, and close removed ones."""
        written = dict(_written(self._directory))
        for path in self._open.keys() - written.keys():
            del self._open[path]
        for path in sorted(written.keys() - self._open.keys()):
            if time.time() - written[path] < CURRENT_S:
                self._open[path] = (Tail(path), Translation(len(self._files.paths)))
                self._files.paths.append(path)


def _written(directory: Path) -> Iterator[tuple[Path, float]]:
    """Return the recordings in a directory with their modification times."""
    directory.stat()
    for path in directory.rglob("*.mcap"):
        # Services may remove the oldest files at any time.
        with contextlib.suppress(FileNotFoundError):
            yield path, path.stat().st_mtime
