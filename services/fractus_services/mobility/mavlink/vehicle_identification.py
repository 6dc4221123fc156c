"""Identification of the drone's own autopilot among all senders of heartbeats on a link.

Cameras, gimbals, trackers and other vehicles also send heartbeats. A radio, a router or the autopilot may forward them.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
from pathlib import Path

from fractus_runtime.files import read_json, write_file
from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

log = logging.getLogger(__name__)

FORGET_AFTER_S = 10.0
"""Time without a heartbeat after which a vehicle is no longer on the link."""

SELECT_AFTER_S = 3.0
"""Time for which an unknown vehicle must be alone before it is selected. Another vehicle would send three heartbeats in this time."""

CONFIRM_AFTER_S = 10.0
"""Time for which a selected vehicle must be alone before it is confirmed as the drone's own."""

_NO_VEHICLES = frozenset({mavlink.MAV_TYPE_ANTENNA_TRACKER, mavlink.MAV_TYPE_GCS})
_VEHICLES = frozenset(
    {
        mavlink.MAV_TYPE_FIXED_WING,
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_TYPE_COAXIAL,
        mavlink.MAV_TYPE_HELICOPTER,
        mavlink.MAV_TYPE_GROUND_ROVER,
        mavlink.MAV_TYPE_HEXAROTOR,
        mavlink.MAV_TYPE_OCTOROTOR,
        mavlink.MAV_TYPE_TRICOPTER,
        mavlink.MAV_TYPE_DODECAROTOR,
        mavlink.MAV_TYPE_DECAROTOR,
        mavlink.MAV_TYPE_GENERIC_MULTIROTOR,
    }
)
"""MAV_TYPE of vehicles. Cameras and gimbals report none of these types."""

Source = tuple[int, int]
"""System and component id of a sender."""


def is_vehicle_heartbeat(message: Message) -> bool:
    """Return True for a heartbeat of a vehicle's autopilot.

    The component id is checked as well, because some components beside an autopilot wrongly report an autopilot type.
    """
    return _is_autopilot_heartbeat(message) and message.compid == mavlink.MAV_COMP_ID_AUTOPILOT1


def _is_autopilot_heartbeat(message: Message) -> bool:
    return (
        message.name == "HEARTBEAT"
        and message.integer("autopilot") != mavlink.MAV_AUTOPILOT_INVALID
        and message.integer("type") not in _NO_VEHICLES
    )


def read_known_vehicle(path: Path) -> tuple[str, Source] | None:
    """Return the URL and the ids of the drone's own vehicle from a file; None if they are unknown."""
    try:
        stored = read_json(path)
        return str(stored["link"]), (int(stored["system"]), int(stored["component"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.critical("link: cannot read which vehicle is the drone's own (path=%s, error=%s)", path, error)
        return None


class KnownVehicleFile:
    """Identity of the drone's own vehicle on disk, because there is no time to identify the vehicle after a restart in flight.

    Args:
        path: Path of the file.
        url: URL of the autopilot. A vehicle that was stored for another URL is ignored.
    """

    def __init__(self, path: Path, url: str) -> None:
        self._path = path
        self._url = url
        self._storing: asyncio.Future[None] | None = None
        self._failed = False
        self.own: Source | None = None
        known = read_known_vehicle(path)
        if known is not None and known[0] == url:
            self.own = known[1]

    def keep(self, own: Source) -> None:
        """Store the vehicle in the background if it is not stored yet. After a failure, the next call tries again."""
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
                log.critical("link: cannot store the drone's own vehicle yet (path=%s, error=%s)", self._path, error)
            self._failed = True


class VehicleSelector:
    """Selects the drone's own vehicle among those on a link.

    Args:
        known_vehicle: File that keeps the selection over restarts. Without it, the first vehicle is selected unconditionally.
    """

    def __init__(self, known_vehicle: KnownVehicleFile | None = None) -> None:
        self._file = known_vehicle
        self._own: Source | None = known_vehicle.own if known_vehicle is not None else None
        self._confirmed = self._own is not None
        self._last_seen: dict[Source, tuple[float, float]] = {}
        self._selected_at = math.inf
        self._waiting_reason = ""

    def select(self, message: Message, now: float, *, flying: bool) -> bool:
        """Return True if a message is the first one of the drone's own autopilot on a connection.

        Args:
            message: Message of any sender.
            now: Monotonic seconds.
            flying: True if the motors of the own vehicle ran at its last message. No other vehicle is then selected.
        """
        if not is_vehicle_heartbeat(message):
            self._check_component(message)
            return False
        source = message.sysid, message.compid
        self._note(source, now)
        reason: str | None = ""
        if self._own is not None and (self._confirmed or flying):
            if source != self._own:
                reason = self._other_vehicle(source)
        else:
            reason = self._doubt(message, source, now)
        if reason is None:
            return False
        self._set_waiting_reason(reason)
        if reason:
            return False
        if source != self._own:
            self._selected_at = now
        self._own = source
        return True

    def problem(self, message: Message, now: float) -> str:
        """Process a message of any sender.

        Returns:
            Reason why it is uncertain which vehicle is the drone's own; empty if one vehicle is alone on the link.
        """
        if is_vehicle_heartbeat(message):
            self._note((message.sysid, message.compid), now)
        if self._waiting_reason or self._own is None:
            return self._waiting_reason
        others = self._other_systems(self._own, now)
        if not others:
            # A vehicle is the drone's own if it was alone for some time, or if it was armed while it was alone. While two vehicles are
            # on the link, the wrong one may have been selected.
            armed = self._is_own(message) and _armed(message)
            self._confirmed = self._confirmed or now - self._selected_at > CONFIRM_AFTER_S or armed
            if self._confirmed and self._own is not None and self._file is not None:
                self._file.keep(self._own)
            return ""
        return f"other vehicles are on its link (MAVLink systems {others}); configure the link to pass its own messages only"

    def _is_own(self, message: Message) -> bool:
        return is_vehicle_heartbeat(message) and (message.sysid, message.compid) == self._own

    def _note(self, source: Source, now: float) -> None:
        first_at, last_at = self._last_seen.get(source, (now, now))
        self._last_seen[source] = first_at if now - last_at < FORGET_AFTER_S else now, now

    def _other_systems(self, source: Source | None, now: float) -> str:
        self._last_seen = {other: at for other, at in self._last_seen.items() if now - at[1] < FORGET_AFTER_S}
        systems = {system for system, _ in self._last_seen} - ({source[0]} if source is not None else set())
        return ", ".join(map(str, sorted(systems)))

    def _other_vehicle(self, source: Source) -> str:
        own = self._own[0] if self._own is not None else 0
        return (
            f"another vehicle is on its link (MAVLink system {source[0]}), waiting for the drone's own (system {own});"
            " if its system id was changed, stop the service and remove vehicle.json from its state directory"
        )

    def _doubt(self, message: Message, source: Source, now: float) -> str | None:
        """Return why a vehicle is not selected; None if it has not been observed long enough."""
        if self._file is None:
            return ""
        if self._other_systems(source, now):
            systems = self._other_systems(None, now)
            return (
                f"several unknown vehicles are on its link (MAVLink systems {systems});"
                " configure the link to pass the drone's own messages only"
            )
        if _armed(message):
            return f"an unknown vehicle is armed (MAVLink system {source[0]}); waiting until it is disarmed"
        return "" if now - self._last_seen[source][0] >= SELECT_AFTER_S else None

    def _check_component(self, message: Message) -> None:
        vehicle = _is_autopilot_heartbeat(message) and message.integer("type") in _VEHICLES
        if vehicle and (message.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1) not in self._last_seen:
            self._set_waiting_reason(
                f"an autopilot reports as component {message.compid} of MAVLink system {message.sysid};"
                " it must be component 1 (MAV_COMP_ID_AUTOPILOT1)"
            )

    def _set_waiting_reason(self, reason: str) -> None:
        if reason and reason != self._waiting_reason:
            log.error("link: waiting for the drone's autopilot (reason=%s)", reason)
        self._waiting_reason = reason


def _armed(message: Message) -> bool:
    return bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
