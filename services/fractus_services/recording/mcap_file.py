"""Writes MCAP files (mcap.dev) of JSON messages."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from mcap.records import Channel, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from fractus_services.recording.messages import SCHEMAS
from fractus_services.recording.segment_directory import PART_SUFFIX, create

CHUNK_BYTES = 256_000
"""Messages are compressed and written in pieces of this size, before compression."""

MAX_RECORD_BYTES = 100_000_000
"""No record of ours is longer: a length beyond that is damage."""


class McapWriter:
    """One MCAP file, with a channel for each topic. What was flushed stays readable if the rest is never written.

    Args:
        file: where it goes; `close` does not close it.
        schemas: JSON schemas by name, besides those of `messages`.
    """

    def __init__(self, file: IO[bytes], schemas: Mapping[str, bytes] | None = None) -> None:
        self._schemas = SCHEMAS | dict(schemas or {})
        self._writer: Any = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile="", library="fractus")
        self._registered: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, schema: str, time_ns: int, content: Mapping[str, Any]) -> None:
        """Append one message; each topic has one schema.

        Raises:
            OSError: the disk does not take it.
        """
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schema(schema)
            )
        data = json.dumps(content, separators=(",", ":")).encode()
        self._writer.add_message(channel, log_time=time_ns, data=data, publish_time=time_ns)

    def describe(self, name: str, content: Mapping[str, str]) -> None:
        """Add metadata on the whole file."""
        self._writer.add_metadata(name, dict(content))

    def _schema(self, name: str) -> int:
        if name not in self._registered:
            self._registered[name] = self._writer.register_schema(
                name=name, encoding="jsonschema", data=self._schemas[name]
            )
        return self._registered[name]

    def flush(self) -> None:
        """Hand everything so far to the file, as a chunk that can be read by itself."""
        self._writer.flush()

    def close(self) -> None:
        """Write the index."""
        self._writer.finish()


def completed(path: Path) -> Iterator[None]:
    """Write the index of a file that was never closed, as far as it can be read, a message at each step.

    The file is as it was until the last step; one that was closed is left alone, and so is one that is removed meanwhile.

    Raises:
        OSError: the disk does not take it.
    """
    part = path.with_suffix(PART_SUFFIX)
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - len(MCAP0_MAGIC), 0))
        if size > len(MCAP0_MAGIC) and file.read() == MCAP0_MAGIC:
            return
        file.seek(0)
        try:
            with create(part) as out:
                yield from _copied(file, out)
                # What was on the disk before must not be lost with the power for the sake of an index.
                out.flush()
                os.fsync(out.fileno())
            if os.fstat(file.fileno()).st_nlink:
                part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def _copied(file: IO[bytes], out: IO[bytes]) -> Iterator[None]:
    writer: Any = Writer(out, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
    writer.start(profile="", library="fractus")
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for record in _readable(file):
        # A schema or channel may be there again in the part that holds the index.
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


def _readable(file: IO[bytes]) -> Iterator[McapRecord]:
    """The records up to where the file breaks off, whatever it breaks off in."""
    with contextlib.suppress(Exception):
        yield from StreamReader(file, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES).records
