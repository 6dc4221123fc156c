"""Writes MCAP files (mcap.dev) of JSON messages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import IO, Any

from mcap.writer import CompressionType, Writer

from fractus_services.recording.messages import SCHEMAS

CHUNK_BYTES = 256_000
"""Messages are compressed and written in pieces of this size, before compression."""


class McapFile:
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
