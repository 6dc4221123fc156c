"""What must survive the death of the service: missions, their progress and their outcomes."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from fractus_core.control import ControlState, Mission, Outcome, OutcomeKind
from fractus_runtime.files import remove_temporary, write_file

log = logging.getLogger(__name__)

_FIELDS = frozenset(field.name for field in fields(Mission))


@dataclass(frozen=True, slots=True)
class Record:
    """What is remembered.

    Attributes:
        missions: by key, the oldest first.
        active: key of the mission that the drone is armed or in the air for.
        armed_by_others: whether others started the motors that run.
    """

    missions: Mapping[str, Mission] = field(default_factory=dict)
    active: str | None = None
    armed_by_others: bool = False


def _outcome(stored: Any) -> Outcome:
    """How a mission ended; version 1 of the journal had it as text, such as "failed: driver lost"."""
    try:
        if isinstance(stored, str):
            kind, _, reason = stored.partition(": ")
            return Outcome(OutcomeKind(kind), reason)
        return Outcome(OutcomeKind(stored["kind"]), str(stored["reason"]))
    except (ValueError, KeyError, TypeError):
        # It ended, and must not begin again.
        return Outcome(OutcomeKind.FAILED, "the journal tells in a way that this release does not know how it ended")


def _mission(stored: dict[str, Any]) -> Mission:
    """A stored mission; what a newer release wrote beside it is left out."""
    known = {name: value for name, value in stored.items() if name in _FIELDS}
    # Earlier releases did not count legs: one that was in the air may have flown some.
    known.setdefault("leg_flown", known.get("flown", False))
    if known.get("outcome"):
        known["outcome"] = _outcome(known["outcome"])
    else:
        known["outcome"] = None
    if known.get("home") is not None:
        lat, lon, amsl_m = known["home"]
        known["home"] = (float(lat), float(lon), float(amsl_m))
    return Mission(**known)


def _stored(mission: Mission) -> dict[str, Any]:
    outcome = mission.outcome
    told = None if outcome is None else {"kind": outcome.kind.value, "reason": outcome.reason}
    return asdict(replace(mission, outcome=None)) | {"outcome": told}


def _read(path: Path) -> Record:
    try:
        stored = json.loads(path.read_bytes())
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    missions = {m["key"]: _mission(m) for m in stored["missions"]}
    # Earlier releases did not tell who had armed.
    return Record(missions, stored["active"], bool(stored.get("armed_by_others", False)))


def record_of(state: ControlState) -> Record:
    """What is to be remembered of control."""
    return Record(state.missions, state.active, state.armed_by_others)


class Journal:
    """Missions on disk, replaced atomically; the copy before the last is kept, for a disk that loses the last.

    Args:
        directory: the service's state directory.

    Attributes:
        record: what was read at the beginning, or given to be written last.
        failure: why the last writing failed; empty when it did not.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "journal.json"
        self._last = directory / "journal.last.json"
        self._lock = asyncio.Lock()
        self._queued: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.record = Record()
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
                log.critical("journal: cannot be read (path=%s, error=%s)", path, error)
                unreadable = True
                continue
            return
        if unreadable:
            log.critical(
                "journal: the missions before are forgotten, also those that are over; remove Grants that must not fly again"
            )

    async def save(self, record: Record, timeout_s: float | None = None) -> None:
        """Write everything; on disk when this returns, unless `failure` says why not.

        The writing goes on when the caller gives up.
        """
        task = self.save_soon(record)
        try:
            async with asyncio.timeout(timeout_s):
                await asyncio.shield(task)
        except TimeoutError:
            self.failure = f"the journal {self._path} is not written within {timeout_s:g} s"

    def save_soon(self, record: Record) -> asyncio.Task[None]:
        """Write in the background; one writing at a time, and at most one waiting, which writes what was given last."""
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
        write_file(self._path, data, former=self._last if self._path.exists() and self._sound() else None)

    def _sound(self) -> bool:
        try:
            _read(self._path)
        except (ValueError, KeyError, TypeError, AttributeError):
            return False
        return True
