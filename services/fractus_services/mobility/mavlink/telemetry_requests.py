"""Requests for telemetry: message rates, requested again if messages are missing, and HOME_POSITION if home has moved."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import Counter
from contextlib import suppress
from typing import Protocol

from fractus_runtime.mavlink_codec import message_id
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.vehicle import Vehicle

log = logging.getLogger(__name__)

RATES_HZ = {
    "GLOBAL_POSITION_INT": (4.0, 20.0),
    "ATTITUDE": (2.0, 10.0),
    "EXTENDED_SYS_STATE": (2.0, 5.0),
    "SYS_STATUS": (1.0, 1.0),
    "EKF_STATUS_REPORT": (1.0, 1.0),
    "GPS_RAW_INT": (1.0, 2.0),
    "HOME_POSITION": (0.2, 1.0),
    "WIND": (0.2, 1.0),
    # These messages are requested last, because many vehicles have no second GPS and no gimbal. The others must not wait for a refusal.
    "GPS2_RAW": (1.0, 2.0),
    "GIMBAL_DEVICE_ATTITUDE_STATUS": (2.0, 10.0),
}
"""Requested messages with their rates on the ground and in the air."""

GATEWAY_RATES_HZ = {
    "VFR_HUD": (2.0, 4.0),
    "LOCAL_POSITION_NED": (2.0, 4.0),
    "BATTERY_STATUS": (0.5, 0.5),
    "GPS_GLOBAL_ORIGIN": (0.2, 0.2),
    "SYSTEM_TIME": (0.5, 0.5),
    "VIBRATION": (0.5, 0.5),
}
"""Messages that only applications behind the MAVLink gateway need, with their rates on the ground and in the air.

They are requested last, and are not requested again if they are missing.
"""

CHECK_PERIOD_S = 5.0
"""Time for which received messages are counted before they are compared with the requested rates."""

MIN_SHARE = 0.25
"""Share of the requested rate below which the stream was stopped or slowed down. A bad link loses fewer messages."""

_OPTIONAL = frozenset({"WIND", "GPS2_RAW", "GIMBAL_DEVICE_ATTITUDE_STATUS"})
"""Messages that an autopilot sends only while it estimates the wind, has a second GPS, or measures the gimbal's attitude."""

MAX_CHECK_PERIOD_S = 40.0
"""Longest check period. Each unsuccessful request doubles the period, because requests do not help behind a slow radio."""

MAX_NEVER_RECEIVED = 5
"""Limit of repeated requests for a message whose request the autopilot accepted, but which never arrived.

The acceptance may have been a duplicate of the acknowledgement of another request. Few autopilots accept messages that they
cannot send.
"""

HOME_JUMP_M = 1.0
"""Change of home's altitude above sea level, computed from one position message, above which home counts as moved."""

HOME_RETRY_S = 0.3
"""Time to wait for a requested HOME_POSITION before it is requested again."""


class CommandSender(Protocol):
    """Autopilot interface that `TelemetryRates` needs."""

    @property
    def now(self) -> float:
        """Monotonic seconds."""

    async def command(self, command: int, *params: float, attempts: int = ...) -> None:
        """Run a MAVLink command and wait for its acknowledgement."""


class TelemetryRates:
    """Requests message rates and checks that the messages arrive.

    Another station on the same port of the autopilot may request other rates, and a restarted autopilot sends nothing.
    """

    def __init__(self) -> None:
        self._received_before: set[str] = set()
        self._for_gateway = False
        self.forget()

    def forget(self) -> None:
        """Reset after the connection broke."""
        self._flying: bool | None = None
        self._received_before.clear()
        self._accepted: set[str] = set()
        self._never_received_requests = 0
        self._check_period_s = CHECK_PERIOD_S
        self._start_count(-math.inf)

    def add_gateway_messages(self) -> None:
        """Also request the messages for the MAVLink gateway from now on."""
        if not self._for_gateway:
            self._for_gateway = True
            self._flying = None

    def take(self, name: str) -> None:
        """Count a received message."""
        if name in RATES_HZ:
            self._counted[name] += 1

    async def request(self, autopilot: CommandSender, flying: bool) -> None:
        """Request the rates for the ground or the air if they were not requested yet or if messages are missing.

        If the autopilot refuses a rate, the message keeps its default rate. After a lost acknowledgement, the next call requests the
        rates again. Call this method about twice a second, or at least as often as failsafes are verified.
        """
        if self._flying is flying and not self._messages_missing(flying, autopilot.now):
            return
        if self._flying is not flying:
            self._check_period_s = CHECK_PERIOD_S
        self._flying = flying
        requested = RATES_HZ | GATEWAY_RATES_HZ if self._for_gateway else RATES_HZ
        for name, rates in requested.items():
            try:
                interval_us = 1e6 / rates[flying]
                await autopilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id(name), interval_us, attempts=2)
                if name in RATES_HZ:
                    self._accepted.add(name)
            except AutopilotError as error:
                if error.link and self._flying is flying:
                    self._flying = None
                # A refusal is normal: many vehicles have no gimbal.
                level = logging.WARNING if error.link else logging.INFO
                log.log(level, "autopilot: message rate not set (message=%s, error=%s)", name, error)
        self._start_count(autopilot.now)

    def _messages_missing(self, flying: bool, now: float) -> bool:
        """Return True if fewer messages than requested were received since the last check."""
        counted_s = now - self._counted_from
        counted = self._counted
        if counted_s < self._check_period_s:
            return False
        self._received_before |= counted.keys()
        self._start_count(now)
        if math.isinf(counted_s):
            return False  # nothing was requested yet
        never_received: set[str] = set()
        if self._received_before and self._never_received_requests < MAX_NEVER_RECEIVED:
            never_received = self._accepted - self._received_before
        # The position is unknown without the message of a second receiver that sent one before.
        optional = _OPTIONAL - (self._received_before & {"GPS2_RAW"})
        expected = {
            name: RATES_HZ[name][flying] * counted_s for name in (self._received_before | never_received) - optional
        }
        missing = [
            name for name, count in expected.items() if count >= CHECK_PERIOD_S and counted[name] < MIN_SHARE * count
        ]
        self._never_received_requests += not never_received.isdisjoint(missing)
        self._check_period_s = min(2 * self._check_period_s, MAX_CHECK_PERIOD_S) if missing else CHECK_PERIOD_S
        if missing:
            log.warning("autopilot: requesting telemetry again, messages are missing (messages=%s)", ", ".join(missing))
        return bool(missing)

    def _start_count(self, now: float) -> None:
        self._counted: Counter[str] = Counter()
        self._counted_from = now


class HomeRequester(Protocol):
    """Autopilot interface that `HomePositionMonitor` needs."""

    vehicle: Vehicle

    @property
    def connected(self) -> bool:
        """True while messages of the vehicle arrive."""

    async def request_home(self) -> None:
        """Request HOME_POSITION now."""


class HomePositionMonitor:
    """Detects that home was moved although HOME_POSITION was lost, and requests the message until it arrives.

    Each position message contains the altitude of home above sea level. A horizontal move of home is visible in HOME_POSITION only.
    """

    def __init__(self, autopilot: HomeRequester) -> None:
        self._autopilot = autopilot
        self._request: asyncio.Task[None] | None = None
        self.forget()

    def forget(self) -> None:
        """Reset after the connection broke: the next messages may belong to another vehicle or flight."""
        self._home_amsl_m = math.nan
        self._outdated = False

    def take(self, name: str) -> None:
        """Check the vehicle's state after it has been updated from a message of this name."""
        vehicle = self._autopilot.vehicle
        if name == "HOME_POSITION":
            self._outdated = False
        elif name == "GLOBAL_POSITION_INT":
            home_amsl_m = vehicle.amsl_m - vehicle.altitude_m
            self._outdated = self._outdated or (vehicle.in_air and abs(home_amsl_m - self._home_amsl_m) > HOME_JUMP_M)
            self._home_amsl_m = home_amsl_m
        if self._outdated and self._autopilot.connected and (self._request is None or self._request.done()):
            self._request = asyncio.get_running_loop().create_task(self._request_home())

    async def _request_home(self) -> None:
        with suppress(AutopilotError):
            await self._autopilot.request_home()
        await asyncio.sleep(HOME_RETRY_S)
