"""Log lines for audit log entries about restricted calls and changes of control."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any

from fractus_core.api.names import component_name

log = logging.getLogger(__name__)


def log_decision(entry: Mapping[str, Any]) -> None:
    """Log an audit log entry if it is about a corrected or refused call, or about a change of control.

    Positions and arguments are in the audit log only.
    """
    match entry:
        case {"kind": "call", "action": "correct" | "deny" | "takeover"}:
            _log_verdict(entry)
        case {"kind": "takeover" | "control" as kind}:
            log.log(
                logging.WARNING if kind == "takeover" else logging.INFO,
                "control: %s (kind=%s controller=%s code=%s policies=%s reason=%s)",
                entry["action"], kind, component_name(entry["controller"]), entry["code"] or "-", _join(entry["policies"]),
                entry["reason"] or "-",
            )  # fmt: skip


def _log_verdict(entry: Mapping[str, Any]) -> None:
    caller = entry["caller"]
    # Limit log lines for each caller, so that refusals of one component do not suppress the lines of others.
    limit = {"limit_by": caller}
    policies = _join(entry["policies"])
    reason = entry["reason"] or "-"
    if filters := entry.get("filters"):
        log.info(
            "policy: filters required (action=%s caller=%s method=%s filters=%s policies=%s reason=%s)",
            entry["action"], caller, entry["method"], _join(filters), policies, reason, extra=limit,
        )  # fmt: skip
        return
    log.log(
        logging.INFO if entry["action"] == "correct" else logging.WARNING,
        "policy: verdict (action=%s caller=%s method=%s code=%s policies=%s reason=%s)",
        entry["action"], caller, entry["method"], entry["code"], policies, reason, extra=limit,
    )  # fmt: skip


def _join(names: Iterable[str]) -> str:
    return ",".join(names) or "-"
