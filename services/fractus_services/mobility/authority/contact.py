"""Contact of the node with the API server: the time of the last contact, which survives a restart of the service."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from fractus_core.api.components import ContactLoss
from fractus_runtime.files import read_json, remove_file, write_file

log = logging.getLogger(__name__)

CONTACT_FILE = "contact.json"
"""Name of the file in the state directory."""

STORE_AFTER_S = 5.0
"""Seconds without contact after which the time of the last contact is stored, for a service that restarts."""

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class LastContactFile:
    """Time of the last contact on disk, while contact is lost. The monotonic clock is valid until the next boot.

    Args:
        path: Path of the file.

    Attributes:
        contact_at: Monotonic time in the file; None if there is no file of this boot.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._boot = _boot_id()
        self._storing: asyncio.Future[None] | None = None
        self.contact_at = _read(path, self._boot)

    def keep(self, contact_at: float | None) -> None:
        """Store a time in the background, or remove the file. If a write is in progress or fails, the next call tries again."""
        if (self._storing is None or self._storing.done()) and self.contact_at != contact_at:
            self._storing = asyncio.ensure_future(self._store(contact_at))

    async def _store(self, contact_at: float | None) -> None:
        try:
            if contact_at is None:
                await asyncio.to_thread(remove_file, self._path)
            else:
                content = json.dumps({"boot": self._boot, "contact_at": contact_at})
                await asyncio.to_thread(write_file, self._path, content.encode())
        except OSError as error:
            log.error("contact: cannot store the last contact yet (path=%s error=%s)", self._path, error)  # noqa: TRY400
        else:
            self.contact_at = contact_at


def depends_on_contact(demand: ContactLoss | None) -> bool:
    """Return True if an application with this demand needs contact with the API server."""
    return demand is not None and demand.action != "continue"


def _boot_id() -> str:
    try:
        return _BOOT_ID.read_text().strip()
    except OSError:
        return ""


def _read(path: Path, boot: str) -> float | None:
    try:
        content: dict[str, Any] = read_json(path)
        contact_at = float(content["contact_at"])
        return contact_at if content["boot"] == boot and math.isfinite(contact_at) else None
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.error("contact: cannot read the last contact (path=%s error=%s)", path, error)  # noqa: TRY400
        return None


class Contact:
    """Time since the last contact of the node with the API server, as its agent reports it.

    If the reports are missing, the time grows. All times are monotonic.

    Args:
        now: Returns monotonic seconds.
        file: Last contact on disk; None if it is not stored.
    """

    def __init__(self, now: Callable[[], float], file: LastContactFile | None = None) -> None:
        self._now = now
        self._file = file
        stored = file.contact_at if file is not None else None
        self._restored = stored is not None
        # A stored time in the future is wrong.
        self._contact_at = now() if stored is None else min(stored, now())
        self._demanded = False

    def demand(self, demands: Iterable[ContactLoss | None]) -> None:
        """Take the demands of all stored Grants. The agent reports only while one of them depends on contact.

        The time without contact is therefore counted from the begin of the first demand. A time from the file is kept until
        a report arrives, because the service restarted without contact.
        """
        demanded = any(depends_on_contact(demand) for demand in demands)
        if demanded and not self._demanded and not self._restored:
            self._contact_at = max(self._contact_at, self._now())
        self._demanded = demanded

    def report(self, age_s: float) -> None:
        """Take a report of the agent: seconds since its last contact. A report that arrives late does not set the time back."""
        self._contact_at = max(self._contact_at, self._now() - age_s)
        self._restored = False

    @property
    def age_s(self) -> float:
        """Seconds since the last contact."""
        return self._now() - self._contact_at

    def lost(self, demand: ContactLoss | None) -> bool:
        """Return True if contact is lost for so long that the reaction of an application begins."""
        return demand is not None and depends_on_contact(demand) and self.age_s >= demand.after

    def store(self, demand: ContactLoss | None) -> None:
        """Store the last contact while it may be lost for an application in flight. Otherwise remove the stored time."""
        if self._file is not None:
            needed = depends_on_contact(demand) and self.age_s >= STORE_AFTER_S
            self._file.keep(self._contact_at if needed else None)
