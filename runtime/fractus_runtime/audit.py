"""Audit log in segments of bounded size. Each line is a JSON entry with the hash of the previous entry."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fractus_runtime.audit_chain import (
    PRUNED,
    ChainEntry,
    canonical,
    complete_length,
    digest,
    first_sequence,
    last_entry,
    segment_path,
    segments,
)
from fractus_runtime.audit_checkpoints import sign_checkpoint
from fractus_runtime.files import open_file, open_regular, remove_temporary, write_file

log = logging.getLogger(__name__)

SYNC_INTERVAL_S = 0.5
"""Maximum delay of entries that are not urgent. The delay allows one fsync for several entries."""

MAX_SEGMENT_BYTES = 16_000_000
"""Size at which a file is closed. The chain continues in the next file."""

MAX_SEGMENTS = 32
"""Number of closed segments to keep. When the oldest is removed, an entry records the removal."""

MAX_WAITING = 10_000
"""Maximum number of entries in memory while the disk cannot be written."""

CHECKPOINT_INTERVAL_S = 60.0
"""Interval between checkpoints while there are new entries."""

HANG_TIMEOUT_S = 2.0
"""Duration after which a pending write is reported as a failure, in seconds. The report ends when the write ends."""


def _finite_json(value: Any) -> Any:
    """Return a value with NaN and infinities as text, because JSON has no such numbers."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {key: _finite_json(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite_json(inner) for inner in value]
    return value


@dataclass(frozen=True, slots=True)
class _PendingEntry:
    """An entry that is not on disk yet. The sequence number and the hash are computed when the entry is written."""

    time: str
    kind: str
    content: dict[str, Any]
    boot_s: float = field(default_factory=lambda: round(time.clock_gettime(time.CLOCK_BOOTTIME), 3))


class AuditLog:
    """Appends entries to an audit log. A thread writes them, so that a slow disk never delays a flight.

    Each entry contains its time and, as `boot_s`, the seconds since the machine started, which clock steps do not change.

    While the disk is full or hangs, or another process writes the same log, entries are kept in memory. Entries above
    `MAX_WAITING` are lost, and one entry records their number.

    Args:
        path: File of the log. An existing chain is continued. If a crash left an incomplete last line, the line is removed
            before the next entry is written, and an entry records it.
        clock: Returns Unix time in seconds.
        segment_bytes: Size at which the file is closed and the next one begins.
        keep: Number of closed segments to keep.
        tls: Directory of the node's key and certificate, which sign checkpoints. None for a log without checkpoints.
        listeners: Called in order with each entry, including time and kind, before the entry is written. They must not block.
    """

    def __init__(
        self,
        path: Path,
        clock: Callable[[], float],
        *,
        segment_bytes: int = MAX_SEGMENT_BYTES,
        keep: int = MAX_SEGMENTS,
        tls: Path | None = None,
        listeners: Sequence[Callable[[dict[str, Any]], None]] = (),
    ) -> None:
        self._listeners = tuple(listeners)
        self._path = path
        self._clock = clock
        self._segment_bytes = segment_bytes
        self._keep = keep
        self._tls = tls
        self._checkpoint = path.with_suffix(".checkpoint")
        self._checkpoint_due_s = 0.0
        self._signed = ChainEntry()
        remove_temporary(self._checkpoint)
        self._pruned: list[Path] = []
        self._waiting: deque[_PendingEntry] = deque()
        self._lost = 0
        self._changed = threading.Condition()
        self._urgent = False
        self._closing = False
        self._problem = ""
        self._busy_since_s: float | None = None
        self._sound_bytes: int | None = None
        path.parent.mkdir(parents=True, exist_ok=True)
        self._lock: int | None = None
        torn = 0
        self._end = ChainEntry()
        # A path that cannot be read or written is reported when the first entry is written.
        with contextlib.suppress(OSError):
            whole, size = complete_length(path)
            torn = size - whole
            self._sound_bytes = whole if torn else None
            self._end = _end_of_chain(path)
            path.touch(0o640)  # so that verification detects a missing file
        self._thread = threading.Thread(target=self._write, name="audit", daemon=True)
        self._thread.start()
        if torn:
            self.append("recovered", {"torn_bytes": torn})

    @property
    def failure(self) -> str:
        """Reason why entries do not reach the disk, or an empty string."""
        since_s = self._busy_since_s
        if since_s is not None and time.monotonic() - since_s > HANG_TIMEOUT_S:
            return f"the audit log cannot be written: no response of the disk for {time.monotonic() - since_s:.0f} s"
        return self._problem

    @property
    def head(self) -> ChainEntry:
        """Sequence number and hash of the last entry on disk."""
        return self._end

    @property
    def waiting(self) -> int:
        """Number of entries that are not on disk yet."""
        return len(self._waiting)

    def append(self, kind: str, content: dict[str, Any], now: bool = True) -> None:
        """Add an entry.

        Args:
            kind: Kind of the entry: call, takeover, control, grant, state, ...
            content: JSON values.
            now: True to write the entry to disk at once, False to wait for further entries.

        Raises:
            TypeError: The content contains values that JSON does not have.
        """
        entry = _PendingEntry(self._timestamp(), kind, _finite_json(content))
        # Raises in the caller instead of the thread if the content is not JSON.
        canonical(entry.content)
        for listener in self._listeners:
            listener({"time": entry.time, "kind": kind, **entry.content})
        with self._changed:
            if len(self._waiting) >= MAX_WAITING:
                self._lost += 1
                return
            self._waiting.append(entry)
            self._urgent = self._urgent or now
            self._changed.notify()

    def refused_grant(self, name: str, reason: str) -> None:
        """Record that a Grant file was rejected."""
        self.append("grant", {"change": "refused", "name": name, "reason": reason})

    def clock_stepped(self, step_s: float, trusted: bool) -> None:
        """Record a step of the clock that gives entries their time."""
        self.append("clock", {"step_s": round(step_s, 3), "trusted": trusted})

    async def close(self) -> None:
        """Write the remaining entries and stop the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        await asyncio.to_thread(self._thread.join, 5.0)

    def _write(self) -> None:
        """Run the thread: write until closed, then release the lock."""
        try:
            self._write_batches()
        finally:
            if self._lock is not None:
                os.close(self._lock)

    def _write_batches(self) -> None:
        """Append entries in batches with one fsync each."""
        while True:
            with self._changed:
                if self._changed.wait_for(lambda: self._waiting or self._closing, self._until_checkpoint_s()):
                    self._changed.wait_for(
                        lambda: self._closing or (self._urgent and not self._problem), SYNC_INTERVAL_S
                    )
                batch = tuple(self._waiting)
                closing = self._closing
                self._urgent = False
            written = not batch or self._flush(batch)
            if written and batch:
                self._dequeue(len(batch))
                self._tidy()
            with self._changed:
                ended = closing and (not written or not self._waiting)
            if written:
                self._write_checkpoint(ended)
            if ended:
                return

    def _dequeue(self, written: int) -> None:
        """Remove written entries from the queue. If entries were lost while the queue was full, record their number."""
        with self._changed:
            for _ in range(written):
                self._waiting.popleft()
            if self._lost:
                self._waiting.append(_PendingEntry(self._timestamp(), "lost", {"entries": self._lost}))
                self._lost = 0
                self._urgent = True

    def _flush(self, batch: Iterable[_PendingEntry]) -> bool:
        """Append entries and sync the file. Return False on failure; the entries then stay in the queue for the next attempt."""
        self._busy_since_s = time.monotonic()
        try:
            if self._lock is None:
                self._lock, self._sound_bytes, self._end = _acquire(self._path)
            data, end = _chained(batch, self._end)
            self._store(data)
        except OSError as error:
            if not self._problem:
                log.critical("audit: cannot write entries (file=%s error=%s)", self._path, error)
            self._problem = f"the audit log cannot be written: {error.strerror or error}"
            return False
        finally:
            self._busy_since_s = None
        self._problem = ""
        self._end = end
        return True

    def _tidy(self) -> None:
        """Close a full file. Remove the oldest segments if the entry that records their removal is on disk."""
        self._busy_since_s = time.monotonic()
        try:
            while self._pruned:
                self._pruned[0].unlink(missing_ok=True)
                del self._pruned[0]
            if self._path.stat().st_size >= self._segment_bytes:
                self._path.rename(segment_path(self._path, _first_entry(self._path)))
                self._path.touch(0o640)
                self._record_pruning()
        except (OSError, ValueError) as error:
            log.warning("audit: cannot close a segment (file=%s error=%s)", self._path, error)
        finally:
            self._busy_since_s = None

    def _until_checkpoint_s(self) -> float | None:
        """Return the seconds until the next checkpoint, or None if there is no key or no new entry."""
        if self._tls is None or self._end in (ChainEntry(), self._signed):
            return None
        due_s = self._checkpoint_due_s
        return max(due_s - time.monotonic(), 0.0) if due_s else CHECKPOINT_INTERVAL_S

    def _write_checkpoint(self, at_once: bool) -> None:
        """Write a signed checkpoint of the last entry on disk if one is due."""
        if self._tls is None or self._end in (ChainEntry(), self._signed):
            return
        if not at_once and time.monotonic() < self._checkpoint_due_s:
            return
        self._checkpoint_due_s = time.monotonic() + CHECKPOINT_INTERVAL_S
        self._busy_since_s = time.monotonic()
        try:
            content = sign_checkpoint(self._path.stem, self._end, self._timestamp(), self._tls)
            write_file(self._checkpoint, content, 0o640, durable=False)
            self._signed = self._end
        except FileNotFoundError:
            self._checkpoint_due_s = 0.0  # the node has no certificate yet
        except (OSError, ValueError, TypeError) as error:
            log.warning("audit: cannot write a checkpoint (file=%s error=%s)", self._checkpoint, error)
        finally:
            self._busy_since_s = None

    def _record_pruning(self) -> None:
        closed = segments(self._path)
        surplus = closed[: max(len(closed) - self._keep, 0)]
        if not surplus:
            return
        end = last_entry(surplus[-1])
        if end is None:
            return
        content = {"first": first_sequence(surplus[0]), "last": end.sequence, "last_hash": end.hash}
        with self._changed:
            self._waiting.append(_PendingEntry(self._timestamp(), PRUNED, content))
            self._urgent = True
        self._pruned = list(surplus)

    def _timestamp(self) -> str:
        return datetime.fromtimestamp(self._clock(), UTC).isoformat(timespec="milliseconds")

    def _store(self, data: bytes) -> None:
        """Append bytes and wait until they are on disk. On failure, restore the file, because half an entry breaks the chain.

        Bytes that an earlier failure or a crash left are removed first.
        """
        file = open_regular(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o640)
        try:
            if self._sound_bytes is not None and os.fstat(file).st_size > self._sound_bytes:
                os.ftruncate(file, self._sound_bytes)
            self._sound_bytes = size = os.fstat(file).st_size
            try:
                rest = memoryview(data)
                while rest:
                    rest = rest[os.write(file, rest) :]
                os.fsync(file)
            except OSError:
                os.ftruncate(file, size)
                raise
            self._sound_bytes = None
        finally:
            os.close(file)


def _end_of_chain(log_file: Path) -> ChainEntry:
    """Return the last entry of the chain on disk."""
    for path in (log_file, *reversed(segments(log_file))):
        try:
            end = last_entry(path)
        except ValueError:
            log.critical("audit: cannot read the last entry, starting a new chain (file=%s)", path)
            return ChainEntry()
        if end is not None:
            return end
    return ChainEntry()


def _first_entry(path: Path) -> int:
    """Return the sequence number of the first entry of a file."""
    with open_file(path) as file:
        return int(json.loads(file.readline())["seq"])


def _acquire(path: Path) -> tuple[int, int | None, ChainEntry]:
    """Lock a log for this process as its only writer.

    Returns:
        The lock, the length of the complete lines if the last line is incomplete, and the last entry.

    Raises:
        OSError: Another process writes the log, or the lock cannot be created.
    """
    lock = _locked(path.with_name(f".{path.stem}.lock"))
    try:
        whole, size = complete_length(path)
        return lock, whole if size > whole else None, _end_of_chain(path)
    except OSError:
        os.close(lock)
        raise


def _locked(path: Path) -> int:
    """Lock a file and return its descriptor. The lock ends with the process.

    Raises:
        OSError: Another process holds the lock, or the file cannot be created.
    """
    lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        locked_by_other = isinstance(error, BlockingIOError)
        raise OSError(error.errno, "another process writes this log") if locked_by_other else error from None
    return lock


def _chained(batch: Iterable[_PendingEntry], end: ChainEntry) -> tuple[bytes, ChainEntry]:
    """Return entries as lines that continue the chain, and the new last entry."""
    lines = []
    for pending in batch:
        sequence = end.sequence + 1
        header = {"time": pending.time, "boot_s": pending.boot_s, "kind": pending.kind}
        entry = {"seq": sequence, **header, **pending.content, "prev": end.hash}
        entry["hash"] = digest(entry)
        end = ChainEntry(sequence, entry["hash"])
        lines.append(canonical(entry) + b"\n")
    return b"".join(lines), end
