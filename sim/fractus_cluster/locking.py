"""Locks between processes: a file that one process holds at a time, freed when that process ends."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fractus_cluster.errors import ClusterError

_POLL_S = 0.1


def _silent(_message: str) -> None:
    return


@contextmanager
def locked(
    path: Path,
    *,
    timeout_s: float,
    what: str,
    report: Callable[[str], None] = _silent,
    remove: bool = False,
) -> Iterator[None]:
    """Hold the lock file `path` inside the block.

    The lock belongs to the open file, so it is free again as soon as its holder ends, even by kill -9.

    Args:
        path: The lock file; created when missing.
        timeout_s: How long to wait for the present holder.
        what: What the holder does, for messages ("another process is building binaries").
        report: Told once when the lock is held by another process.
        remove: Delete the file before the lock is given up.

    Raises:
        ClusterError: The lock did not become free in time.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = _acquire(path, timeout_s=timeout_s, what=what, report=report)
    try:
        yield
    finally:
        if remove:
            path.unlink(missing_ok=True)
        os.close(handle)


def _acquire(path: Path, *, timeout_s: float, what: str, report: Callable[[str], None]) -> int:
    deadline = time.monotonic() + timeout_s
    told = False
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            if time.monotonic() > deadline:
                raise ClusterError(f"gave up after {timeout_s:.0f} s: {what} ({path} is held)") from None
            if not told:
                report(f"waiting: {what}")
                told = True
            time.sleep(_POLL_S)
            continue
        if _is_still(path, handle):
            return handle
        os.close(handle)  # its last holder removed the file while we waited


def _is_still(path: Path, handle: int) -> bool:
    try:
        there = path.stat()
    except FileNotFoundError:
        return False
    ours = os.fstat(handle)
    return (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)
