"""Writes the files of one recording segment: an MCAP file (mcap.dev) of JSON messages, and a tlog of MAVLink frames."""

from __future__ import annotations

import contextlib
import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from fractus_runtime.files import open_file
from mcap.records import Channel, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from fractus_services.recording.messages import SCHEMAS, Record
from fractus_services.recording.segment_directory import PART_SUFFIX, create_file

CHUNK_BYTES = 256_000
"""Size of the chunks in which messages are compressed and written, before compression."""

MAX_RECORD_BYTES = 100_000_000
"""Maximum length of an MCAP record. A larger length means that the file is damaged."""

_TLOG_TIMESTAMP = struct.Struct(">Q")
"""Unix microseconds before each frame of a tlog, as ground stations write them."""


class McapWriter:
    """Writes one MCAP file with a channel for each topic. Flushed messages stay readable if the file is never closed.

    Args:
        file: Output file. `close` does not close it.
        schemas: JSON schemas by name, in addition to `SCHEMAS`.
    """

    def __init__(self, file: IO[bytes], schemas: Mapping[str, bytes] | None = None) -> None:
        self._schemas = SCHEMAS | dict(schemas or {})
        self._writer: Any = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile="", library="fractus")
        self._schema_ids: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, schema: str, time_ns: int, content: Mapping[str, Any]) -> None:
        """Append a message. All messages of a topic have the same schema.

        Raises:
            OSError: The disk is full or failed.
        """
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schema_id(schema)
            )
            self._channels[topic] = channel
        data = json.dumps(content, separators=(",", ":")).encode()
        self._writer.add_message(channel, log_time=time_ns, data=data, publish_time=time_ns)

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Add metadata about the file."""
        self._writer.add_metadata(name, dict(content))

    def _schema_id(self, name: str) -> int:
        if name not in self._schema_ids:
            self._schema_ids[name] = self._writer.register_schema(
                name=name, encoding="jsonschema", data=self._schemas[name]
            )
        return self._schema_ids[name]

    def flush(self) -> None:
        """Write the messages so far to the file, as a chunk that is readable without the rest."""
        self._writer.flush()

    def close(self) -> None:
        """Write the index."""
        self._writer.finish()


class SegmentWriter:
    """An open segment.

    Args:
        stem: Path of the segment without suffix.
        node: Name of the node, which is the first part of each topic.
    """

    def __init__(self, stem: Path, node: str) -> None:
        self._stem = stem
        self._node = node
        self._mcap_file = create_file(stem.with_suffix(".mcap"))
        self._mcap = McapWriter(self._mcap_file)
        self._tlog: IO[bytes] | None = None
        self._size_bytes = 0

    @property
    def size_bytes(self) -> int:
        """Number of bytes written so far. The closed files are slightly larger."""
        return self._size_bytes

    def write(self, time_ns: int, frame: bytes, records: Sequence[Record]) -> None:
        """Append records, and a MAVLink frame unless it is empty.

        Raises:
            OSError: The disk is full or failed.
        """
        if frame:
            if self._tlog is None:
                self._tlog = create_file(self._stem.with_suffix(".tlog"))
            self._size_bytes += self._tlog.write(_TLOG_TIMESTAMP.pack(time_ns // 1000) + frame)
        for record in records:
            self._mcap.write(f"/{self._node}/{record.topic}", record.schema, record.time_ns, record.content)

    def flush(self) -> None:
        """Write everything so far to the disk. It stays readable after a crash or power failure.

        Raises:
            OSError: The disk is full or failed.
        """
        self._mcap.flush()
        self._size_bytes = self._mcap_file.tell() + (self._tlog.tell() if self._tlog is not None else 0)
        for file in self._files():
            file.flush()
            os.fdatasync(file.fileno())

    def close(self) -> None:
        """Write the index, and close the files.

        Raises:
            OSError: The disk is full or failed. The files are closed, and the flushed part is readable.
        """
        try:
            self._mcap.close()
            self.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the files without an index."""
        for file in self._files():
            # Closing writes the buffer again, which fails again if the disk rejected it before.
            with contextlib.suppress(OSError):
                file.close()

    def _files(self) -> list[IO[bytes]]:
        return [self._mcap_file] if self._tlog is None else [self._mcap_file, self._tlog]


def rebuild_index(path: Path) -> Iterator[None]:
    """Write the index of an MCAP file that was never closed, one message per step of the iterator.

    The file is replaced at the last step. A file that was closed, or that is removed in the meantime, is left alone.

    Raises:
        OSError: The disk is full or failed.
    """
    part = path.with_suffix(PART_SUFFIX)
    with open_file(path) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - len(MCAP0_MAGIC), 0))
        if size > len(MCAP0_MAGIC) and file.read() == MCAP0_MAGIC:
            return
        file.seek(0)
        try:
            with create_file(part) as out:
                yield from _copy_messages(file, out)
                # Sync before replacing the original, so that a power failure loses no message.
                out.flush()
                os.fsync(out.fileno())
            if os.fstat(file.fileno()).st_nlink:
                part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def _copy_messages(file: IO[bytes], out: IO[bytes]) -> Iterator[None]:
    """Copy the readable messages of an MCAP file, one per step."""
    writer: Any = Writer(out, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
    writer.start(profile="", library="fractus")
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for record in _readable_records(file):
        # The part with the index may repeat a schema or channel.
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, Message):
            writer.add_message(channels[record.channel_id], record.log_time, record.data, record.publish_time)
        yield
    writer.finish()


def _readable_records(file: IO[bytes]) -> Iterator[McapRecord]:
    """Yield the records of a file up to the point where it is truncated or damaged."""
    with contextlib.suppress(Exception):
        yield from StreamReader(file, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES).records
