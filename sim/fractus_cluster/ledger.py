"""Small JSON files that record the inputs of builds."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from fractus_runtime.files import write_file


def read_ledger(path: Path) -> dict[str, str]:
    """Return the content of a ledger. Return an empty mapping if it is missing or damaged, so that all is rebuilt."""
    try:
        content = json.loads(path.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return {}
    return content if isinstance(content, dict) else {}


def write_ledger(path: Path, content: Mapping[str, str]) -> None:
    """Write a ledger atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, json.dumps(content, indent=1, sort_keys=True).encode(), 0o644, durable=False)
