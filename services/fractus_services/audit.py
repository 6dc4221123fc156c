"""The audit log: one JSON object a line, each carrying the hash of the one before it."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

log = logging.getLogger(__name__)

GENESIS = "0" * 64
SYNC_S = 0.5
"""Entries that do not decide anything are on disk after this time at the latest."""


MOST_WAITING = 10_000
"""So many entries wait for a disk that does not take them."""

HUNG_S = 2.0
"""A write that takes longer counts as failed until it comes back."""


def digest(entry: dict[str, Any]) -> str:
    """SHA-256 over the canonical JSON of an entry without its own hash."""
    body = {key: value for key, value in entry.items() if key != "hash"}
    return hashlib.sha256(_canonical(body)).hexdigest()


def _canonical(value: dict[str, Any]) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


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


class AuditLog:
    """Appends entries; a thread writes them, so that a slow disk never holds up a flight.

    While the disk is full or does not answer, entries wait; those beyond `MOST_WAITING` are lost, and one entry in their
    place tells how many.

    Args:
        path: the file; a chain that it holds is continued, a last line torn by a crash is cut off and noted.
        clock: Unix time in seconds.
    """

    def __init__(self, path: Path, clock: Callable[[], float]) -> None:
        self._path = path
        self._clock = clock
        self._waiting: deque[_Waiting] = deque()
        self._lost = 0
        self._news = threading.Condition()
        self._urgent = False
        self._closing = False
        self._problem = ""
        self._busy_since_s: float | None = None
        self._sound_bytes: int | None = None
        path.parent.mkdir(parents=True, exist_ok=True)
        torn = _cut_torn_line(path)
        self._sequence, self._previous = _last_link(path)
        self._thread = threading.Thread(target=self._write, name="audit", daemon=True)
        self._thread.start()
        if torn:
            self.append("recovered", {"torn_bytes": torn})

    @property
    def failure(self) -> str:
        """Why entries do not reach the disk; empty while they do."""
        since_s = self._busy_since_s
        if since_s is not None and time.monotonic() - since_s > HUNG_S:
            return f"the audit log cannot be written: the disk has not answered for {time.monotonic() - since_s:.0f} s"
        return self._problem

    def append(self, kind: str, content: dict[str, Any], now: bool = True) -> None:
        """Add an entry.

        Args:
            kind: call, takeover, control, grant, state, ...
            content: JSON values.
            now: whether it must reach the disk at once.
        """
        moment = datetime.fromtimestamp(self._clock(), UTC).isoformat(timespec="milliseconds")
        entry = _Waiting(moment, kind, _plain(content))
        _canonical(entry.content)  # what is no JSON is the caller's error, not the thread's
        with self._news:
            if len(self._waiting) >= MOST_WAITING:
                self._lost += 1
                return
            self._waiting.append(entry)
            self._urgent = self._urgent or now
            self._news.notify()

    def refused_grant(self, name: str, reason: str) -> None:
        """Write down that a file of the grants grants nothing."""
        self.append("grant", {"change": "refused", "name": name, "reason": reason})

    async def close(self) -> None:
        """Write what is left."""
        with self._news:
            self._closing = True
            self._news.notify()
        await asyncio.to_thread(self._thread.join, 5.0)

    def _write(self) -> None:
        """The thread: append in batches, one fsync for each."""
        while True:
            with self._news:
                while not self._waiting and not self._closing:
                    self._news.wait()
                self._news.wait_for(lambda: self._closing or (self._urgent and not self._problem), SYNC_S)
                batch, self._urgent, closing = tuple(self._waiting), False, self._closing
            written = not batch or self._flush(batch)
            if written and batch:
                self._forget(len(batch))
            with self._news:
                if closing and (not written or not self._waiting):
                    return

    def _forget(self, written: int) -> None:
        """Take what is on disk off the queue, and note what was lost while it was full."""
        with self._news:
            for _ in range(written):
                self._waiting.popleft()
            if self._lost:
                moment = datetime.fromtimestamp(self._clock(), UTC).isoformat(timespec="milliseconds")
                self._waiting.append(_Waiting(moment, "lost", {"entries": self._lost}))
                self._lost, self._urgent = 0, True

    def _flush(self, batch: Iterable[_Waiting]) -> bool:
        """Append and sync; what could not be written is tried again."""
        lines, sequence, previous = [], self._sequence, self._previous
        for waiting in batch:
            sequence += 1
            entry = {"seq": sequence, "time": waiting.time, "kind": waiting.kind, **waiting.content, "prev": previous}
            previous = entry["hash"] = digest(entry)
            lines.append(_canonical(entry) + b"\n")
        self._busy_since_s = time.monotonic()
        try:
            self._store(b"".join(lines))
        except OSError as error:
            if not self._problem:
                log.critical("cannot write the audit log %s: %s", self._path, error)
            self._problem = f"the audit log cannot be written: {error.strerror or error}"
            return False
        finally:
            self._busy_since_s = None
        self._problem = ""
        self._sequence, self._previous = sequence, previous
        return True

    def _store(self, data: bytes) -> None:
        """Have bytes at the end of the file and on disk, or leave the file as it was.

        What a failed attempt left and could not be cut off then is cut off before the next.
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


def _cut_torn_line(path: Path) -> int:
    """Cut what a crash left of a last line; returns how many bytes that were."""
    try:
        data_end = path.stat().st_size
    except FileNotFoundError:
        return 0
    with path.open("r+b") as file:
        at = data_end
        while at > 0:
            start = max(at - 65536, 0)
            file.seek(start)
            found = file.read(at - start).rfind(b"\n")
            if found >= 0:
                at = start + found + 1
                break
            at = start
        if at < data_end:
            file.truncate(at)
    return data_end - at


def _last_link(path: Path) -> tuple[int, str]:
    """Sequence number and hash of the last entry."""
    last = b""
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        size = file.tell()
        file.seek(max(size - 1_000_000, 0))
        lines = file.read().splitlines()
        last = lines[-1] if lines else b""
    if not last:
        return 0, GENESIS
    try:
        entry = json.loads(last)
        return int(entry["seq"]), str(entry["hash"])
    except (ValueError, KeyError, TypeError):
        log.critical("the last entry of %s cannot be read; a new chain begins after it", path)
        return 0, GENESIS


@dataclass(frozen=True, slots=True)
class Finding:
    """What verification found.

    Attributes:
        entries: how many entries are sound.
        line: number of the first bad line; 0 when all are sound.
        problem: what is wrong with it; empty when all are sound.
        torn: the last line is incomplete, as after a crash or while one is being written.
    """

    entries: int
    line: int = 0
    problem: str = ""
    torn: bool = False


def verify(lines: Iterable[bytes]) -> Finding:
    """Check the chain of an audit log, line by line."""
    previous, sequence, count = GENESIS, 0, 0
    for number, line in enumerate(lines, 1):
        if not line.endswith(b"\n"):
            return Finding(count, torn=True)
        problem = ""
        try:
            entry = json.loads(line)
            if entry["prev"] != previous:
                problem = "does not continue the line before it: something was removed, inserted or reordered"
            elif entry["seq"] != sequence + 1:
                problem = f"is number {entry['seq']}, where {sequence + 1} was expected"
            elif digest(entry) != entry["hash"] or _canonical(entry) + b"\n" != line:
                problem = "was changed after it was written"
            previous, sequence = str(entry["hash"]), int(entry["seq"])
        except (ValueError, KeyError, TypeError):
            problem = "is not an audit entry"
        if problem:
            return Finding(count, number, problem)
        count += 1
    return Finding(count)


@click.group()
def audit() -> None:
    """Audit logs of node services."""


@audit.command("verify")
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
def verify_command(file: Path) -> None:
    """Check that no entry of FILE was changed, removed or inserted."""
    with file.open("rb") as stream:
        finding = verify(stream)
    if finding.problem:
        raise click.ClickException(f"{file}: line {finding.line} {finding.problem}")
    torn = "; the last line is incomplete (a crash, or it is being written)" if finding.torn else ""
    click.echo(f"{file}: {finding.entries} entries, chain sound{torn}")
