"""The streams that the service asks the autopilot for, and asks for again when they do not come."""

from __future__ import annotations

import logging
import math
from collections import Counter
from typing import Protocol

from fractus_runtime.mavlink_codec import message_id
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError

log = logging.getLogger(__name__)

STREAMS = {
    "GLOBAL_POSITION_INT": (4.0, 20.0),
    "ATTITUDE": (2.0, 10.0),
    "EXTENDED_SYS_STATE": (2.0, 5.0),
    "SYS_STATUS": (1.0, 1.0),
    "EKF_STATUS_REPORT": (1.0, 1.0),
    "GPS_RAW_INT": (1.0, 2.0),
    "HOME_POSITION": (0.2, 1.0),
    "WIND": (0.2, 1.0),
    # Last: many have no gimbal, and what flight needs waits for no answer about one.
    "GIMBAL_DEVICE_ATTITUDE_STATUS": (2.0, 10.0),
}
"""Messages and their rates in Hz on the ground and in the air."""

LOOK_S = 5.0
"""How long the messages that come are counted before they are compared with what was asked for."""

MIN_SHARE = 0.25
"""Of what was asked for: a stream of which less comes was stopped or slowed down; what a bad link loses is less."""

_OPTIONAL = frozenset({"WIND", "GIMBAL_DEVICE_ATTITUDE_STATUS"})
"""An autopilot sends them only while it estimates the one and measures the other."""

MAX_LOOK_S = 40.0
"""Asking without success doubles the time until the next look, up to this: an autopilot behind a slow radio sends less whatever it is asked."""


MAX_UNHEARD = 5
"""How often the streams are asked for again because of one that never came, though the vehicle has said that it would: the answer was
another request's, sent twice by the network. Few vehicles do not have what they accept to send."""


class Commander(Protocol):
    """The autopilot, as far as streams need it."""

    @property
    def now(self) -> float:
        """Monotonic seconds."""

    async def command(self, command: int, *params: float, attempts: int = ...) -> None:
        """Run a MAVLink command and wait for its acknowledgement."""


class Streams:
    """What was asked for, and what of it comes.

    Another station on the same port of the autopilot asks for rates of its own, and an autopilot that restarts sends nothing.
    """

    def __init__(self) -> None:
        self._known: set[str] = set()
        self.forget()

    def forget(self) -> None:
        """The connection broke: nothing was asked for, nothing has come."""
        self._flying: bool | None = None
        self._known.clear()
        self._accepted: set[str] = set()
        self._unheard = 0
        self._look_s = LOOK_S
        self._count_from(-math.inf)

    def take(self, name: str) -> None:
        """A message came."""
        if name in STREAMS:
            self._counted[name] += 1

    async def ask(self, autopilot: Commander, flying: bool) -> None:
        """Ask for the streams, more often in the air; one that is refused comes at the autopilot's own rate.

        When an answer was lost, the next call asks again; so it does when a stream that came before comes no more. To be called
        twice a second, or as seldom as failsafes are verified.
        """
        if self._flying is flying and not self._fails(flying, autopilot.now):
            return
        if self._flying is not flying:
            self._look_s = LOOK_S
        self._flying = flying
        for name, rates in STREAMS.items():
            try:
                interval_us = 1e6 / rates[flying]
                await autopilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id(name), interval_us, attempts=2)
                self._accepted.add(name)
            except AutopilotError as error:
                if error.link and self._flying is flying:
                    self._flying = None
                told = log.warning if error.link else log.info  # A refusal is no fault: many have no gimbal.
                told("autopilot: a stream keeps its own rate (message=%s, error=%s)", name, error)
        self._count_from(autopilot.now)

    def _fails(self, flying: bool, now: float) -> bool:
        """Whether less than was asked for has come since it was looked at last."""
        counted_s, counted = now - self._counted_from, self._counted
        if counted_s < self._look_s:
            return False
        self._known |= counted.keys()
        self._count_from(now)
        if math.isinf(counted_s):
            return False  # nothing was asked for yet
        unheard = self._accepted - self._known if self._known and self._unheard < MAX_UNHEARD else set()
        expected = {name: STREAMS[name][flying] * counted_s for name in (self._known | unheard) - _OPTIONAL}
        failing = [name for name, count in expected.items() if count >= LOOK_S and counted[name] < MIN_SHARE * count]
        self._unheard += not unheard.isdisjoint(failing)
        self._look_s = min(2 * self._look_s, MAX_LOOK_S) if failing else LOOK_S
        if failing:
            log.warning("autopilot: asking for the streams again, some do not come (messages=%s)", ", ".join(failing))
        return bool(failing)

    def _count_from(self, moment: float) -> None:
        self._counted: Counter[str] = Counter()
        self._counted_from = moment
