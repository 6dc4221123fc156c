"""One segment of a recording: an MCAP file, and a tlog of MAVLink frames beside it."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from fractus_services.recording.mcap_file import McapWriter
from fractus_services.recording.messages import Record
from fractus_services.recording.segment_directory import create

_STAMP = struct.Struct(">Q")
"""Before each frame of a tlog: Unix microseconds, as ground stations write them."""


class SegmentWriter:
    """An open segment.

    Args:
        stem: its name without a suffix.
        node: the first part of every topic.
    """

    def __init__(self, stem: Path, node: str) -> None:
        self._stem = stem
        self._node = node
        self._out = create(stem.with_suffix(".mcap"))
        self._mcap = McapWriter(self._out)
        self._tlog: IO[bytes] | None = None
        self._bytes = 0

    @property
    def size_bytes(self) -> int:
        """What has been written so far; a little less than what is on the disk once it is closed."""
        return self._bytes

    def write(self, time_ns: int, frame: bytes, records: Sequence[Record]) -> None:
        """Append a frame, unless it is empty, and what was said.

        Raises:
            OSError: the disk does not take it.
        """
        if frame:
            if self._tlog is None:
                self._tlog = create(self._stem.with_suffix(".tlog"))
            self._bytes += self._tlog.write(_STAMP.pack(time_ns // 1000) + frame)
        for record in records:
            self._mcap.write(f"/{self._node}/{record.topic}", record.schema, record.time_ns, record.content)

    def flush(self) -> None:
        """Bring everything so far to the disk: what is there then can be read, whatever happens.

        Raises:
            OSError: the disk does not take it.
        """
        self._mcap.flush()
        self._bytes = self._out.tell() + (self._tlog.tell() if self._tlog is not None else 0)
        for file in filter(None, (self._out, self._tlog)):
            file.flush()
            os.fdatasync(file.fileno())

    def close(self) -> None:
        """Write the index, and close the files.

        Raises:
            OSError: the disk does not take it; the files are closed, and can be read as far as they were flushed.
        """
        try:
            self._mcap.close()
            self.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the files as they are."""
        for file in filter(None, (self._out, self._tlog)):
            # A buffer that the disk did not take is tried again here, and fails again.
            with contextlib.suppress(OSError):
                file.close()
