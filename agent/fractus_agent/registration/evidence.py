"""How far the audit logs of the node's services have come, so that the cluster knows what they must have."""

from __future__ import annotations

import json
import re
from pathlib import Path

_HEAD = re.compile(r"[a-z0-9-]{1,63}:\d{1,15}:[0-9a-f]{64}")


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
