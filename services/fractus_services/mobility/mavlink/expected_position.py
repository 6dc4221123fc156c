"""Expected position of a vehicle whose reported position is not trusted, on disk: a restarted service compares positions with it."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fractus_runtime.files import read_json, remove_file, write_file

from fractus_services.mobility.mavlink.position_checks import ExpectedPosition, PositionChecks, ReportedPosition

log = logging.getLogger(__name__)

EXPECTED_POSITION_FILE = "position.json"
"""Name of the file in the state directory."""

REWRITE_M = 1.0
"""Distance from the stored position above which the file is written again."""


class ExpectedPositionFile:
    """Expected position on disk. The file exists while the position is not trusted, and until the vehicle restarts.

    Args:
        path: Path of the file.

    Attributes:
        stored: Position in the file; None if there is no file, or if it cannot be read.
        problem: Why the file cannot be read; empty if it can. The position is then not trusted, because the file shows that it was
            not trusted before.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._storing: asyncio.Future[None] | None = None
        self._failed = False
        self.stored: ExpectedPosition | None = None
        self.problem = ""
        try:
            self.stored = _read(path)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            self.problem = f"the position expected by an earlier process cannot be read ({path})"
            log.critical(
                "position: cannot read the expected position; no position is trusted until the autopilot restarts where it has"
                " a clear view of the sky (path=%s error=%s)",
                path, error,
            )  # fmt: skip

    def apply_to(self, checks: PositionChecks) -> None:
        """Let the checks of this process continue from the file."""
        if self.problem:
            checks.distrust(self.problem)
        elif self.stored is not None:
            checks.restore(self.stored)

    def keep(self, expected: ExpectedPosition | None) -> None:
        """Store a position in the background, or remove the file. If a write is in progress or fails, the next call tries again."""
        if (self._storing is None or self._storing.done()) and (self.problem or _differs(self.stored, expected)):
            self._storing = asyncio.ensure_future(self._store(expected))

    async def _store(self, expected: ExpectedPosition | None) -> None:
        try:
            if expected is None:
                await asyncio.to_thread(remove_file, self._path)
            else:
                await asyncio.to_thread(write_file, self._path, json.dumps(asdict(expected)).encode())
        except OSError as error:
            if not self._failed:
                log.critical("position: cannot store the expected position yet (path=%s error=%s)", self._path, error)
            self._failed = True
        else:
            self._failed = False
            self.stored = expected
            self.problem = ""


def _differs(stored: ExpectedPosition | None, expected: ExpectedPosition | None) -> bool:
    if stored is None or expected is None:
        return stored is not expected
    moved_m = math.hypot(*stored.position.offset_m(expected.position))
    climbed_m = abs(stored.position.amsl_m - expected.position.amsl_m)
    return stored.moves is not expected.moves or moved_m > REWRITE_M or climbed_m > REWRITE_M


def _read(path: Path) -> ExpectedPosition | None:
    try:
        content = read_json(path)
    except FileNotFoundError:
        return None
    position = ReportedPosition(**{name: _finite(value) for name, value in content["position"].items()})
    return ExpectedPosition(
        position, _finite(content["unseen_m"]), moves=bool(content["moves"]), reason=str(content["reason"])
    )


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value} is not a finite number")
    return number
