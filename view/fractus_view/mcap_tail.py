"""Sequential reader of MCAP files with JSON messages, also while they are written."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import breakup_chunk

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 100_000_000
"""Maximum length of a record. A larger value means a damaged file."""

_HEAD = struct.Struct("<BQ")


class Damaged(ValueError):
    """The file is not an MCAP file, or is damaged from some point on."""


@dataclass(frozen=True, slots=True)
class Place:
    """Position of a message: its record in the file, and the number of earlier messages in this record."""

    offset: int
    index: int


@dataclass(frozen=True, slots=True)
class Told:
    """One message. Times are in Unix milliseconds."""

    topic: str
    schema: str
    time_ms: int
    content: dict[str, Any]
    place: Place


class Tail:
    """Reader of one file's messages in the order of writing.

    Args:
        path: the file; what was read of it is not read again.

    Attributes:
        finished: whether the file was closed, and read to its end.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.finished = False
        self._offset = 0
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str]] = {}

    def read(self) -> Iterator[Told]:
        """Yield the complete messages that were not read yet.

        Raises:
            Damaged: the file cannot be read further, now or later.
            OSError: the file cannot be read.
        """
        with self.path.open("rb") as file:
            while not self.finished:
                place = self._offset
                found = _record(file, place)
                if found is None:
                    return
                opcode, body, self._offset = found
                # Only the index follows.
                self.finished = opcode == Opcode.DATA_END
                yield from self._messages(opcode, body, place)

    def _messages(self, opcode: int, body: bytes, offset: int) -> Iterator[Told]:
        for index, record in enumerate(_inside(opcode, body, self.path)):
            if isinstance(record, Schema):
                self._schemas[record.id] = record.name
            elif isinstance(record, Channel) and record.message_encoding == "json":
                self._channels[record.id] = (record.topic, self._schemas.get(record.schema_id, ""))
            elif isinstance(record, Message) and record.channel_id in self._channels:
                topic, schema = self._channels[record.channel_id]
                content = _content(record)
                if content is not None:
                    yield Told(topic, schema, record.log_time // 1_000_000, content, Place(offset, index))


def message_at(path: Path, place: Place) -> dict[str, Any] | None:
    """Return the content of one message, or None.

    Raises:
        Damaged: the file cannot be read there.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        found = _record(file, place.offset)
    if found is None:
        return None
    records = list(_inside(found[0], found[1], path))
    record = records[place.index] if place.index < len(records) else None
    return _content(record) if isinstance(record, Message) else None


def _record(file: IO[bytes], offset: int) -> tuple[int, bytes, int] | None:
    """Return opcode and content of the record at a position, and the position of the next one; None if it is incomplete."""
    if offset == 0:
        start = file.read(len(MAGIC))
        if start != MAGIC[: len(start)]:
            raise Damaged(f"{file.name} is not an MCAP file")
        offset = len(MAGIC)
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    opcode, length = _HEAD.unpack(head)
    if length > MAX_RECORD_BYTES:
        raise Damaged(f"{file.name} is damaged at byte {offset}")
    body = file.read(length)
    return (opcode, body, offset + _HEAD.size + length) if len(body) == length else None


def _inside(opcode: int, body: bytes, path: Path) -> list[Any]:
    """Return the records inside a chunk, or the record itself; empty for records without messages."""
    stream = ReadDataStream(BytesIO(body))
    try:
        match opcode:
            case Opcode.CHUNK:
                return list(breakup_chunk(Chunk.read(stream), validate_crc=True))
            case Opcode.SCHEMA:
                return [Schema.read(stream)]
            case Opcode.CHANNEL:
                return [Channel.read(stream)]
            case Opcode.MESSAGE:
                return [Message.read(stream, len(body))]
    except Exception as error:
        # The decompression libraries raise various exceptions.
        raise Damaged(f"{path} is damaged: {error}") from error
    return []


def _content(message: Message) -> dict[str, Any] | None:
    try:
        content = json.loads(message.data)
    except ValueError:
        return None
    return content if isinstance(content, dict) else None
