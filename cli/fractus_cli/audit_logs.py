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
from fractus_services.recording.messages import component_of, parse_time_ns

Entry = dict[str, Any]


def find_logs(paths: Iterable[Path]) -> dict[Path, list[Path]]:
    """Return the logs in directories and files, each with its segments in order.

    Raises:
        click.ClickException: There are no logs.
    """
    paths = tuple(paths)
    found = logs(paths)
    if not found:
        raise click.ClickException(f"{', '.join(map(str, paths))}: no audit log (*.jsonl) found")
    return found


def verify_log(name: Path, files: list[Path], since: ChainEntry | None = None) -> tuple[Finding, str]:
    """Verify a log. Return the finding, and the problem with its file and line (empty if the log is sound).

    Args:
        name: The log.
        files: Its segments to verify.
        since: ChainEntry that the log must contain, see `verify`.

    Raises:
        click.ClickException: A segment is missing.
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
        raise click.ClickException(f"{error.filename}: segment is missing; the log is incomplete without it") from None
    if not finding.problem:
        return finding, ""
    before, path = next(begin for begin in reversed(begins) if begin[0] < max(finding.line, 1))
    return finding, f"{path}: line {finding.line - before} {finding.problem}"


@dataclass(frozen=True, slots=True)
class Window:
    """Time window in Unix nanoseconds. None is unbounded."""

    begin_ns: int | None = None
    end_ns: int | None = None

    def __contains__(self, time_ns: int) -> bool:
        return (self.begin_ns is None or time_ns >= self.begin_ns) and (self.end_ns is None or time_ns < self.end_ns)


def entries(found: dict[Path, list[Path]], window: Window) -> Iterator[Entry]:
    """Iterate over the entries of several logs in time order.

    Adds `log` (name of the log), `node` and `time_ns` to each entry. Skips lines that are not entries; `verify_log` reports them.
    """
    nodes = _nodes(found)
    each = (_entries(name.stem, nodes[name], files, window) for name, files in found.items())
    return heapq.merge(*each, key=lambda entry: entry["time_ns"])


def _entries(log: str, node: str, files: Iterable[Path], window: Window) -> Iterator[Entry]:
    for _, _, line in read_lines(files):
        entry = _read(line)
        time_ns = parse_time_ns(entry.get("time"))
        # The service may have started before the window.
        node = _started(entry) or node
        if time_ns is not None and time_ns in window:
            yield entry | {"log": log, "node": node, "time_ns": time_ns}


def _nodes(found: dict[Path, list[Path]]) -> dict[Path, str]:
    """Return the node of each log: from its `started` entry, else from another log in the directory, else the directory name."""
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
    """Parse an entry. Return an empty one if the line is invalid."""
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
    """Return the component that an entry is about, or else the controller."""
    return component_of(entry) or str(entry.get("controller") or "system")
