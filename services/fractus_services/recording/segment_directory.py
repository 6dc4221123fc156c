"""Directory of recording segments within a size limit: the oldest segments are removed for the newest."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

DIRECTORY_MODE = 0o700
FILE_MODE = 0o600
"""Modes without access for other users of the node. Recordings disclose where the drone was, and contain images."""

RESERVE_BYTES = 200_000_000
"""Free space that recordings leave on their disk. The audit log is often on the same disk, and no drone flies without it."""

MIN_SEGMENT_BYTES = 250_000
MAX_SEGMENT_BYTES = 32_000_000
SEGMENTS_PER_LIMIT = 16
"""Number of full segments that fit within the limit. With many small segments, removing the oldest one loses little."""

PART_SUFFIX = ".part"
"""Suffix of a file that is being written."""

_NAME = re.compile(r"(?P<number>\d{6,})-\d{8}T\d{6}Z\.(mcap|tlog)")


class SegmentDirectory:
    """Directory of segments. Segments are numbered, because the clock may be set back. Files of one segment differ in suffix.

    Args:
        directory: Directory that contains nothing else and is used by no other process.
        limit_bytes: Maximum size of all segments.
        reserve_bytes: Minimum free space on the disk.
    """

    def __init__(self, directory: Path, limit_bytes: int, reserve_bytes: int = RESERVE_BYTES) -> None:
        self.directory = directory
        self._limit_bytes = limit_bytes
        self._reserve_bytes = reserve_bytes
        self._lock: int | None = None
        self.segment_bytes = min(max(limit_bytes // SEGMENTS_PER_LIMIT, MIN_SEGMENT_BYTES), MAX_SEGMENT_BYTES)

    def new_segment(self, time_ns: int) -> Path:
        """Make room for a segment, and return its path without suffix.

        Raises:
            OSError: The directory cannot be written, or the disk is full.
        """
        self.prepare()
        time_text = datetime.fromtimestamp(time_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%SZ")
        return self.directory / f"{max(self.by_number(), default=0) + 1:06d}-{time_text}"

    def prepare(self) -> None:
        """Create the directory, lock it for this process, and make room in it.

        Raises:
            OSError: The directory cannot be written, another process records into it, or the disk is full.
        """
        with contextlib.suppress(FileExistsError):
            # Set the mode of a new directory only: an existing one may have been created with another mode on purpose.
            self.directory.mkdir(DIRECTORY_MODE, parents=True)
        self._acquire_lock()
        self._make_room()
        self.check_space()

    def remove_incomplete(self) -> None:
        """Remove temporary files that a crash left.

        Raises:
            OSError: A file cannot be removed.
        """
        for path in self.directory.glob(f"*{PART_SUFFIX}"):
            if _NAME.fullmatch(path.with_suffix(".mcap").name):
                path.unlink(missing_ok=True)

    def unlock(self) -> None:
        """Unlock the directory for other processes."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def by_number(self) -> dict[int, list[Path]]:
        """Return the files of all segments by segment number, oldest first."""
        segments: dict[int, list[Path]] = {}
        for path in sorted(self.directory.glob("*")):
            match = _NAME.fullmatch(path.name)
            if match is not None:
                segments.setdefault(int(match["number"]), []).append(path)
        return dict(sorted(segments.items()))

    def check_space(self) -> None:
        """Check the free space on the disk.

        Raises:
            OSError: The disk is nearly full.
        """
        disk = os.statvfs(self.directory)
        free = disk.f_bavail * disk.f_frsize
        if free < self._reserve_bytes:
            raise OSError(errno.ENOSPC, f"only {free / 1e6:.0f} MB are free on its disk")

    def _acquire_lock(self) -> None:
        if self._lock is not None:
            return
        lock = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(lock)
            if isinstance(error, BlockingIOError):
                reason = f"another service records into {self.directory}; give each its own directory with --recordings"
                raise OSError(errno.EBUSY, reason) from None
            raise
        self._lock = lock

    def _make_room(self) -> None:
        """Remove the oldest segments until a full segment fits within the limit."""
        segments = self.by_number()
        sizes = {number: sum(path.stat().st_size for path in paths) for number, paths in segments.items()}
        surplus = sum(sizes.values()) + self.segment_bytes - self._limit_bytes
        for number, paths in segments.items():
            if surplus <= 0:
                return
            for path in paths:
                path.unlink(missing_ok=True)
            surplus -= sizes[number]


def create_file(path: Path) -> IO[bytes]:
    """Create a file that other users cannot read.

    Raises:
        OSError: The file exists, or cannot be written.
    """
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, FILE_MODE), "wb")


def segments_in(directory: Path | None, megabytes: int) -> SegmentDirectory | None:
    """Return the segment directory that the options of a service specify, or None to record nothing."""
    return SegmentDirectory(directory, megabytes * 1_000_000) if directory is not None and megabytes > 0 else None
