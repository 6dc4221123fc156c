"""Reads the pictures of a flight from the recordings of the camera service, which contain pictures after privacy filters."""

from __future__ import annotations

import re
from base64 import b64decode
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from fractus_core.api.flight_records import RecordedPicture
from fractus_core.api.names import component_name
from fractus_runtime.mcap_tail import DamagedFile, RecordedMessage, Tail

from fractus_agent.records.audit_records import InvalidContinue, Page
from fractus_agent.records.planned_flight import PlannedFlight

MAX_PICTURE_RECORD_BYTES = 8_000_000
"""Maximum size of a record that is read: a picture of 6 MB, for which the agent needs 45 MB. Larger pictures are not returned."""

_SEGMENT = re.compile(r"(?P<number>[0-9]{6,9})-(?P<time>[0-9]{8}T[0-9]{6}Z)\.mcap")
_ID = re.compile(r"([0-9]{1,9})-([0-9]{1,12})-([0-9]{1,9})")


class NotRecorded(Exception):
    """The camera service of the node records no pictures."""


class _PictureId(NamedTuple):
    """Number of the segment, and offset and number of the message in it."""

    segment: int
    offset: int
    number: int


@dataclass(frozen=True, slots=True)
class _Segment:
    number: int
    begin_s: float
    path: Path


def read_pictures(directory: Path, flight: PlannedFlight, limit: int, continue_: str) -> Page[RecordedPicture]:
    """Return a page of the pictures that components of a flight have taken.

    Args:
        directory: Directory of the recordings of the camera service.
        flight: The flight.
        limit: Maximum number of pictures.
        continue_: Id of the last picture of the previous page. Empty: the first page.

    Raises:
        InvalidContinue: The id is invalid.
        NotRecorded: There is no directory.
        OSError: The directory cannot be read.
    """
    reached = _parse_id(continue_) if continue_ else _PictureId(-1, 0, 0)
    if reached is None:
        raise InvalidContinue("continue: use the value of the previous page, or omit it for the first page")
    items: list[RecordedPicture] = []
    for segment in _segments(directory, flight):
        if segment.number < reached.segment:
            continue
        for message in _pictures(segment, flight):
            id_ = _id(segment, message)
            if id_ <= reached:
                continue
            if len(items) == limit:
                return Page(items, items[-1].id)
            data = message.content["data"]
            items.append(
                RecordedPicture(
                    id="-".join(map(str, id_)),
                    time=datetime.fromtimestamp(message.time_ms / 1000, UTC),
                    component=component_name(_identity(message)),
                    size_bytes=len(data) * 3 // 4 - data.count("=", -2),
                )
            )
    return Page(items, None)


def read_picture(directory: Path, flight: PlannedFlight, id_: str) -> bytes | None:
    """Return a picture (JPEG) of a flight, or None if the flight has no picture with this id.

    The segment is read from its start, so an id that does not refer to a message never causes a read at its offset.

    Raises:
        NotRecorded: There is no directory.
        OSError: The directory cannot be read.
    """
    wanted = _parse_id(id_)
    if wanted is None:
        return None
    for segment in _segments(directory, flight):
        if segment.number == wanted.segment:
            for message in _pictures(segment, flight):
                if _id(segment, message) == wanted:
                    with suppress(ValueError):
                        return b64decode(message.content["data"], validate=True)
    return None


def _parse_id(text: str) -> _PictureId | None:
    """Parse the id of a picture, or return None if it is invalid."""
    match = _ID.fullmatch(text)
    return _PictureId(*map(int, match.groups())) if match is not None else None


def _id(segment: _Segment, message: RecordedMessage) -> _PictureId:
    return _PictureId(segment.number, message.location.offset, message.location.index)


def _segments(directory: Path, flight: PlannedFlight) -> Iterator[_Segment]:
    """Yield the segments that may contain the time of a flight, in the order of recording."""
    found = []
    try:
        paths = list(directory.iterdir())
    except FileNotFoundError:
        raise NotRecorded from None
    for path in paths:
        match = _SEGMENT.fullmatch(path.name)
        if match is not None:
            with suppress(ValueError):  # not a date
                begin = datetime.strptime(match["time"], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
                found.append(_Segment(int(match["number"]), begin.timestamp(), path))
    found.sort(key=lambda segment: segment.number)
    nexts = [later.begin_s for _, later in pairwise(found)]
    for segment, next_s in zip(found, [*nexts, float("inf")], strict=True):
        if flight.may_cover(segment.begin_s, next_s):
            yield segment


def _pictures(segment: _Segment, flight: PlannedFlight) -> Iterator[RecordedMessage]:
    """Yield the pictures of a flight in a segment. The rest of a damaged segment is skipped."""
    with suppress(DamagedFile, OSError):
        for message in Tail(segment.path, MAX_PICTURE_RECORD_BYTES).read():
            if (
                message.schema == "foxglove.CompressedImage"
                and flight.owns(_identity(message))
                and flight.covers(message.time_ms / 1000)
                and isinstance(message.content.get("data"), str)
                and message.content.get("format") == "jpeg"
            ):
                yield message


def _identity(message: RecordedMessage) -> str:
    """Return the identity in the owner of a picture. Recordings of earlier releases name no owner."""
    return str(message.content.get("owner", "")).partition("/")[2]
