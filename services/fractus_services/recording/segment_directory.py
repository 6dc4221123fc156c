"""The files of recordings in one directory, within a bound: the oldest make room for the newest."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

DIRECTORY_MODE, FILE_MODE = 0o700, 0o600
"""No other user of the node reads recordings: they tell where the drone was, and what it saw."""

RESERVE_BYTES = 200_000_000
"""Free space that recordings leave on their disk: the audit log, without which nothing flies, is often on the same."""

MIN_SEGMENT_BYTES, MAX_SEGMENT_BYTES = 250_000, 32_000_000
PARTS = 16
"""A bound holds this many segments of full size, so that little is lost when the oldest goes."""

PART_SUFFIX = ".part"
"""Of a file that is being made."""

_NAME = re.compile(r"(?P<number>\d{6,})-\d{8}T\d{6}Z\.(mcap|tlog)")


class SegmentDirectory:
    """SegmentDirectory are numbered, as a clock may be set back; the files of one have one name and several suffixes.

    Args:
        directory: where they are kept; nothing else is, and no other process keeps its own there.
        limit_bytes: what all of them may take.
        reserve_bytes: what must stay free on the disk.
    """

    def __init__(self, directory: Path, limit_bytes: int, reserve_bytes: int = RESERVE_BYTES) -> None:
        self.directory = directory
        self._limit_bytes = limit_bytes
        self._reserve_bytes = reserve_bytes
        self._lock: int | None = None
        self.segment_bytes = min(max(limit_bytes // PARTS, MIN_SEGMENT_BYTES), MAX_SEGMENT_BYTES)

    def begin(self, time_ns: int) -> Path:
        """The name of a new segment without a suffix, once there is room for it.

        Raises:
            OSError: the directory cannot be written, or the disk is full.
        """
        self.prepare()
        moment = datetime.fromtimestamp(time_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%SZ")
        return self.directory / f"{max(self.found(), default=0) + 1:06d}-{moment}"

    def prepare(self) -> None:
        """Make the directory, take it for this process, and make room in it.

        Raises:
            OSError: it cannot be written, or another process records into it, or the disk is full.
        """
        with contextlib.suppress(FileExistsError):
            # Only what is made here gets its mode: one that was there belongs to who made it.
            self.directory.mkdir(DIRECTORY_MODE, parents=True)
        self._take()
        self._make_room()
        self.check_space()

    def tidy(self) -> None:
        """Remove what a crash left half made.

        Raises:
            OSError: it cannot be removed.
        """
        for path in self.directory.glob(f"*{PART_SUFFIX}"):
            if _NAME.fullmatch(path.with_suffix(".mcap").name):
                path.unlink(missing_ok=True)

    def release(self) -> None:
        """Leave the directory to others."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def found(self) -> dict[int, list[Path]]:
        """The files of all segments by the segments' numbers, oldest first."""
        segments: dict[int, list[Path]] = {}
        for path in sorted(self.directory.glob("*")):
            match = _NAME.fullmatch(path.name)
            if match is not None:
                segments.setdefault(int(match["number"]), []).append(path)
        return dict(sorted(segments.items()))

    def check_space(self) -> None:
        """Tell a disk that is nearly full from one that is not.

        Raises:
            OSError: it is.
        """
        disk = os.statvfs(self.directory)
        free = disk.f_bavail * disk.f_frsize
        if free < self._reserve_bytes:
            raise OSError(errno.ENOSPC, f"only {free / 1e6:.0f} MB are free on its disk")

    def _take(self) -> None:
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
        """Remove the oldest segments until a whole one fits in."""
        segments = self.found()
        sizes = {number: sum(path.stat().st_size for path in paths) for number, paths in segments.items()}
        surplus = sum(sizes.values()) + self.segment_bytes - self._limit_bytes
        for number, paths in segments.items():
            if surplus <= 0:
                return
            for path in paths:
                path.unlink(missing_ok=True)
            surplus -= sizes[number]


def create(path: Path) -> IO[bytes]:
    """A new file that no other user can read.

    Raises:
        OSError: it is there already, or cannot be written.
    """
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, FILE_MODE), "wb")


def segments_in(directory: Path | None, megabytes: int) -> SegmentDirectory | None:
    """What the options of a service ask for; None: nothing is recorded."""
    return SegmentDirectory(directory, megabytes * 1_000_000) if directory is not None and megabytes > 0 else None
