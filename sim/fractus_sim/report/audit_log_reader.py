"""Reader of audit logs: entries in order, and the result of the verification of the hash chain."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_runtime.audit_chain import entries, logs, read_lines, verify


@dataclass(frozen=True, slots=True)
class AuditLog:
    """An audit log with all its segments.

    Attributes:
        path: Current segment.
        entries: Readable entries in order.
        length: Number of entries in the verified chain.
        problem: Description and line of the first violation of the hash chain. Empty if the log is valid.
    """

    path: Path
    entries: tuple[Mapping[str, Any], ...]
    length: int
    problem: str


def read_audit_logs(paths: Iterable[Path]) -> Iterator[AuditLog]:
    """Read, verify and yield audit logs one by one.

    Args:
        paths: Audit logs, or directories with audit logs.
    """
    for path, segments in logs(paths).items():
        lines = [line for _, _, line in read_lines(segments)]
        finding = verify(lines)
        problem = f"line {finding.line} {finding.problem}" if finding.problem else ""
        yield AuditLog(path, tuple(entries(lines)), finding.entries, problem)
