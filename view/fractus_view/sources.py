"""Sources of events: complete recordings, and recordings that services are writing."""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import logging
import time
from base64 import b64decode
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from fractus_runtime.mcap_tail import DamagedFile, MessageLocation, Tail, message_at

from fractus_view.events import END, RESET, Event, Problem, State, encode, stream_message
from fractus_view.flight_times import FlightTimes
from fractus_view.hub import Hub
from fractus_view.translation import ON_THE_GROUND, Translator

log = logging.getLogger(__name__)

POLL_INTERVAL_S = 0.5
"""Interval between two scans of the directory, in seconds. Services write every 3 s."""

MAX_CURRENT_AGE_S = 60.0
"""Time without writes, in seconds, after which a file counts as part of an earlier flight."""

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


class PictureFiles:
    """Files with pictures. The number of a file is its index in `paths`."""

    def __init__(self, paths: Sequence[Path] = ()) -> None:
        self.paths = list(paths)

    def picture(self, id_: str) -> bytes | None:
        """Return a picture by the id that `Translator` assigned, or None if it does not exist."""
        parts = id_.split("-")
        if len(parts) != 3 or not all(part.isascii() and part.isdecimal() and len(part) < 16 for part in parts):
            return None
        file, offset, index = map(int, parts)
        try:
            content = message_at(self.paths[file], MessageLocation(offset, index))
            return b64decode(content["data"], validate=True) if content and content.get("format") == "jpeg" else None
        except (DamagedFile, OSError, IndexError, KeyError, ValueError, TypeError):
            return None


class Replay:
    """Complete recordings. Each page receives all events in chronological order.

    Args:
        paths: MCAP files of one or several drones and services.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._files = PictureFiles(paths)

    def picture(self, id_: str) -> bytes | None:
        """See `Source`."""
        return self._files.picture(id_)

    async def run(self) -> None:
        """Do nothing, because recordings do not change."""

    async def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Yield all events, and finally `END`. The id of a message is the number of events sent up to this message."""
        sent = int(last_id) if last_id.isascii() and last_id.isdecimal() and len(last_id) < 16 else 0
        events = itertools.islice(self.events(), sent, None)
        first = [] if sent else [RESET]
        while batch := await asyncio.to_thread(lambda: [encode(event) for event in itertools.islice(events, _BATCH)]):
            sent += len(batch)
            yield stream_message(str(sent), [*first, *batch])
            first = []
        yield stream_message(str(sent), [*first, END])

    def events(self) -> Iterator[Event]:
        """Yield the events of all files, merged by time."""
        per_file = (_events(Tail(path), Translator(number)) for number, path in enumerate(self._files.paths))
        return _with_flights(heapq.merge(*per_file, key=lambda event: event.time_ms), FlightTimes())


def _with_flights(events: Iterable[Event], flights: FlightTimes) -> Iterator[Event]:
    """Add the start of the flight to each state. A flight may begin in an earlier file, so events of all files are needed."""
    for event in events:
        if isinstance(event, State):
            started_ms = flights.update(event.drone, event.time_ms, in_air=event.phase != ON_THE_GROUND)
            yield replace(event, flight_ms=started_ms)
        else:
            yield event


def _events(tail: Tail, translator: Translator) -> Iterator[Event]:
    """Yield the events of a file, and one `Problem` if it is damaged."""
    last_ms = 0
    try:
        for message in tail.read():
            last_ms = message.time_ms
            yield from translator.events(message)
    except (DamagedFile, OSError) as error:
        tail.finished = True
        yield Problem(last_ms, f"the rest of a recording cannot be read: {error}")


class GrowingRecordings:
    """Recordings that services are writing below a directory.

    Args:
        directory: Directory that is scanned, with its subdirectories.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._hub = Hub()
        self._files = PictureFiles()
        self._open: dict[Path, tuple[Tail, Translator]] = {}
        self._flights = FlightTimes()
        self._problem = ""

    def picture(self, id_: str) -> bytes | None:
        """See `Source`. The result is also None if the file of the picture was removed."""
        return self._files.picture(id_)

    def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Yield the current state, then changes."""
        return self._hub.stream(last_id)

    async def run(self) -> None:
        """Read the files as they grow, until cancelled."""
        while True:
            events = await asyncio.to_thread(self._read)
            if events:
                self._hub.publish(events)
            await asyncio.sleep(POLL_INTERVAL_S)

    def _read(self) -> list[Event]:
        events: list[Event] = []
        try:
            self._scan()
            self._problem = ""
        except OSError as error:
            text = f"cannot read recordings: {error}"
            if text != self._problem:
                self._problem = text
                log.warning("view: %s", text)
                events.append(Problem(round(time.time() * 1000), text))
        for tail, translator in self._open.values():
            if not tail.finished:
                events += _events(tail, translator)
        return list(_with_flights(sorted(events, key=lambda event: event.time_ms), self._flights))

    def _scan(self) -> None:
        """Start to read new files, and forget removed files."""
        modified = dict(_modification_times(self._directory))
        for path in self._open.keys() - modified.keys():
            del self._open[path]
        for path in sorted(modified.keys() - self._open.keys()):
            if time.time() - modified[path] < MAX_CURRENT_AGE_S:
                self._open[path] = (Tail(path), Translator(len(self._files.paths)))
                self._files.paths.append(path)


def _modification_times(directory: Path) -> Iterator[tuple[Path, float]]:
    """Yield the recordings below a directory with their modification times."""
    directory.stat()
    for path in directory.rglob("*.mcap"):
        # Services may remove the oldest files at any time, and a link may lead nowhere.
        with contextlib.suppress(OSError):
            yield path, path.stat().st_mtime
