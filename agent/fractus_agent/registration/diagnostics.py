"""Diagnostics that the node's services leave in files: heads of audit logs, recording problems, problems of the gateway, and counts of pictures."""

from __future__ import annotations

import re
from pathlib import Path

from fractus_runtime.files import path_text, read_file, read_json

_HEAD = re.compile(r"[a-z0-9-]{1,63}:\d{1,15}:[0-9a-f]{64}")

MAX_PROBLEM_BYTES = 500
_MAX_BYTES = 64 * 1024


def read_audit_heads(*directories: Path) -> list[str]:
    """Return LOG:NUMBER:HASH of each log's latest checkpoint, for `fractus audit verify --since`. Skip invalid files."""
    heads = []
    for path in sorted(path for directory in directories for path in directory.glob("*.checkpoint")):
        try:
            checkpoint = read_json(path, _MAX_BYTES)
            head = f"{checkpoint['log']}:{checkpoint['seq']}:{checkpoint['hash']}"
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if _HEAD.fullmatch(head):
            heads.append(head)
    return heads


def read_recording_problems(state: Path) -> list[str]:
    """Return SERVICE: PROBLEM of each service that cannot record, from files below the node's state directory."""
    problems = []
    for path in sorted(state.glob("*/recording.problem")):
        try:
            problem = read_file(path, _MAX_BYTES)[:MAX_PROBLEM_BYTES].decode(errors="replace").strip()
        except OSError:
            continue
        if problem:
            problems.append(f"{path_text(path.parent.name)}: {problem}")
    return problems


def read_picture_counts(state: Path) -> dict[str, tuple[int, int]]:
    """Return the numbers of taken and refused pictures by key of the Grant, from the file of the node's camera service.

    The result is empty if there is no valid file.
    """
    try:
        counts = read_json(state / "camera" / "picture-counts.json", _MAX_BYTES)
        return {str(key): (max(0, int(taken)), max(0, int(refused))) for key, (taken, refused) in counts.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def read_gateway_problem(state: Path) -> str:
    """Return the reason why MAVLink programs cannot fly, from a file below the node's state directory, or an empty string.

    A file that cannot be read is a problem too, because the gateway removes the file when programs can fly.
    """
    path = state / "gateway" / "gateway.problem"
    try:
        problem = read_file(path, _MAX_BYTES)
    except FileNotFoundError:
        return ""
    except OSError as error:
        return f"The agent cannot read {path_text(path)} ({error.strerror})."
    return problem[:MAX_PROBLEM_BYTES].decode(errors="replace").strip()
