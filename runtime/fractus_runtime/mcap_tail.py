"""Sequential reader of MCAP files with JSON messages, which may still be growing."""

from __future__ import annotations

import os
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

from fractus_runtime.files import open_file, parse_json, path_text

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 100_000_000
"""Maximum length of a record. A larger value means a damaged file."""

_HEAD = struct.Struct("<BQ")
_SKIPPED = 0
"""Opcode that no record has."""


class DamagedFile(ValueError):
    """The file is not an MCAP file, or its remaining part is damaged."""


@dataclass(frozen=True, slots=True)
class MessageLocation:
    """Location of a message in its file.

    Attributes:
        offset: Byte offset of the record that contains the message. The record may be a chunk of several messages.
        index: Number of records before the message in the chunk.
    """

    offset: int
    index: int


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A message with its time in Unix milliseconds."""

    topic: str
    schema: str
    time_ms: int
    content: dict[str, Any]
    location: MessageLocation


class Tail:
    """Reads the messages of one file once, in the order of writing.

    Args:
        path: MCAP file.
        max_record_bytes: Maximum size of a record, also after decompression. Larger records are skipped, to limit memory.

    Attributes:
        finished: True if the writer closed the file and all its messages were read.
    """

    def __init__(self, path: Path, max_record_bytes: int = MAX_RECORD_BYTES) -> None:
        self.path = path
        self._max_record_bytes = max_record_bytes
        self.finished = False
        self._offset = 0
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str]] = {}

    def read(self) -> Iterator[RecordedMessage]:
        """Yield the complete messages that were not read yet.

        Raises:
            DamagedFile: The rest of the file cannot be read, now or later.
            OSError: The file cannot be read.
        """
        with open_file(self.path) as file:
            while not self.finished:
                offset = self._offset
                record = _read_record(file, offset, self.path, self._max_record_bytes)
                if record is None:
                    return
                opcode, body, self._offset = record
                # After DATA_END, only the index follows.
                self.finished = opcode == Opcode.DATA_END
                yield from self._messages(opcode, body, offset)

    def _messages(self, opcode: int, body: bytes, offset: int) -> Iterator[RecordedMessage]:
        for index, record in enumerate(_parse_record(opcode, body, self.path, self._max_record_bytes)):
            if isinstance(record, Schema):
                self._schemas[record.id] = record.name
            elif isinstance(record, Channel) and record.message_encoding == "json":
                self._channels[record.id] = (record.topic, self._schemas.get(record.schema_id, ""))
            elif isinstance(record, Message) and record.channel_id in self._channels:
                topic, schema = self._channels[record.channel_id]
                content = _content(record)
                if content is not None:
                    location = MessageLocation(offset, index)
                    yield RecordedMessage(topic, schema, record.log_time // 1_000_000, content, location)


def message_at(path: Path, location: MessageLocation) -> dict[str, Any] | None:
    """Return the content of one message, or None if the location contains no complete JSON message.

    Raises:
        DamagedFile: The file is damaged at this location.
        OSError: The file cannot be read.
    """
    with open_file(path) as file:
        record = _read_record(file, location.offset, path)
    if record is None:
        return None
    opcode, body, _ = record
    records = _parse_record(opcode, body, path)
    message = records[location.index] if location.index < len(records) else None
    return _content(message) if isinstance(message, Message) else None


def _read_record(
    file: IO[bytes], offset: int, path: Path, max_bytes: int = MAX_RECORD_BYTES
) -> tuple[int, bytes, int] | None:
    """Return opcode and content of the record at an offset, and the offset of the next record.

    Return None if the record is incomplete. The content of a record above `max_bytes` is empty.
    """
    if offset == 0:
        start = file.read(len(MAGIC))
        if start != MAGIC[: len(start)]:
            raise DamagedFile(f"{path_text(path)} is not an MCAP file")
        offset = len(MAGIC)
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    opcode, length = _HEAD.unpack(head)
    if length > MAX_RECORD_BYTES:
        raise DamagedFile(f"{path_text(path)} is damaged at byte {offset}")
    next_offset = offset + _HEAD.size + length
    if length > max_bytes:
        complete = file.seek(0, os.SEEK_END) >= next_offset
        return (_SKIPPED, b"", next_offset) if complete else None
    body = file.read(length)
    return (opcode, body, next_offset) if len(body) == length else None


def _parse_record(opcode: int, body: bytes, path: Path, max_bytes: int = MAX_RECORD_BYTES) -> list[Any]:
    """Return the records of a chunk, or a single schema, channel or message. Other records have no messages."""
    stream = ReadDataStream(BytesIO(body))
    try:
        match opcode:
            case Opcode.CHUNK:
                chunk = Chunk.read(stream)
                return list(breakup_chunk(chunk, validate_crc=True)) if chunk.uncompressed_size <= max_bytes else []
            case Opcode.SCHEMA:
                return [Schema.read(stream)]
            case Opcode.CHANNEL:
                return [Channel.read(stream)]
            case Opcode.MESSAGE:
                return [Message.read(stream, len(body))]
    except Exception as error:
        # Decompression libraries raise many types of exceptions.
        raise DamagedFile(f"{path_text(path)} is damaged: {error}") from error
    return []


def _content(message: Message) -> dict[str, Any] | None:
    try:
        content = parse_json(message.data)
    except ValueError:
        return None
    return content if isinstance(content, dict) else None
