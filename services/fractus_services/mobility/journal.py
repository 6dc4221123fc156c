"""What must survive the death of the service: missions, their progress and their outcomes."""

from __future__ import annotations

import asyncio
import json
import logging
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from fractus_services.grants import Held

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
    """

    key: str
    identity: str
    outcome: str = ""
    points_done: int = 0
    waypoints: int = 0
    flown: bool = False


class Journal:
    """Missions on disk, replaced atomically.

    Args:
        directory: the service's state directory.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "journal.json"
        self._lock = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self.missions: dict[str, Mission] = {}
        self.active: str | None = None
        directory.mkdir(parents=True, exist_ok=True)
        self._load()

    def _load(self) -> None:
        try:
            stored = json.loads(self._path.read_bytes())
            self.missions = {m["key"]: Mission(**m) for m in stored["missions"]}
            self.active = stored["active"]
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.critical("the journal %s cannot be read, missions begin anew: %s", self._path, error)

    @property
    def flying(self) -> Mission | None:
        """The mission that the drone is armed or in the air for."""
        return self.missions.get(self.active) if self.active else None

    def mission(self, held: Held) -> Mission:
        """The mission of a grant, begun when it is new."""
        found = self.missions.get(held.key)
        if found is None:
            found = self.missions[held.key] = Mission(held.key, held.identity)
            for key in list(self.missions)[: max(len(self.missions) - REMEMBERED, 0)]:
                del self.missions[key]
        return found

    def outcomes(self) -> dict[str, str]:
        """Ended missions by key."""
        return {m.key: m.outcome for m in self.missions.values() if m.outcome}

    async def save(self) -> None:
        """Write everything; on disk when this returns."""
        stored = {"version": 1, "active": self.active, "missions": [asdict(m) for m in self.missions.values()]}
        async with self._lock:
            try:
                await asyncio.to_thread(self._write, json.dumps(stored, indent=1).encode())
            except OSError as error:
                log.critical("cannot write the journal %s: %s", self._path, error)

    def save_soon(self) -> None:
        """Write in the background."""
        task = asyncio.get_running_loop().create_task(self.save())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _write(self, data: bytes) -> None:
        fresh = self._path.with_suffix(".new")
        with fresh.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(self._path)
        directory = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
