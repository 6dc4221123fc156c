"""Telemetry logs as ground stations keep them: 8 bytes of time (µs, big endian) before each MAVLink frame."""

from __future__ import annotations

import struct
import threading
from pathlib import Path

from fractus_runtime.mavlink_codec import Parser

_STAMP = struct.Struct(">Q")


class TlogWriter:
    """Writes one tlog; may be shared by threads."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._lock = threading.Lock()

    def write(self, unix_us: int, frame: bytes) -> None:
        """Append one frame; nothing once the log is closed."""
        with self._lock:
            if not self._file.closed:
                self._file.write(_STAMP.pack(unix_us) + frame)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._file.close()


class Framer:
    """Cuts one direction of a link into frames and writes them to a tlog."""

    def __init__(self, log: TlogWriter) -> None:
        self._log = log
        self._parser = Parser()

    def take(self, data: bytes, unix_us: int) -> None:
        """Take bytes as they pass."""
        for message in self._parser.feed(data):
            self._log.write(unix_us, message.frame)
