"""Tells the log of every decision that is no plain permission, in one line, from what the audit log records."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any

log = logging.getLogger(__name__)


def log_decision(entry: Mapping[str, Any]) -> None:
    """Write the line of an entry of the audit log, if it is of a call that was corrected or refused, or of a change of control.

    Positions and arguments stay in the audit log.
    """
    match entry:
        case {"kind": "call", "action": "correct" | "deny" | "takeover"}:
            _log_verdict(entry)
        case {"kind": "takeover" | "control" as kind}:
            log.log(
                logging.WARNING if kind == "takeover" else logging.INFO,
                "control: %s (kind=%s controller=%s code=%s policies=%s reason=%s)",
                entry["action"], kind, entry["controller"], entry["code"] or "-", _listed(entry["policies"]),
                entry["reason"] or "-",
            )  # fmt: skip


def _log_verdict(entry: Mapping[str, Any]) -> None:
    # One component that is refused all the time must not keep the others' lines from being written.
    caller, limit = entry["caller"], {"limit_by": entry["caller"]}
    policies, reason = _listed(entry["policies"]), entry["reason"] or "-"
    if filters := entry.get("filters"):
        log.info(
            "policy: filters required (action=%s caller=%s method=%s filters=%s policies=%s reason=%s)",
            entry["action"], caller, entry["method"], _listed(filters), policies, reason, extra=limit,
        )  # fmt: skip
        return
    log.log(
        logging.INFO if entry["action"] == "correct" else logging.WARNING,
        "policy: verdict (action=%s caller=%s method=%s code=%s policies=%s reason=%s)",
        entry["action"], caller, entry["method"], entry["code"], policies, reason, extra=limit,
    )  # fmt: skip


def _listed(names: Iterable[str]) -> str:
    return ",".join(names) or "-"
