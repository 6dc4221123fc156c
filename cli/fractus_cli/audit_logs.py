"""Reads audit logs: whether their chains are sound, and what their entries say."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from fractus_runtime.audit_chain import Finding, Link, logs, read_lines, verify
from fractus_services.recording.messages import component_of, parse_time_ns

Entry = dict[str, Any]


def found_logs(paths: Iterable[Path]) -> dict[Path, list[Path]]:
    """The logs in some directories and files, each with its files in order.

    Raises:
        click.ClickException: there is none.
    """
    paths = tuple(paths)
    found = logs(paths)
    if not found:
        raise click.ClickException(f"{', '.join(map(str, paths))}: there is no audit log (*.jsonl)")
    return found


def judged(name: Path, files: list[Path], since: Link | None = None) -> tuple[Finding, str]:
    """What verification finds in a log, and the problem with the file and line that it is in; empty when it is sound.

    Args:
        name: the log.
        files: those of its files that are judged.
        since: see `verify`.

    Raises:
        click.ClickException: a file is missing.
    """
    begins: list[tuple[int, Path]] = [(0, files[0])]

    def lines() -> Iterable[bytes]:
        for total, (path, number, line) in enumerate(read_lines(files)):
            if number == 1 and total:
                begins.append((total, path))
            yield line

    try:
        finding = verify(lines(), name not in files, since)
    except FileNotFoundError as error:
        raise click.ClickException(f"{error.filename}: is missing; the log is not complete without it") from None
    if not finding.problem:
        return finding, ""
    before, path = next(begin for begin in reversed(begins) if begin[0] < max(finding.line, 1))
    return finding, f"{path}: line {finding.line - before} {finding.problem}"


@dataclass(frozen=True, slots=True)
class Window:
    """From when to when; Unix nanoseconds, open where they are None."""

    begin_ns: int | None = None
    end_ns: int | None = None

    def __contains__(self, time_ns: int) -> bool:
        return (self.begin_ns is None or time_ns >= self.begin_ns) and (self.end_ns is None or time_ns < self.end_ns)


def entries(found: dict[Path, list[Path]], window: Window) -> Iterator[Entry]:
    """The entries of several logs in the order of their times.

    Each has `log`, the name of its log, `time_ns`, and `node`, whose log it is. Lines that are no entries are left out: `judged`
    tells of them.
    """
    nodes = _nodes(found)
    each = (_entries(name.stem, nodes[name], files, window) for name, files in found.items())
    return heapq.merge(*each, key=lambda entry: entry["time_ns"])


def _entries(log: str, node: str, files: Iterable[Path], window: Window) -> Iterator[Entry]:
    for _, _, line in read_lines(files):
        entry = _read(line)
        time_ns = parse_time_ns(entry.get("time"))
        # What began before the window counts in it, too.
        node = _started(entry) or node
        if time_ns is not None and time_ns in window:
            yield entry | {"log": log, "node": node, "time_ns": time_ns}


def _nodes(found: dict[Path, list[Path]]) -> dict[Path, str]:
    """Whose each log is: what a service said when it started, there or in a log beside it; else the directory's name."""
    said = {name: _first_started(files) for name, files in found.items()}
    beside: dict[Path, set[str]] = {}
    for name, node in said.items():
        beside.setdefault(name.parent, set()).update(filter(None, (node,)))

    def other(name: Path) -> str:
        only = beside[name.parent]
        return next(iter(only)) if len(only) == 1 else name.parent.resolve().name

    return {name: node or other(name) for name, node in said.items()}


def _first_started(files: Iterable[Path]) -> str:
    return next(
        (node for _, _, line in read_lines(files) if b'"started"' in line and (node := _started(_read(line)))), ""
    )


def _started(entry: Entry) -> str:
    return str(entry.get("node") or "") if entry.get("kind") == "started" else ""


def _read(line: bytes) -> Entry:
    """An entry; an empty one where the line is none."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return entry if isinstance(entry, dict) else {}


def decided(entry: Entry) -> bool:
    """Whether an entry tells of a policy that changed something, or of a change of control."""
    kind = entry.get("kind")
    if kind in {"call", "check"}:
        return entry.get("action") in {"correct", "deny", "takeover"}
    return kind in {"monitor", "takeover", "control"}


def who(entry: Entry) -> str:
    """Who an entry is about: the component that called, or what else acted."""
    return component_of(entry) or str(entry.get("controller") or "system")
