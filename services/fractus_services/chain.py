"""The hash chain of an audit log: its entries, the segments that store them, and its verification."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

GENESIS = "0" * 64
PRUNED = "pruned"
"""Kind of the entry that records which segments were removed to free space."""

_TAIL_BYTES = 1_000_000
_SEGMENT = re.compile(r"^(?P<name>.+)\.(?P<first>\d{12})$")


def canonical(value: dict[str, Any]) -> bytes:
    """JSON as it is hashed and written."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def digest(entry: dict[str, Any]) -> str:
    """SHA-256 over the canonical JSON of an entry without its own hash."""
    body = {key: value for key, value in entry.items() if key != "hash"}
    return hashlib.sha256(canonical(body)).hexdigest()


@dataclass(frozen=True, slots=True)
class Link:
    """An end of the chain: the next entry continues it."""

    sequence: int = 0
    hash: str = GENESIS


def last_link(path: Path) -> Link | None:
    """The last entry of a file; None when it has none.

    Raises:
        ValueError: the last line is no audit entry.
    """
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(file.tell() - _TAIL_BYTES, 0))
        lines = file.read().splitlines()
        if lines:
            try:
                entry = json.loads(lines[-1])
                return Link(int(entry["seq"]), str(entry["hash"]))
            except (KeyError, TypeError) as error:
                raise ValueError(f"no audit entry: {error}") from None
    return None


def segment(path: Path, first: int) -> Path:
    """The name that a full log file gets; `first` is the number of its first entry."""
    return path.with_name(f"{path.stem}.{first:012d}{path.suffix}")


def segments(path: Path) -> list[Path]:
    """The full segments of a log, oldest first."""
    found = path.parent.glob(f"{path.stem}.*{path.suffix}")
    return sorted(other for other in found if other.is_file() and _of(other) == path)


def first_of(path: Path) -> int:
    """The number of a segment's first entry, by its name."""
    match = _SEGMENT.match(path.stem)
    return int(match["first"]) if match is not None else 0


def logs(paths: Iterable[Path]) -> dict[Path, list[Path]]:
    """The logs that files and directories belong to, each with its files in order.

    A log's present file stands for all of it, a segment for itself.
    """
    found: dict[Path, set[Path]] = {}
    for path in paths:
        for file in sorted(path.glob("*.jsonl")) if path.is_dir() else (path,):
            log = _of(file)
            found.setdefault(log, set()).update((file,) if log != file else (*segments(file), file))
    return {log: sorted(files, key=lambda file: (file == log, file)) for log, files in found.items()}


def _of(path: Path) -> Path:
    match = _SEGMENT.match(path.stem)
    return path.with_name(match["name"] + path.suffix) if match is not None else path


def lines_of(files: Iterable[Path]) -> Iterator[tuple[Path, int, bytes]]:
    """The lines of several files, each with its file and number."""
    for path in files:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                yield path, number, line


@dataclass(frozen=True, slots=True)
class Finding:
    """What verification found.

    Attributes:
        entries: how many entries are sound.
        line: number of the first bad line; 0 when all are sound.
        problem: what is wrong with it; empty when all are sound.
        torn: the last line is incomplete, as after a crash or while one is being written.
        before: how many entries before the first one were removed to free space, as a later entry records.
    """

    entries: int
    line: int = 0
    problem: str = ""
    torn: bool = False
    before: int = 0


def verify(lines: Iterable[bytes], part: bool = False) -> Finding:
    """Check the chain of an audit log, line by line.

    Args:
        lines: the log.
        part: the lines are not the whole log; what comes before and after them is not judged.
    """
    previous, count, torn = Link(), 0, False
    begin: Link | None = None
    pruned: set[tuple[object, object]] = set()
    for number, line in enumerate(lines, 1):
        if torn:
            return Finding(count, number - 1, "is incomplete, and others follow")
        if not line.endswith(b"\n"):
            torn = True
            continue
        try:
            entry = json.loads(line)
            if begin is None:
                previous = begin = Link(int(entry["seq"]) - 1, str(entry["prev"]))
            problem = _problem(entry, previous, line)
            previous = Link(int(entry["seq"]), str(entry["hash"]))
            if entry.get("kind") == PRUNED:
                pruned.add((entry["last"], entry["last_hash"]))
        except (ValueError, KeyError, TypeError):
            problem = "is not an audit entry"
        if problem:
            return Finding(count, number, problem)
        count += 1
    begin = begin or Link()
    if begin == Link() or part:
        return Finding(count, torn=torn)
    if (begin.sequence, begin.hash) not in pruned:
        return Finding(
            0,
            1,
            f"is number {begin.sequence + 1}, and the entries before it were removed, and no entry records that",
        )
    return Finding(count, torn=torn, before=begin.sequence)


def _problem(entry: dict[str, Any], previous: Link, line: bytes) -> str:
    if entry["prev"] != previous.hash:
        return "does not continue the line before it: something was removed, inserted or reordered"
    if entry["seq"] != previous.sequence + 1:
        return f"is number {entry['seq']}, where {previous.sequence + 1} was expected"
    if digest(entry) != entry["hash"] or canonical(entry) + b"\n" != line:
        return "was changed after it was written"
    return ""
