"""What the services of the node leave in files for the cluster to know: how far their audit logs are, and what is not recorded."""

from __future__ import annotations

import json
import re
from pathlib import Path

_HEAD = re.compile(r"[a-z0-9-]{1,63}:\d{1,15}:[0-9a-f]{64}")

MAX_PROBLEM_BYTES = 500


def audit_heads(directory: Path) -> list[str]:
    """LOG:NUMBER:HASH of each log's latest checkpoint, as `fractus audit verify --since` takes them; unreadable ones are left out."""
    found = []
    for path in sorted(directory.glob("*.checkpoint")):
        try:
            said = json.loads(path.read_bytes())
            head = f"{said['log']}:{said['seq']}:{said['hash']}"
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            continue
        if _HEAD.fullmatch(head):
            found.append(head)
    return found


def recording_problems(state: Path) -> list[str]:
    """Why services record nothing that should: SERVICE: PROBLEM for each that says so below the node's state directory."""
    found = []
    for path in sorted(state.glob("*/recording.problem")):
        try:
            said = path.read_bytes()[:MAX_PROBLEM_BYTES].decode(errors="replace").strip()
        except OSError:
            continue
        if said:
            found.append(f"{path.parent.name}: {said}")
    return found
