"""Reader of the audit logs of an experiment."""

from __future__ import annotations

from pathlib import Path

from fractus_runtime.audit_chain import entries, logs, read_lines, verify

from fractus_sim.testbeds.testbed import Findings

JUDGED = frozenset({"call", "monitor", "takeover"})


def read_audit(path: Path, name: str, findings: Findings) -> None:
    """Verify an audit log with its segments and add its policy decisions to the findings."""
    lines = [line for _, _, line in read_lines(logs([path])[path])]
    finding = verify(lines)
    findings.audit_problems[name] = f"line {finding.line} {finding.problem}" if finding.problem else ""
    findings.calls += [entry for entry in entries(lines) if entry.get("kind") in JUDGED]
