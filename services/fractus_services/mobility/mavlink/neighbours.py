"""Which autopilot on a link is the drone's own: cameras, gimbals, trackers and other vehicles have heartbeats, too."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from pathlib import Path

from fractus_runtime.files import write_file
from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

log = logging.getLogger(__name__)

GONE_S = 10.0
"""A vehicle that has not been heard for so long is not on the link any more."""

CHOICE_S = 3.0
"""A vehicle that no one knows is heard alone for so long before it is taken for the drone's own: three heartbeats of another one."""

SURE_S = 10.0
"""One that has been alone for so long after that is the drone's own."""

_NO_VEHICLES = frozenset({mavlink.MAV_TYPE_ANTENNA_TRACKER, mavlink.MAV_TYPE_GCS})
_VEHICLES = frozenset(
    {
        mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_COAXIAL, mavlink.MAV_TYPE_HELICOPTER, mavlink.MAV_TYPE_GROUND_ROVER, mavlink.MAV_TYPE_HEXAROTOR,
        mavlink.MAV_TYPE_OCTOROTOR, mavlink.MAV_TYPE_TRICOPTER, mavlink.MAV_TYPE_DODECAROTOR, mavlink.MAV_TYPE_DECAROTOR, mavlink.MAV_TYPE_GENERIC_MULTIROTOR,
    }
)  # fmt: skip
"""What no camera or gimbal says that it is."""

Source = tuple[int, int]
"""System and component of a sender."""


def tells_vehicle(message: Message) -> bool:
    """Whether it is a heartbeat of a vehicle's autopilot.

    Components beside it should say that they have no autopilot, and some do not.
    """
    return _tells_autopilot(message) and message.compid == mavlink.MAV_COMP_ID_AUTOPILOT1


def _tells_autopilot(message: Message) -> bool:
    return (
        message.name == "HEARTBEAT"
        and message.integer("autopilot") != mavlink.MAV_AUTOPILOT_INVALID
        and message.integer("type") not in _NO_VEHICLES
    )


def remembered(path: Path) -> tuple[str, Source] | None:
    """The drone's own vehicle as a file remembers it, and the link on which it was heard."""
    try:
        stored = json.loads(path.read_bytes())
        return str(stored["link"]), (int(stored["system"]), int(stored["component"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.critical("link: which vehicle is the drone's own is forgotten (path=%s, error=%s)", path, error)
        return None


class Memory:
    """The drone's own vehicle on disk: after a restart in flight there is no time to find out which one it is.

    Args:
        path: of the file.
        url: the link on which it was heard; on another one it may be another vehicle.
    """

    def __init__(self, path: Path, url: str) -> None:
        self._path, self._url = path, url
        self._storing: asyncio.Future[None] | None = None
        self._failed = False
        self.own: Source | None = None
        known = remembered(path)
        if known is not None and known[0] == url:
            self.own = known[1]

    def keep(self, own: Source) -> None:
        """Write it in the background, once; where that fails, the next call tries again."""
        if own != self.own:
            self.own = own
            self._storing = asyncio.ensure_future(self._store(own))

    async def _store(self, own: Source) -> None:
        content = json.dumps({"link": self._url, "system": own[0], "component": own[1]}).encode()
        try:
            await asyncio.to_thread(write_file, self._path, content)
        except OSError as error:
            self.own = None
            if not self._failed:
                log.critical(
                    "link: which vehicle is the drone's own cannot be stored yet (path=%s, error=%s)", self._path, error
                )
            self._failed = True


class Neighbours:
    """The vehicles that are heard on a link: a radio, a router or the autopilot itself may pass on what others say.

    Args:
        memory: keeps the drone's own over restarts; without one the vehicle that is heard first is taken, whatever it does.
    """

    def __init__(self, memory: Memory | None = None) -> None:
        self._memory = memory
        self._own: Source | None = memory.own if memory is not None else None
        self._sure = self._own is not None
        self._heard: dict[Source, tuple[float, float]] = {}
        self._found_at = math.inf
        self._waits = ""

    def finds(self, message: Message, now: float, *, flying: bool) -> bool:
        """Whether a message is the first of the drone's own autopilot on a connection.

        Args:
            message: of anyone.
            now: monotonic seconds.
            flying: whether the motors ran when it was heard last: then no other one can take its place.
        """
        if not tells_vehicle(message):
            self._note_misplaced(message)
            return False
        source = message.sysid, message.compid
        self._hear(source, now)
        known = self._own is not None and (self._sure or flying)
        doubt = (
            self._stranger(source)
            if known and source != self._own
            else ""
            if known
            else self._doubt(message, source, now)
        )
        if doubt is None:
            return False
        self._wait(doubt)
        if doubt:
            return False
        if source != self._own:
            self._found_at = now
        self._own = source
        return True

    def problem(self, message: Message, now: float) -> str:
        """Hear a message on a connection.

        Returns:
            Why it is not certain which vehicle is the drone's own; empty when one is heard alone.
        """
        if tells_vehicle(message):
            self._hear((message.sysid, message.compid), now)
        if self._waits or self._own is None:
            return self._waits
        others = self._others(self._own, now)
        if not others:
            # One that has been alone for a time is ours, or has been armed here; of two, either may be the one that was heard first.
            self._sure = self._sure or now - self._found_at > SURE_S or (self._tells_own(message) and _armed(message))
            if self._sure and self._own is not None and self._memory is not None:
                self._memory.keep(self._own)
            return ""
        return f"other vehicles are heard on its link, too (MAVLink systems {others}); let only its own messages pass there"

    def _tells_own(self, message: Message) -> bool:
        return tells_vehicle(message) and (message.sysid, message.compid) == self._own

    def _hear(self, source: Source, now: float) -> None:
        first_at, last_at = self._heard.get(source, (now, now))
        self._heard[source] = first_at if now - last_at < GONE_S else now, now

    def _others(self, source: Source | None, now: float) -> str:
        self._heard = {other: at for other, at in self._heard.items() if now - at[1] < GONE_S}
        systems = {system for system, _ in self._heard} - ({source[0]} if source is not None else set())
        return ", ".join(map(str, sorted(systems)))

    def _stranger(self, source: Source) -> str:
        own = self._own[0] if self._own is not None else 0
        return (
            f"another vehicle is heard on its link (MAVLink system {source[0]}), the drone's own (system {own}) is waited for;"
            " if it has another number by now, stop the service and remove vehicle.json from its state directory"
        )

    def _doubt(self, message: Message, source: Source, now: float) -> str | None:
        """Why a vehicle is not taken for the drone's own; None: it is not heard for long enough to say."""
        if self._memory is None:
            return ""
        if self._others(source, now):
            systems = self._others(None, now)
            return f"several vehicles are heard, and none is known (MAVLink systems {systems}); let only the drone's own messages pass"
        if _armed(message):
            return f"an unknown vehicle with running motors is heard (MAVLink system {source[0]}); it is left alone until they stand"
        return "" if now - self._heard[source][0] >= CHOICE_S else None

    def _note_misplaced(self, message: Message) -> None:
        told = _tells_autopilot(message) and message.integer("type") in _VEHICLES
        if told and (message.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1) not in self._heard:
            where = f"component {message.compid} of MAVLink system {message.sysid}"
            self._wait(f"an autopilot is heard as {where}, and only component 1 (MAV_COMP_ID_AUTOPILOT1) counts as one")

    def _wait(self, why: str) -> None:
        if why and why != self._waits:
            log.error("link: the drone's autopilot is not found (reason=%s)", why)
        self._waits = why


def _armed(message: Message) -> bool:
    return bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
