"""Exclusive lock of a service: the kernel releases it when its process ends for any reason."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from fractus_runtime.files import parse_json

from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

DEFAULT_LOCK_TIMEOUT_S = 60.0
"""Default time to wait for the lock. It exceeds the 40 s after which Kubernetes kills the processes of a deleted pod."""

CHECK_INTERVAL_S = 0.2
"""Interval at which the holder checks that its lock file still exists under its path."""

NEW_FILE_WAIT_S = 1.0
"""Time for which a process waits after it has locked a new lock file.

If the file replaced another lock file, the process that locked the other file ends itself within this time.
"""

POLL_INTERVAL_S = 0.1

_GONE = {errno.ENOENT, errno.ENOTDIR, errno.ESTALE}


class ServiceLock:
    """Exclusive access to the state, the audit log, and the autopilot or camera of a service.

    The lock is held until the process ends, because its threads may write until then. The lock also protects against a
    pod that was force-deleted while its process still runs: the new pod waits until the old process has ended.

    Args:
        service: Name of the service, for the log and the lock file.
        state: State directory, which contains the first lock file. If that file is replaced or removed, another process could
            lock the new file, so the holder ends immediately without another write.
        audit: Audit log. The second lock file is next to it, because two state directories could share an audit log.
        end: Ends the process.
    """

    def __init__(self, service: str, state: Path, audit: Path, end: Callable[[int], object] = os._exit) -> None:
        self._service = service
        self._path = state / f"{service}.lock"
        self._audit = audit.with_name(f"{audit.name}.lock")
        self._end = end
        self._held = (0, 0)
        self._left = threading.Event()

    async def acquire(self, timeout_s: float, stop: asyncio.Event) -> bool:
        """Wait for the lock. Return False if `stop` is set first.

        Raises:
            CannotServe: Another process holds the lock after the timeout, or the disk does not support locks.
        """
        deadline = time.monotonic() + timeout_s
        for path in (self._path, self._audit):
            try:
                handle = await self._lock(path, deadline, stop)
            except OSError as error:
                reason = error.strerror or error
                raise CannotServe(
                    f"{path}: cannot lock: {reason}; use a writable disk that supports locks for --state and --audit"
                ) from None
            if handle is None:
                return False
            if path == self._path:
                self._held = _identity(os.fstat(handle))
                if _read_holder(handle).get("file") != list(self._held):
                    await _pause(stop, NEW_FILE_WAIT_S)
            self._sign(handle)
        return not stop.is_set()

    async def _lock(self, path: Path, deadline: float, stop: asyncio.Event) -> int | None:
        path.parent.mkdir(parents=True, exist_ok=True)
        waits = False
        while not stop.is_set():
            handle = _open(path)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = _format_holder(_read_holder(handle))
                os.close(handle)
                if time.monotonic() >= deadline:
                    raise CannotServe(f"{path} is still held by {holder}; end that process, and restart") from None
                if not waits:
                    log.warning("%s: waiting for %s, held by %s", self._service, path, holder)
                    waits = True
                await _pause(stop, POLL_INTERVAL_S)
                continue
            except OSError:
                os.close(handle)
                raise
            if _is_still(path, _identity(os.fstat(handle))):
                if waits:
                    log.info("%s: lock acquired (file=%s)", self._service, path)
                return handle
            os.close(handle)  # The file was replaced while this process waited.
        return None

    def _sign(self, handle: int) -> None:
        """Write the holder to the lock file for log messages. A full disk is ignored."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        holder = {"pid": os.getpid(), "host": socket.gethostname(), "since": now, "file": _identity(os.fstat(handle))}
        with suppress(OSError):
            os.ftruncate(handle, 0)
            os.pwrite(handle, json.dumps(holder).encode() + b"\n", 0)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """While the block runs, end the process as soon as its lock file is replaced or removed."""
        # Use a thread, because the event loop or the disk may hang.
        thread = threading.Thread(target=self._watch, name="lock", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._left.set()

    def _watch(self) -> None:
        while not self._left.wait(CHECK_INTERVAL_S):
            if not _is_still(self._path, self._held):
                log.critical(
                    "%s: lock lost because its file was replaced or its directory removed; another process may serve, so"
                    " this one ends now (file=%s)", self._service, self._path,
                )  # fmt: skip
                # Do not raise: cleanup would write the journal and the audit log, which another process may own now.
                self._end(1)
                return


def _open(path: Path) -> int:
    flags = os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | flags, 0o600)
    except OSError as error:
        if error.errno != errno.EROFS:
            raise
        # A disk that failed in flight is read-only. The restarted service must still fly the drone home.
        return os.open(path, os.O_RDONLY | flags)


def _identity(stat: os.stat_result) -> tuple[int, int]:
    return stat.st_dev, stat.st_ino


def _is_still(path: Path, identity: tuple[int, int]) -> bool:
    """Return False if the path no longer refers to the file. A disk error counts as True, because it must not end a flight."""
    try:
        return _identity(path.stat(follow_symlinks=False)) == identity
    except OSError as error:
        return error.errno not in _GONE


def _read_holder(handle: int) -> dict[str, object]:
    """Read the holder from a lock file. The result is empty if the holder could not write it."""
    with suppress(OSError, ValueError):
        holder = parse_json(os.pread(handle, 4096, 0))
        if isinstance(holder, dict):
            return holder
    return {}


def _format_holder(holder: dict[str, object]) -> str:
    if "pid" not in holder:
        return "an unknown process"
    return f"pid {holder['pid']} on {holder.get('host')} since {holder.get('since')}"


async def _pause(stop: asyncio.Event, seconds: float) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await stop.wait()
