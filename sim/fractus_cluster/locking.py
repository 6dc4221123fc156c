"""File locks between processes. A lock is released when its process ends."""

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

    The kernel releases the lock when the process that holds it ends, even after SIGKILL.

    Args:
        path: Lock file. It is created if it is missing.
        timeout_s: Maximum time to wait for the lock.
        what: Text for messages about the current holder of the lock, such as "another process is building binaries".
        report: Called once if another process holds the lock.
        remove: Delete the file before the lock is released.

    Raises:
        ClusterError: The lock was not released before the timeout.
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
    reported = False
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            if time.monotonic() > deadline:
                raise ClusterError(f"timed out after {timeout_s:.0f} s: {what} ({path} is locked)") from None
            if not reported:
                report(f"waiting: {what}")
                reported = True
            time.sleep(_POLL_S)
            continue
        if _refers_to(path, handle):
            return handle
        os.close(handle)  # the previous holder removed the file


def _refers_to(path: Path, handle: int) -> bool:
    """Return True if a path still refers to an open file."""
    try:
        by_path = path.stat()
    except FileNotFoundError:
        return False
    by_handle = os.fstat(handle)
    return (by_path.st_dev, by_path.st_ino) == (by_handle.st_dev, by_handle.st_ino)
