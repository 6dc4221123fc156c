"""Read audit logs: verify their chains and iterate over their entries."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from fractus_runtime.audit_chain import ChainEntry, Finding, logs, read_lines, verify
from fractus_services.recording.messages import component_of, controller_of, parse_time_ns

Entry = dict[str, Any]


def find_logs(paths: Iterable[Path]) -> dict[Path, list[Path]]:
    """Return the logs in directories and files, each with its segments in order.

    Raises:
        click.ClickException: There are no logs.
    """
    paths = tuple(paths)
    segments_by_log = logs(paths)
    if not segments_by_log:
        raise click.ClickException(f"{', '.join(map(str, paths))}: no audit log (*.jsonl) found")
    return segments_by_log


def verify_log(name: Path, files: list[Path], since: ChainEntry | None = None) -> tuple[Finding, str]:
    """Verify a log. Return the finding, and the first problem with its file and line (empty if the log is sound).

    Args:
        name: Path of the log. It is not among `files` if only some segments are verified.
        files: Segments to verify.
        since: Entry that the log must contain, see `verify`.

    Raises:
        click.ClickException: A segment is missing.
    """
    # Segments, each with the number of lines before it.
    begins: list[tuple[int, Path]] = [(0, files[0])]

    def lines() -> Iterable[bytes]:
        for total, (path, number, line) in enumerate(read_lines(files)):
            if number == 1 and total:
                begins.append((total, path))
            yield line

    try:
        finding = verify(lines(), name not in files, since)
    except FileNotFoundError as error:
        raise click.ClickException(f"{error.filename}: segment is missing; the log is incomplete without it") from None
    if not finding.problem:
        return finding, ""
    before, path = next(begin for begin in reversed(begins) if begin[0] < max(finding.line, 1))
    return finding, f"{path}: line {finding.line - before} {finding.problem}"


@dataclass(frozen=True, slots=True)
class Window:
    """Time window in Unix nanoseconds. If a bound is None, the window is open on that side."""

    begin_ns: int | None = None
    end_ns: int | None = None

    def __contains__(self, time_ns: int) -> bool:
        return (self.begin_ns is None or time_ns >= self.begin_ns) and (self.end_ns is None or time_ns < self.end_ns)


def entries(segments_by_log: dict[Path, list[Path]], window: Window) -> Iterator[Entry]:
    """Yield the entries of several logs in order of time, with the additional fields `log` (its name), `node` and `time_ns`.

    Lines that are not entries are skipped, because `verify_log` reports them.
    """
    nodes = _nodes(segments_by_log)
    per_log = (_entries(name.stem, nodes[name], files, window) for name, files in segments_by_log.items())
    return heapq.merge(*per_log, key=lambda entry: entry["time_ns"])


def _entries(log: str, node: str, files: Iterable[Path], window: Window) -> Iterator[Entry]:
    for _, _, line in read_lines(files):
        entry = _read(line)
        time_ns = parse_time_ns(entry.get("time"))
        # Read this entry even if it is before the window, because it names the node of later entries.
        node = _started(entry) or node
        if time_ns is not None and time_ns in window:
            yield entry | {"log": log, "node": node, "time_ns": time_ns}


def _nodes(segments_by_log: dict[Path, list[Path]]) -> dict[Path, str]:
    """Return the node of each log.

    A `started` entry names the node. A log without such an entry belongs to the node of the other logs in its
    directory. If these logs name no node or several nodes, the directory name is used.
    """
    started = {name: _first_started(files) for name, files in segments_by_log.items()}
    by_directory: dict[Path, set[str]] = {}
    for name, node in started.items():
        by_directory.setdefault(name.parent, set()).update(filter(None, (node,)))

    def default(name: Path) -> str:
        nodes = by_directory[name.parent]
        return next(iter(nodes)) if len(nodes) == 1 else name.parent.resolve().name

    return {name: node or default(name) for name, node in started.items()}


def _first_started(files: Iterable[Path]) -> str:
    """Return the node of the first `started` entry, or an empty string."""
    return next(
        (node for _, _, line in read_lines(files) if b'"started"' in line and (node := _started(_read(line)))), ""
    )


def _started(entry: Entry) -> str:
    """Return the node of a `started` entry, or an empty string."""
    return str(entry.get("node") or "") if entry.get("kind") == "started" else ""


def _read(line: bytes) -> Entry:
    """Parse an entry. Return an empty entry if the line is invalid."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return entry if isinstance(entry, dict) else {}


def is_decision(entry: Entry) -> bool:
    """Return True if an entry records a policy decision other than permission, or a change of control."""
    kind = entry.get("kind")
    if kind in {"call", "check"}:
        return entry.get("action") in {"correct", "deny", "takeover"}
    return kind in {"monitor", "takeover", "control"}


def actor(entry: Entry) -> str:
    """Return the component that an entry concerns, or the controller if it concerns no component."""
    return component_of(entry) or (controller_of(entry) or "system")
