"""What must survive the death of the service: missions, their progress and their outcomes."""

from __future__ import annotations

import asyncio
import json
import logging
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from fractus_storage import write_file

from fractus_services.grants import ActiveGrant

log = logging.getLogger(__name__)

REMEMBERED = 200


@dataclass(slots=True)
class Mission:
    """One driver's mission.

    Attributes:
        key: the grant's key.
        identity: SPIFFE id of the driver.
        outcome: empty while it goes on; then "complete", "revoked: reason" or "failed: reason".
        points_done: control points that were returned.
        waypoints: waypoints of the present control point that were reached.
        flown: whether the drone has been in the air for it.
        home: latitude, longitude and altitude above sea level of where it armed first.
    """

    key: str
    identity: str
    outcome: str = ""
    points_done: int = 0
    waypoints: int = 0
    flown: bool = False
    home: tuple[float, float, float] | None = None


_FIELDS = frozenset(field.name for field in fields(Mission))


def _mission(stored: dict[str, Any]) -> Mission:
    """A stored mission; what a newer release wrote beside it is left out."""
    found = Mission(**{name: value for name, value in stored.items() if name in _FIELDS})
    if found.home is not None:
        lat, lon, amsl_m = found.home
        found.home = (float(lat), float(lon), float(amsl_m))
    return found


def _read(path: Path) -> tuple[dict[str, Mission], str | None]:
    stored = json.loads(path.read_bytes())
    return {m["key"]: _mission(m) for m in stored["missions"]}, stored["active"]


class Journal:
    """Missions on disk, replaced atomically; the copy before the last is kept, for a disk that loses the last.

    Args:
        directory: the service's state directory.

    Attributes:
        failure: why the last writing failed; empty when it did not.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "journal.json"
        self._last = directory / "journal.last.json"
        self._lock = asyncio.Lock()
        self._queued: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.missions: dict[str, Mission] = {}
        self.active: str | None = None
        self.failure = ""
        directory.mkdir(parents=True, exist_ok=True)
        for left in directory.glob("journal.*.new"):
            left.unlink(missing_ok=True)
        self._load()

    def _load(self) -> None:
        for path in (self._path, self._last):
            try:
                self.missions, self.active = _read(path)
            except FileNotFoundError:
                continue
            except (OSError, ValueError, KeyError, TypeError) as error:
                log.critical("the journal %s cannot be read: %s", path, error)
                continue
            return

    @property
    def flying(self) -> Mission | None:
        """The mission that the drone is armed or in the air for."""
        return self.missions.get(self.active) if self.active else None

    def mission(self, grant: ActiveGrant) -> Mission:
        """The mission of a grant, begun when it is new."""
        found = self.missions.get(grant.key)
        if found is None:
            found = self.missions[grant.key] = Mission(grant.key, grant.identity)
            for key in list(self.missions)[: max(len(self.missions) - REMEMBERED, 0)]:
                del self.missions[key]
        return found

    def outcomes(self) -> dict[str, str]:
        """Ended missions by key."""
        return {m.key: m.outcome for m in self.missions.values() if m.outcome}

    async def save(self, timeout_s: float | None = None) -> None:
        """Write everything; on disk when this returns, unless `failure` says why not.

        The writing goes on when the caller gives up.
        """
        task = self.save_soon()
        try:
            async with asyncio.timeout(timeout_s):
                await asyncio.shield(task)
        except TimeoutError:
            self.failure = f"the journal {self._path} is not written within {timeout_s:g} s"

    def save_soon(self) -> asyncio.Task[None]:
        """Write in the background; one writing at a time, and at most one waiting."""
        if self._queued is None:
            self._queued = asyncio.get_running_loop().create_task(self._save())
            self._tasks.add(self._queued)
            self._queued.add_done_callback(self._tasks.discard)
        return self._queued

    async def _save(self) -> None:
        async with self._lock:
            self._queued = None
            stored = {"version": 1, "active": self.active, "missions": [asdict(m) for m in self.missions.values()]}
            try:
                await asyncio.to_thread(self._write, json.dumps(stored, indent=1).encode())
            except OSError as error:
                self.failure = f"cannot write the journal {self._path}: {error}"
                log.critical("%s", self.failure)
            else:
                self.failure = ""

    def _write(self, data: bytes) -> None:
        write_file(self._path, data, former=self._last if self._path.exists() and self._sound() else None)

    def _sound(self) -> bool:
        try:
            _read(self._path)
        except (ValueError, KeyError, TypeError):
            return False
        return True
