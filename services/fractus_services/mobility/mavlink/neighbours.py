"""Which autopilot on a link is the drone's own: cameras, gimbals, trackers and other vehicles have heartbeats, too."""

from __future__ import annotations

import logging
import math

from fractus_mavlink import Message
from fractus_mavlink.enums import MAV_AUTOPILOT, MAV_COMPONENT, MAV_TYPE

log = logging.getLogger(__name__)

GONE_S = 10.0
"""A vehicle that has not been heard for so long is not on the link any more."""

MAX_FLIGHT_S = 3600.0
"""A vehicle that flew when it was heard last, and has not been for so long, is down: another one may have its place."""

_NO_VEHICLES = frozenset({MAV_TYPE.ANTENNA_TRACKER, MAV_TYPE.GCS})

Source = tuple[int, int]
"""System and component of a sender."""


def tells_vehicle(message: Message) -> bool:
    """Whether it is a heartbeat of a vehicle's autopilot.

    Components beside it should say that they have no autopilot, and some do not.
    """
    return (
        message.name == "HEARTBEAT"
        and message.compid == MAV_COMPONENT.AUTOPILOT1
        and message.integer("autopilot") != MAV_AUTOPILOT.INVALID
        and message.integer("type") not in _NO_VEHICLES
    )


class Neighbours:
    """The vehicles that are heard on a link: a radio, a router or the autopilot itself may pass on what others say."""

    def __init__(self) -> None:
        self._own: Source | None = None
        self._heard_at: dict[Source, float] = {}
        self._refused: Source | None = None
        self._own_at = -math.inf
        self._found_at = math.inf
        self._sure = False

    def finds(self, message: Message, now: float, *, flying: bool) -> bool:
        """Whether a message is the first of the drone's own autopilot on a connection.

        Args:
            message: of anyone.
            now: monotonic seconds.
            flying: whether the motors ran when it was heard last: then no other one can take its place.
        """
        source = message.sysid, message.compid
        if not tells_vehicle(message):
            return False
        self._heard_at[source] = now
        lost = flying and self._sure and now - self._own_at < MAX_FLIGHT_S
        if lost and source != self._own:
            if source != self._refused:
                log.error("link: another vehicle is heard, the one that flies is waited for (system=%d)", source[0])
            self._refused = source
            return False
        if source != self._own:
            self._found_at, self._sure = now, False
        self._own, self._own_at, self._refused = source, now, None
        return True

    def problem(self, message: Message, now: float) -> str:
        """Hear a message on a connection on which the vehicle was found.

        Returns:
            Why it is not certain which vehicle is the drone's own; empty when one is heard alone.
        """
        if tells_vehicle(message):
            source = message.sysid, message.compid
            self._heard_at[source] = now
            self._own_at = now if source == self._own else self._own_at
        self._heard_at = {source: at for source, at in self._heard_at.items() if now - at < GONE_S}
        others = sorted({system for system, _ in self._heard_at} - {self._own[0] if self._own is not None else 0})
        if not others:
            # One that has been alone for a time is ours; of two, either may be the one that was heard first.
            self._sure = self._sure or now - self._found_at > GONE_S
            return ""
        systems = ", ".join(map(str, others))
        return f"other vehicles are heard on its link, too (MAVLink systems {systems}); let only its own messages pass there"
