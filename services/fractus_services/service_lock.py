"""One process at a time for each service of a node: a lock that the kernel frees when its holder dies, however it dies."""

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

from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

DEFAULT_LOCK_TIMEOUT_S = 60.0
"""Longer than the 30 s after which Kubernetes kills what a pod left running."""

CHECK_INTERVAL_S = 0.2
"""How often the holder looks whether its lock file is still the one that others would lock."""

SETTLE_S = 1.0
"""How long the first holder of a new lock file waits: a holder of the file that was there before has noticed by then."""

POLL_INTERVAL_S = 0.1

_GONE = {errno.ENOENT, errno.ENOTDIR, errno.ESTALE}


class ServiceLock:
    """The right to write the state and the audit log of a service, and to speak to its autopilot or camera.

    It is never given back: the files stay locked until the process has ended, as its threads may write until then.

    Args:
        service: its name, for the log and the lock file.
        state: its state directory, which has the first lock. Where that file is replaced or vanishes, another process can
            lock what is there now: the holder ends at once, without another write.
        audit: its audit log, which has the second lock, as two state directories could share it.
        end: ends the process.
    """

    def __init__(self, service: str, state: Path, audit: Path, end: Callable[[int], object] = os._exit) -> None:
        self._service = service
        self._path = state / f"{service}.lock"
        self._audit = audit.with_name(f"{audit.name}.lock")
        self._end = end
        self._held = (0, 0)
        self._left = threading.Event()

    async def acquire(self, timeout_s: float, stop: asyncio.Event) -> bool:
        """Wait until no other process holds the lock; False when `stop` was set first.

        Raises:
            CannotServe: another process holds it still after the timeout, or there can be no lock.
        """
        deadline = time.monotonic() + timeout_s
        for path in (self._path, self._audit):
            try:
                handle = await self._lock(path, deadline, stop)
            except OSError as error:
                reason = error.strerror or error
                raise CannotServe(
                    f"{path}: cannot be locked: {reason}; give --state and --audit on a disk that is writable and has locks"
                ) from None
            if handle is None:
                return False
            if path == self._path:
                self._held = _identity(os.fstat(handle))
                if _holder(handle).get("file") != list(self._held):
                    await _pause(stop, SETTLE_S)
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
                holder = _told(_holder(handle))
                os.close(handle)
                if time.monotonic() >= deadline:
                    raise CannotServe(f"{path} is still held by {holder}; end that process, and start again") from None
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
                    log.info("%s: no other process runs any more, going on (file=%s)", self._service, path)
                return handle
            os.close(handle)  # it was replaced while we waited
        return None

    def _sign(self, handle: int) -> None:
        """Say in the file who holds it; that is for readers of logs, and a full disk does not matter."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        said = {"pid": os.getpid(), "host": socket.gethostname(), "since": now, "file": _identity(os.fstat(handle))}
        with suppress(OSError):
            os.ftruncate(handle, 0)
            os.pwrite(handle, json.dumps(said).encode() + b"\n", 0)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """End the process as soon as its lock file is no longer the one that others would lock, while in the block."""
        # A thread of its own, as the event loop may hang, and so may a disk.
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
                    "%s: another process may serve by now, as the lock file was replaced or its directory is gone; this"
                    " one ends at once (file=%s)", self._service, self._path,
                )  # fmt: skip
                # Not by an exception: on the way out journal and audit log would be written, which may be the other's.
                self._end(1)
                return


def _open(path: Path) -> int:
    flags = os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | flags, 0o600)
    except OSError as error:
        if error.errno != errno.EROFS:
            raise
        # A disk that failed in flight is read-only from then on: a service that comes back still brings the drone home.
        return os.open(path, os.O_RDONLY | flags)


def _identity(found: os.stat_result) -> tuple[int, int]:
    return found.st_dev, found.st_ino


def _is_still(path: Path, identity: tuple[int, int]) -> bool:
    """Whether a path leads to a file; an error of the disk tells nothing, and ends no flight."""
    try:
        return _identity(path.stat(follow_symlinks=False)) == identity
    except OSError as error:
        return error.errno not in _GONE


def _holder(handle: int) -> dict[str, object]:
    """What the holder of a lock file says of itself; nothing where it could not."""
    with suppress(OSError, ValueError):
        said = json.loads(os.pread(handle, 4096, 0))
        if isinstance(said, dict):
            return said
    return {}


def _told(holder: dict[str, object]) -> str:
    if "pid" not in holder:
        return "a process that did not say which"
    return f"pid {holder['pid']} on {holder.get('host')} since {holder.get('since')}"


async def _pause(stop: asyncio.Event, seconds: float) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await stop.wait()
