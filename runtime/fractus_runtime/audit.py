"""The audit log: one JSON object a line, each carrying the hash of the one before it, in segments of bounded size."""

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
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fractus_runtime.audit_chain import PRUNED, Link, canonical, digest, first_of, last_link, segment, segments
from fractus_runtime.audit_checkpoints import signed
from fractus_runtime.files import remove_temporary, write_file

log = logging.getLogger(__name__)

SYNC_INTERVAL_S = 0.5
"""Entries that record no decision wait this long for others, so that one fsync serves them all."""

MAX_SEGMENT_BYTES = 16_000_000
"""A file of this size is closed, and the chain continues in the next one."""

MAX_SEGMENTS = 32
"""Closed files that are kept; then the oldest is removed, and an entry records that."""

MAX_WAITING = 10_000
"""Entries that wait in memory while the disk does not take them."""

CHECKPOINT_INTERVAL_S = 60.0
"""How often a checkpoint is written while there are new entries."""

HANG_TIMEOUT_S = 2.0
"""A write that takes longer counts as failed until it returns."""


def _plain(value: Any) -> Any:
    """JSON without NaN and infinities: they become text."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value


@dataclass(frozen=True, slots=True)
class _Waiting:
    """An entry that is not on disk yet; it gets its place in the chain when it is written."""

    time: str
    kind: str
    content: dict[str, Any]
    boot_s: float = field(default_factory=lambda: round(time.clock_gettime(time.CLOCK_BOOTTIME), 3))


class AuditLog:
    """Appends entries; a thread writes them, so that a slow disk never delays a flight.

    Each has its time, and with `boot_s` the seconds since the machine started, which no step of its clock moves.

    While the disk is full or does not answer, or another process writes the same log, entries wait; those beyond `MAX_WAITING` are lost, and one entry in their
    place records how many.

    Args:
        path: the file; a chain that it holds is continued, a last line that a crash left incomplete is cut off before the
            next entry is written, and recorded.
        clock: Unix time in seconds.
        segment_bytes: when the file is closed and the next one begun.
        keep: how many closed files are kept.
        tls: directory of the node's key and certificate, which checkpoints are signed with.
        copied: takes each entry as it is, with time and kind, before it is in the chain; must return at once.
    """

    def __init__(
        self,
        path: Path,
        clock: Callable[[], float],
        *,
        segment_bytes: int = MAX_SEGMENT_BYTES,
        keep: int = MAX_SEGMENTS,
        tls: Path | None = None,
        copied: Callable[[dict[str, Any]], None] = lambda _entry: None,
    ) -> None:
        self._copied = copied
        self._path = path
        self._clock = clock
        self._segment_bytes = segment_bytes
        self._keep = keep
        self._tls = tls
        self._checkpoint = path.with_suffix(".checkpoint")
        self._checkpoint_due_s = 0.0
        self._signed = Link()
        remove_temporary(self._checkpoint)
        self._pruned: list[Path] = []
        self._waiting: deque[_Waiting] = deque()
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
        with contextlib.suppress(OSError):  # a disk that is read-only is told of when the first entry is written
            whole, size = _whole_lines(path)
            torn = size - whole
            self._sound_bytes = whole if torn else None
            path.touch(0o640)  # so that verification can tell when it is missing
        self._end = _end_of_chain(path)
        self._thread = threading.Thread(target=self._write, name="audit", daemon=True)
        self._thread.start()
        if torn:
            self.append("recovered", {"torn_bytes": torn})

    @property
    def failure(self) -> str:
        """Why entries do not reach the disk; empty while they do."""
        since_s = self._busy_since_s
        if since_s is not None and time.monotonic() - since_s > HANG_TIMEOUT_S:
            return f"the audit log cannot be written: the disk has not answered for {time.monotonic() - since_s:.0f} s"
        return self._problem

    @property
    def head(self) -> Link:
        """Number and hash of the last entry on disk."""
        return self._end

    @property
    def waiting(self) -> int:
        """Entries that are not on disk yet."""
        return len(self._waiting)

    def append(self, kind: str, content: dict[str, Any], now: bool = True) -> None:
        """Add an entry.

        Args:
            kind: call, takeover, control, grant, state, ...
            content: JSON values.
            now: whether it must reach the disk at once.
        """
        entry = _Waiting(self._moment(), kind, _plain(content))
        # Content that is not JSON fails here, in the caller, and not in the thread.
        canonical(entry.content)
        self._copied({"time": entry.time, "kind": kind, **entry.content})
        with self._changed:
            if len(self._waiting) >= MAX_WAITING:
                self._lost += 1
                return
            self._waiting.append(entry)
            self._urgent = self._urgent or now
            self._changed.notify()

    def refused_grant(self, name: str, reason: str) -> None:
        """Record that a grant file grants nothing."""
        self.append("grant", {"change": "refused", "name": name, "reason": reason})

    def clock_stepped(self, step_s: float, trusted: bool) -> None:
        """Record a step of the clock, from which entries have their times."""
        self.append("clock", {"step_s": round(step_s, 3), "trusted": trusted})

    async def close(self) -> None:
        """Write what is left."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        await asyncio.to_thread(self._thread.join, 5.0)

    def _write(self) -> None:
        """The thread: write until closed; then another process may."""
        try:
            self._write_batches()
        finally:
            if self._lock is not None:
                os.close(self._lock)

    def _write_batches(self) -> None:
        """Append in batches, one fsync for each."""
        while True:
            with self._changed:
                if self._changed.wait_for(lambda: self._waiting or self._closing, self._until_checkpoint_s()):
                    self._changed.wait_for(
                        lambda: self._closing or (self._urgent and not self._problem), SYNC_INTERVAL_S
                    )
                batch, self._urgent, closing = tuple(self._waiting), False, self._closing
            written = not batch or self._flush(batch)
            if written and batch:
                self._take_off(len(batch))
                self._tidy()
            with self._changed:
                ended = closing and (not written or not self._waiting)
            if written:
                self._write_checkpoint(ended)
            if ended:
                return

    def _take_off(self, written: int) -> None:
        """Remove what is on disk from the queue, and record what was lost while it was full."""
        with self._changed:
            for _ in range(written):
                self._waiting.popleft()
            if self._lost:
                self._waiting.append(_Waiting(self._moment(), "lost", {"entries": self._lost}))
                self._lost, self._urgent = 0, True

    def _flush(self, batch: Iterable[_Waiting]) -> bool:
        """Append and sync; what could not be written is tried again with the next batch."""
        self._busy_since_s = time.monotonic()
        try:
            if self._lock is None:
                self._lock, self._sound_bytes, self._end = _taken_over(self._path)
            data, end = _chained(batch, self._end)
            self._store(data)
        except OSError as error:
            if not self._problem:
                log.critical("audit: cannot be written (file=%s): %s", self._path, error)
            self._problem = f"the audit log cannot be written: {error.strerror or error}"
            return False
        finally:
            self._busy_since_s = None
        self._problem = ""
        self._end = end
        return True

    def _tidy(self) -> None:
        """Close a full file, and remove the oldest closed ones once the entry that records it is on disk."""
        self._busy_since_s = time.monotonic()
        try:
            while self._pruned:
                self._pruned[0].unlink(missing_ok=True)
                del self._pruned[0]
            if self._path.stat().st_size >= self._segment_bytes:
                self._path.rename(segment(self._path, _first_entry(self._path)))
                self._path.touch(0o640)
                self._record_pruning()
        except (OSError, ValueError) as error:
            log.warning("audit: cannot close a segment (file=%s): %s", self._path, error)
        finally:
            self._busy_since_s = None

    def _until_checkpoint_s(self) -> float | None:
        """How long to wait for an entry before those on disk are signed; None when they are, or nothing can sign them."""
        if self._tls is None or self._end in (Link(), self._signed):
            return None
        due_s = self._checkpoint_due_s
        return max(due_s - time.monotonic(), 0.0) if due_s else CHECKPOINT_INTERVAL_S

    def _write_checkpoint(self, at_once: bool) -> None:
        """Sign how far the log has come, now and then."""
        if self._tls is None or self._end in (Link(), self._signed):
            return
        if not at_once and time.monotonic() < self._checkpoint_due_s:
            return
        self._checkpoint_due_s = time.monotonic() + CHECKPOINT_INTERVAL_S
        self._busy_since_s = time.monotonic()
        try:
            content = signed(self._path.stem, self._end, self._moment(), self._tls)
            write_file(self._checkpoint, content, 0o640, durable=False)
            self._signed = self._end
        except FileNotFoundError:
            self._checkpoint_due_s = 0.0  # the node has no certificate yet
        except (OSError, ValueError, TypeError) as error:
            log.warning("audit: cannot write a checkpoint (file=%s): %s", self._checkpoint, error)
        finally:
            self._busy_since_s = None

    def _record_pruning(self) -> None:
        closed = segments(self._path)
        surplus = closed[: max(len(closed) - self._keep, 0)]
        if not surplus:
            return
        end = last_link(surplus[-1])
        if end is None:
            return
        content = {"first": first_of(surplus[0]), "last": end.sequence, "last_hash": end.hash}
        with self._changed:
            self._waiting.append(_Waiting(self._moment(), PRUNED, content))
            self._urgent = True
        self._pruned = list(surplus)

    def _moment(self) -> str:
        return datetime.fromtimestamp(self._clock(), UTC).isoformat(timespec="milliseconds")

    def _store(self, data: bytes) -> None:
        """Append bytes and wait until they are on disk, or leave the file as it was: half an entry would break the chain.

        What a failed attempt, or a crash, left and could not cut off is cut off before the next.
        """
        file = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o640)
        try:
            if self._sound_bytes is not None and os.fstat(file).st_size > self._sound_bytes:
                os.ftruncate(file, self._sound_bytes)
            self._sound_bytes = size = os.fstat(file).st_size
            try:
                left = memoryview(data)
                while left:
                    left = left[os.write(file, left) :]
                os.fsync(file)
            except OSError:
                os.ftruncate(file, size)
                raise
            self._sound_bytes = None
        finally:
            os.close(file)


def _end_of_chain(log_file: Path) -> Link:
    """Where the chain on disk ends."""
    for path in (log_file, *reversed(segments(log_file))):
        try:
            end = last_link(path)
        except ValueError:
            log.critical("audit: the last entry cannot be read, a new chain begins after it (file=%s)", path)
            return Link()
        if end is not None:
            return end
    return Link()


def _first_entry(path: Path) -> int:
    """The number of the first entry in a file."""
    with path.open("rb") as file:
        return int(json.loads(file.readline())["seq"])


def _taken_over(path: Path) -> tuple[int, int | None, Link]:
    """Become a log's one writer: the lock, how much of the file is whole lines where not all is, and where its chain ends.

    Raises:
        OSError: another process writes the log, or there can be no lock.
    """
    lock = _locked(path.with_name(f".{path.stem}.lock"))
    try:
        whole, size = _whole_lines(path)
        return lock, whole if size > whole else None, _end_of_chain(path)
    except OSError:
        os.close(lock)
        raise


def _locked(path: Path) -> int:
    """A lock file, locked; the lock ends with the process.

    Raises:
        OSError: another process holds it, or it cannot be made.
    """
    lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        taken = isinstance(error, BlockingIOError)
        raise OSError(error.errno, "another process writes it") if taken else error from None
    return lock


def _chained(batch: Iterable[_Waiting], end: Link) -> tuple[bytes, Link]:
    """Entries as lines that continue a chain, and its new end."""
    lines = []
    for waiting in batch:
        sequence = end.sequence + 1
        known = {"time": waiting.time, "boot_s": waiting.boot_s, "kind": waiting.kind}
        entry = {"seq": sequence, **known, **waiting.content, "prev": end.hash}
        entry["hash"] = digest(entry)
        end = Link(sequence, entry["hash"])
        lines.append(canonical(entry) + b"\n")
    return b"".join(lines), end


def _whole_lines(path: Path) -> tuple[int, int]:
    """How many bytes of a file are whole lines, which a crash may leave the last one not, and how many it has."""
    try:
        size = path.stat().st_size
    except FileNotFoundError:
        return 0, 0
    with path.open("rb") as file:
        at = size
        while at > 0:
            start = max(at - 65536, 0)
            file.seek(start)
            found = file.read(at - start).rfind(b"\n")
            if found >= 0:
                at = start + found + 1
                break
            at = start
    return at, size
