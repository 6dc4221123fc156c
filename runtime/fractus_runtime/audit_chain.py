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
    """The last entry of a file, a line that a crash left incomplete aside; None when it has none.

    Raises:
        ValueError: the last whole line is no audit entry.
    """
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(file.tell() - _TAIL_BYTES, 0))
        found = file.read()
        lines = found[: found.rfind(b"\n") + 1].splitlines()
        if lines:
            try:
                entry = json.loads(lines[-1])
                return Link(int(entry["seq"]), str(entry["hash"]))
            except (KeyError, TypeError, RecursionError) as error:
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

    A log's present file stands for all of it, a segment for itself, and a directory for all of each log that it has a part or
    a checkpoint of: a present file that is missing there is listed too.
    """
    found: dict[Path, set[Path]] = {}
    for path in paths:
        whole = path.is_dir()
        checkpointed = (file.with_suffix(".jsonl") for file in path.glob("*.checkpoint"))
        for file in sorted({*path.glob("*.jsonl"), *checkpointed}) if whole else (path,):
            log = _of(file)
            found.setdefault(log, set()).update((*segments(log), log) if whole or log == file else (file,))
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


def entries(lines: Iterable[bytes]) -> Iterator[dict[str, Any]]:
    """The entries of an audit log; a line that is none, of which `verify` tells, is passed over."""
    for line in lines:
        try:
            yield json.loads(line)
        except ValueError:
            continue


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


def verify(lines: Iterable[bytes], part: bool = False, since: Link | None = None) -> Finding:
    """Check the chain of an audit log, line by line.

    Args:
        lines: the log.
        part: the lines are not the whole log; what comes before and after them is not judged.
        since: an entry that the log is known to have had; all from there on must be in the lines. Without one, no entry
            may be missing at the beginning: who removes entries can also write the entry that records it.
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
        except (ValueError, KeyError, TypeError, RecursionError):
            problem = "is not an audit entry"
        if since is not None and previous.sequence == since.sequence and previous != since:
            problem = problem or "is another entry than the checkpoint's: it and all before it were written again"
        if problem:
            return Finding(count, number, problem)
        count += 1
    if part:
        return Finding(count, torn=torn)
    begin = begin or Link()
    return Finding(count, torn=torn, before=begin.sequence, **_ends(begin, previous, max(count, 1), pruned, since))


def _ends(
    begin: Link, end: Link, last_line: int, pruned: set[tuple[object, object]], since: Link | None
) -> dict[str, Any]:
    """What is wrong with where a log begins and where it ends."""
    first = begin.sequence + 1
    if since is not None and end.sequence < since.sequence:
        problem = f"is number {end.sequence}, the last one, and the checkpoint is number {since.sequence}: entries are missing"
        return {"line": last_line, "problem": problem}
    if since is not None and begin.sequence >= since.sequence and begin != since:
        return {
            "line": 1,
            "problem": f"is number {first}, and those since the checkpoint, number {since.sequence}, are missing",
        }
    if begin == Link():
        return {}
    if (begin.sequence, begin.hash) not in pruned:
        return {
            "line": 1,
            "problem": f"is number {first}, and the entries before it were removed, and no entry records that",
        }
    if since is None:
        problem = (
            f"is number {first}; an entry records that those before were removed to make room, which only a checkpoint from"
            " before can prove: give it with --since"
        )
        return {"line": 1, "problem": problem}
    return {}


def _problem(entry: dict[str, Any], previous: Link, line: bytes) -> str:
    if entry["prev"] != previous.hash:
        return "does not continue the line before it: something was removed, inserted or reordered"
    if entry["seq"] != previous.sequence + 1:
        return f"is number {entry['seq']}, where {previous.sequence + 1} was expected"
    if digest(entry) != entry["hash"] or canonical(entry) + b"\n" != line:
        return "was changed after it was written"
    return ""
