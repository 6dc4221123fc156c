"""Reads verdicts and positions of a flight from the audit logs of the mobility and camera services."""

from __future__ import annotations

import heapq
import json
import re
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, Generic, NamedTuple, TypeVar

from fractus_core.api.flight_records import FlightVerdict, RecordedPicture, TrackPoint
from fractus_runtime.audit_chain import segments
from fractus_runtime.files import open_file

from fractus_agent.records.flight_entries import FlightEntries, entry_time
from fractus_agent.records.planned_flight import PlannedFlight

MOBILITY_LOG = "mobility.jsonl"
CAMERA_LOG = "camera.jsonl"

_POSITION = re.compile(r"([0-9]{1,15})-([0-9]{1,15})")

Record = TypeVar("Record", FlightVerdict, TrackPoint, RecordedPicture)


class InvalidContinue(ValueError):
    """The continuation token of a page is invalid."""


class Page(NamedTuple, Generic[Record]):
    """Records, and the continuation token of the next page, or None if there are no more for now."""

    items: list[Record]
    continue_: str | None


class _Found(NamedTuple, Generic[Record]):
    """A record, with its time for merging, the number of its log, and its sequence number there."""

    time_s: float
    log: int
    sequence: int
    record: Record


def read_verdicts(directory: Path, flight: PlannedFlight, limit: int, continue_: str) -> Page[FlightVerdict]:
    """Return a page of the verdicts of a flight.

    Args:
        directory: Directory of the audit logs.
        flight: The flight.
        limit: Maximum number of verdicts.
        continue_: Continuation token of the previous page. Empty: the first page.

    Raises:
        InvalidContinue: The continuation token is invalid.
        OSError: A log cannot be read.
    """
    return _page((directory / MOBILITY_LOG, directory / CAMERA_LOG), flight, FlightVerdict, limit, continue_)


def read_track(directory: Path, flight: PlannedFlight, limit: int, continue_: str) -> Page[TrackPoint]:
    """Return a page of the positions of a flight. See `read_verdicts`."""
    return _page((directory / MOBILITY_LOG,), flight, TrackPoint, limit, continue_)


def _page(
    logs: tuple[Path, ...], flight: PlannedFlight, wanted: type[Record], limit: int, continue_: str
) -> Page[Record]:
    """Return a page.

    The logs are read from the start of the flight for each page, because earlier entries determine which later entries belong to
    the flight.
    """
    reached = list(_parse_continue(continue_))
    items: list[Record] = []
    with ExitStack() as stack:
        found = heapq.merge(
            *(_records(stack, number, log, flight, wanted) for number, log in enumerate(logs)),
            key=lambda each: each.time_s,
        )
        for each in found:
            if each.sequence <= reached[each.log]:
                continue
            if len(items) == limit:
                return Page(items, f"{reached[0]}-{reached[1]}")
            items.append(each.record)
            reached[each.log] = each.sequence
    return Page(items, None)


def _parse_continue(text: str) -> tuple[int, int]:
    if not text:
        return 0, 0
    match = _POSITION.fullmatch(text)
    if match is None:
        raise InvalidContinue("continue: use the value of the previous page, or omit it for the first page")
    return int(match[1]), int(match[2])


def _records(
    stack: ExitStack, number: int, log: Path, flight: PlannedFlight, wanted: type[Record]
) -> Iterator[_Found[Record]]:
    entries = FlightEntries(flight)
    last = 0
    for entry in _entries(stack, log, flight):
        sequence = entry.get("seq")
        # A segment that was closed meanwhile is read twice.
        if not isinstance(sequence, int) or sequence <= last:
            continue
        last = sequence
        record = entries.take(entry)
        if isinstance(record, wanted):
            yield _Found(record.time.timestamp(), number, sequence, record)


def _entries(stack: ExitStack, log: Path, flight: PlannedFlight) -> Iterator[dict[str, Any]]:
    """Yield the entries of a log that may belong to a flight. Lines that are not entries are skipped."""
    own = f"/ns/{flight.namespace}/app/{flight.application}/".encode()
    for file in _files(stack, log, flight):
        for line in file:
            # Skip calls of other flights, which are most entries, without parsing them. Quotes inside JSON strings are escaped, so
            # this text cannot occur inside a string.
            if b'"kind":"call"' in line and own not in line:
                continue
            try:
                entry = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(entry, dict):
                yield entry


def _files(stack: ExitStack, log: Path, flight: PlannedFlight) -> Iterator[IO[bytes]]:
    """Yield the open files of a log that may contain the time of a flight, oldest first."""
    current: IO[bytes] | None = None
    # While a full file becomes a segment, there is no present file for a moment.
    with suppress(FileNotFoundError):
        # Open the present file first, because it may become a segment while the segments are read.
        current = stack.enter_context(open_file(log))
    files = segments(log)
    begins = [*map(_begin_s, files), float("inf")]
    for path, (begin_s, next_s) in zip(files, pairwise(begins), strict=True):
        if not flight.may_cover(begin_s, next_s):
            continue
        try:
            file = open_file(path)
        except FileNotFoundError:
            continue  # removed to free space
        with file:
            yield file
    if current is not None:
        yield current


def _begin_s(segment: Path) -> float:
    """Return the time of the first entry of a segment, or 0 if it is unknown."""
    try:
        with open_file(segment) as file:
            entry = json.loads(file.readline())
            time = entry_time(entry) if isinstance(entry, dict) else None
    except (OSError, ValueError, RecursionError):
        return 0.0
    return time.timestamp() if time is not None else 0.0
