"""Files of an audit log: hash chain, segments and verification. Reads files only, and needs no key."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from fractus_runtime.files import open_file

GENESIS = "0" * 64
PRUNED = "pruned"
"""Kind of the entry that records which segments were removed to free space."""

_BLOCK_BYTES = 65_536
_SEGMENT = re.compile(r"^(?P<name>.+)\.(?P<first>\d{12})$")


def canonical(value: dict[str, Any]) -> bytes:
    """Return the JSON text that is hashed and written. Lone surrogates, as in file names that are not UTF-8, are escaped."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode(
        errors="backslashreplace"
    )


def digest(entry: dict[str, Any]) -> str:
    """Return the SHA-256 of the canonical JSON of an entry without its own hash."""
    body = {key: value for key, value in entry.items() if key != "hash"}
    return hashlib.sha256(canonical(body)).hexdigest()


@dataclass(frozen=True, slots=True)
class ChainEntry:
    """Sequence number and hash of an entry, which the next entry continues."""

    sequence: int = 0
    hash: str = GENESIS


def last_entry(path: Path) -> ChainEntry | None:
    """Return the last entry of a file, or None if the file has no entry. An incomplete last line is skipped.

    Raises:
        ValueError: The last complete line is not an audit entry.
    """
    with contextlib.suppress(FileNotFoundError), open_file(path) as file:
        end = _line_begin(file, file.seek(0, os.SEEK_END))
        if end == 0:
            return None
        begin = _line_begin(file, end - 1)
        file.seek(begin)
        try:
            entry = json.loads(file.read(end - begin))
            return ChainEntry(int(entry["seq"]), str(entry["hash"]))
        except (KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"not an audit entry: {error}") from None
    return None


def complete_length(path: Path) -> tuple[int, int]:
    """Return the length of the complete lines of a file, and its size. A crash may leave an incomplete last line.

    Raises:
        OSError: The file cannot be read. A missing file has no lines.
    """
    try:
        with open_file(path) as file:
            size = file.seek(0, os.SEEK_END)
            return _line_begin(file, size), size
    except FileNotFoundError:
        return 0, 0


def _line_begin(file: IO[bytes], end: int) -> int:
    """Return the offset after the last newline before `end`, or 0. Lines may have any length."""
    while end > 0:
        begin = max(end - _BLOCK_BYTES, 0)
        file.seek(begin)
        newline = file.read(end - begin).rfind(b"\n")
        if newline >= 0:
            return begin + newline + 1
        end = begin
    return 0


def segment_path(path: Path, first: int) -> Path:
    """Return the path of a closed segment whose first entry has the sequence number `first`."""
    return path.with_name(f"{path.stem}.{first:012d}{path.suffix}")


def segments(path: Path) -> list[Path]:
    """Return the closed segments of a log, oldest first."""
    candidates = path.parent.glob(f"{path.stem}.*{path.suffix}")
    return sorted(other for other in candidates if other.is_file() and _log_of(other) == path)


def first_sequence(path: Path) -> int:
    """Return the sequence number of the first entry of a segment, from its name."""
    match = _SEGMENT.match(path.stem)
    return int(match["first"]) if match is not None else 0


def logs(paths: Iterable[Path]) -> dict[Path, list[Path]]:
    """Return the logs of files and directories, each with its files in order.

    The current file of a log selects the whole log. A segment selects only itself. A directory selects all logs of
    which it contains a file or a checkpoint. The current file is listed even if it is missing.
    """
    files_by_log: dict[Path, set[Path]] = {}
    for path in paths:
        whole = path.is_dir()
        checkpointed = (file.with_suffix(".jsonl") for file in path.glob("*.checkpoint"))
        for file in sorted({*path.glob("*.jsonl"), *checkpointed}) if whole else (path,):
            log = _log_of(file)
            files_by_log.setdefault(log, set()).update((*segments(log), log) if whole or log == file else (file,))
    return {log: sorted(files, key=lambda file: (file == log, file)) for log, files in files_by_log.items()}


def _log_of(path: Path) -> Path:
    match = _SEGMENT.match(path.stem)
    return path.with_name(match["name"] + path.suffix) if match is not None else path


def read_lines(files: Iterable[Path]) -> Iterator[tuple[Path, int, bytes]]:
    """Yield the lines of several files, each with its file and line number."""
    for path in files:
        with open_file(path) as file:
            for number, line in enumerate(file, 1):
                yield path, number, line


def entries(lines: Iterable[bytes]) -> Iterator[dict[str, Any]]:
    """Yield the entries of an audit log. Lines that are not entries are skipped; `verify` reports them."""
    for line in lines:
        try:
            yield json.loads(line)
        except (ValueError, RecursionError):
            continue


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a verification.

    Attributes:
        entries: Number of valid entries.
        line: Number of the first invalid line, 0 if all lines are valid.
        problem: Problem of that line, worded to follow "line N". Empty if all lines are valid.
        torn: True if the last line is incomplete, because of a crash or because it is being written.
        before: Number of entries that were removed at the beginning to free space, according to a later entry.
    """

    entries: int
    line: int = 0
    problem: str = ""
    torn: bool = False
    before: int = 0


def verify(lines: Iterable[bytes], part: bool = False, since: ChainEntry | None = None) -> Finding:
    """Check the chain of an audit log, line by line.

    Args:
        lines: Lines of the log.
        part: True if the lines are a part of the log. Then missing entries before and after them are not detected.
        since: An entry that the log is known to have contained. This entry and all later ones must exist. Without it, no entry may be
            missing at the beginning, because an attacker who removes entries can also write an entry that records the removal.
    """
    previous = ChainEntry()
    count = 0
    torn = False
    begin: ChainEntry | None = None
    pruned: set[tuple[object, object]] = set()
    for number, line in enumerate(lines, 1):
        if torn:
            return Finding(count, number - 1, "is incomplete, but other lines follow")
        if not line.endswith(b"\n"):
            torn = True
            continue
        try:
            entry = json.loads(line)
            if begin is None:
                previous = begin = ChainEntry(int(entry["seq"]) - 1, str(entry["prev"]))
            problem = _problem(entry, previous, line)
            previous = ChainEntry(int(entry["seq"]), str(entry["hash"]))
            if entry.get("kind") == PRUNED:
                pruned.add((entry["last"], entry["last_hash"]))
        except (ValueError, KeyError, TypeError, RecursionError):
            problem = "is not an audit entry"
        if since is not None and previous.sequence == since.sequence and previous != since:
            problem = problem or "differs from the checkpoint: this entry and all entries before it were rewritten"
        if problem:
            return Finding(count, number, problem)
        count += 1
    if part:
        return Finding(count, torn=torn)
    begin = begin or ChainEntry()
    return Finding(count, torn=torn, before=begin.sequence, **_ends(begin, previous, max(count, 1), pruned, since))


def _ends(
    begin: ChainEntry, end: ChainEntry, last_line: int, pruned: set[tuple[object, object]], since: ChainEntry | None
) -> dict[str, Any]:
    """Return the line and the problem if entries are missing at the beginning or at the end of a log."""
    first = begin.sequence + 1
    if since is not None and end.sequence < since.sequence:
        problem = f"is the last entry, number {end.sequence}, but the checkpoint is number {since.sequence}: entries are missing"
        return {"line": last_line, "problem": problem}
    if since is not None and begin.sequence >= since.sequence and begin != since:
        return {
            "line": 1,
            "problem": f"is number {first}: entries since the checkpoint, number {since.sequence}, are missing",
        }
    if begin == ChainEntry():
        return {}
    if (begin.sequence, begin.hash) not in pruned:
        return {
            "line": 1,
            "problem": f"is number {first}: earlier entries were removed, and no entry records the removal",
        }
    if since is None:
        problem = (
            f"is number {first}: an entry records that earlier entries were removed to free space, which only an earlier"
            " checkpoint can prove; specify it with --since"
        )
        return {"line": 1, "problem": problem}
    return {}


def _problem(entry: dict[str, Any], previous: ChainEntry, line: bytes) -> str:
    if entry["prev"] != previous.hash:
        return "does not continue the previous line: entries were removed, inserted or reordered"
    if entry["seq"] != previous.sequence + 1:
        return f"is number {entry['seq']}, expected {previous.sequence + 1}"
    if digest(entry) != entry["hash"] or canonical(entry) + b"\n" != line:
        return "was changed after it was written"
    return ""
