"""Journal of missions, their progress and their outcomes, which survives a restart of the service."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from fractus_core.control import ControlState, Mission, Outcome, OutcomeKind, WaypointCounts
from fractus_runtime.files import read_json, remove_temporary, write_file

log = logging.getLogger(__name__)

_FIELDS = frozenset(field.name for field in fields(Mission))


@dataclass(frozen=True, slots=True)
class JournalContent:
    """Content of the journal.

    Attributes:
        missions: Missions by key, oldest first.
        active: Key of the mission for which the drone is armed or in the air.
        armed_by_others: True if the running motors were not started by the system.
    """

    missions: Mapping[str, Mission] = field(default_factory=dict)
    active: str | None = None
    armed_by_others: bool = False


def _outcome(stored: Any) -> Outcome:
    """Return a stored outcome. Version 1 of the journal stores it as text, such as "failed: driver lost"."""
    try:
        if isinstance(stored, str):
            kind, _, reason = stored.partition(": ")
            return Outcome(OutcomeKind(kind), reason)
        return Outcome(OutcomeKind(stored["kind"]), str(stored["reason"]))
    except (ValueError, KeyError, TypeError):
        # The mission has ended and must not start again.
        return Outcome(OutcomeKind.FAILED, "the journal contains an outcome that this release cannot read")


def _mission(stored: dict[str, Any]) -> Mission:
    """Return a stored mission without the fields that only a newer release knows."""
    known = {name: value for name, value in stored.items() if name in _FIELDS}
    # Earlier releases did not record legs. A mission that was in the air counts as having flown a leg.
    known.setdefault("leg_flown", known.get("flown", False))
    if known.get("outcome"):
        known["outcome"] = _outcome(known["outcome"])
    else:
        known["outcome"] = None
    # Earlier releases did not count waypoints.
    known["counts"] = WaypointCounts(**(known.get("counts") or {}))
    if known.get("home") is not None:
        lat, lon, amsl_m = known["home"]
        known["home"] = (float(lat), float(lon), float(amsl_m))
    if known.get("land_at") is not None:
        lat, lon = known["land_at"]
        known["land_at"] = (float(lat), float(lon))
    return Mission(**known)


def _stored(mission: Mission) -> dict[str, Any]:
    outcome = mission.outcome
    stored = None if outcome is None else {"kind": outcome.kind.value, "reason": outcome.reason}
    return asdict(replace(mission, outcome=None)) | {"outcome": stored}


def _read(path: Path) -> JournalContent:
    stored = read_json(path)
    missions = {m["key"]: _mission(m) for m in stored["missions"]}
    # Earlier releases did not record who armed. The system then counts as having armed.
    return JournalContent(missions, stored["active"], bool(stored.get("armed_by_others", False)))


def record_of(state: ControlState) -> JournalContent:
    """Return the part of the control state that the journal stores."""
    return JournalContent(state.missions, state.active, state.armed_by_others)


class Journal:
    """Missions on disk, replaced atomically. The previous copy is kept in case the disk loses the last one.

    Args:
        directory: State directory of the service.

    Attributes:
        record: Content as read at the start or as passed to the last save.
        failure: Reason why the last save failed; empty if it succeeded.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "journal.json"
        self._last = directory / "journal.last.json"
        self._lock = asyncio.Lock()
        self._queued: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.record = JournalContent()
        self.failure = ""
        directory.mkdir(parents=True, exist_ok=True)
        remove_temporary(self._path)
        self._load()

    def _load(self) -> None:
        unreadable = False
        for path in (self._path, self._last):
            try:
                self.record = _read(path)
            except FileNotFoundError:
                continue
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                log.critical("journal: cannot read file (path=%s error=%s)", path, error)
                unreadable = True
                continue
            return
        if unreadable:
            log.critical(
                "journal: previous missions are unknown, including ended ones; remove Grants that must not fly again"
            )

    async def save(self, record: JournalContent, timeout_s: float | None = None) -> None:
        """Write the record. When this returns, it is on disk or `failure` is set.

        The write continues if the caller is cancelled or the time is over.
        """
        task = self.save_soon(record)
        try:
            async with asyncio.timeout(timeout_s):
                await asyncio.shield(task)
        except TimeoutError:
            self.failure = f"the journal {self._path} was not written within {timeout_s:g} s"

    def save_soon(self, record: JournalContent) -> asyncio.Task[None]:
        """Write in the background. At most one write runs and one write waits. The waiting write stores the latest record."""
        self.record = record
        if self._queued is None:
            self._queued = asyncio.get_running_loop().create_task(self._save())
            self._tasks.add(self._queued)
            self._queued.add_done_callback(self._tasks.discard)
        return self._queued

    async def _save(self) -> None:
        async with self._lock:
            self._queued = None
            missions = [_stored(mission) for mission in self.record.missions.values()]
            stored = {"version": 2, "active": self.record.active, "missions": missions}
            stored["armed_by_others"] = self.record.armed_by_others
            try:
                await asyncio.to_thread(self._write, json.dumps(stored, indent=1).encode())
            except OSError as error:
                self.failure = f"cannot write the journal {self._path}: {error}"
                log.critical("journal: %s", self.failure)
            else:
                self.failure = ""

    def _write(self, data: bytes) -> None:
        write_file(self._path, data, former=self._last if self._path.exists() and self._readable() else None)

    def _readable(self) -> bool:
        try:
            _read(self._path)
        except (ValueError, KeyError, TypeError, AttributeError):
            return False
        return True
