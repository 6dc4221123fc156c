"""Telemetry logs (tlog): MAVLink frames, each after 8 bytes of Unix microseconds (big endian)."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from pathlib import Path

from fractus_runtime.mavlink_codec import Parser, frame_length

_STAMP = struct.Struct(">Q")
_MIN_HEADER_LENGTH = 3
"""Number of bytes at the start of a frame that determine its length."""


class TlogWriter:
    """Writer of one tlog, safe for use by several threads."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._lock = threading.Lock()

    def write(self, unix_us: int, frame: bytes) -> None:
        """Append one frame. Frames after `close` are ignored."""
        with self._lock:
            if not self._file.closed:
                self._file.write(_STAMP.pack(unix_us) + frame)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._file.close()


class Framer:
    """Writes the frames of one direction of a link to a tlog."""

    def __init__(self, log: TlogWriter) -> None:
        self._log = log
        self._parser = Parser()

    def feed(self, data: bytes, unix_us: int) -> None:
        """Parse received or sent bytes, and write the complete frames."""
        for message in self._parser.feed(data):
            self._log.write(unix_us, message.frame)


def read_tlog(data: bytes) -> Iterator[tuple[float, bytes]]:
    """Yield the records of a tlog: Unix time in seconds, and the MAVLink frame.

    An incomplete record at the end is ignored. It remains after a crash of the writer.
    """
    position = 0
    while position + _STAMP.size + _MIN_HEADER_LENGTH <= len(data):
        start = position + _STAMP.size
        end = start + frame_length(data, start)
        if end > len(data):
            return
        yield _STAMP.unpack_from(data, position)[0] / 1e6, data[start:end]
        position = end
