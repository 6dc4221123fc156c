"""Heartbeats while the service starts, because a start on a small computer may exceed the heartbeat timeout of a flying drone.

These heartbeats hold off the autopilot's failsafe before the service controls the drone. They are therefore sent only to the drone's
own vehicle, only while it flies and none of its failsafes acts, and only for a limited time. They also require that the previous run
of the service identified its vehicle. If the service repeatedly crashes before that, the autopilot's failsafe acts.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from fractus_runtime.files import remove_file, write_file
from fractus_runtime.mavlink_codec import Endpoint, Message, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.mobility.mavlink.companion import COMPONENT_ID, SYSTEM_ID, heartbeat
from fractus_services.mobility.mavlink.transport import BadUrl, Transport, open_link
from fractus_services.mobility.mavlink.vehicle_identification import Source, read_known_vehicle

log = logging.getLogger(__name__)

TIMEOUT_S = 15.0
"""Longest time for which heartbeats are sent during the start. After that, the autopilot's failsafe brings the drone home."""

RETRY_S = 1.0
"""Interval of reconnections and of messages to a silent autopilot."""

VEHICLE_FILE = "vehicle.json"
SERVED_FILE = "served"
"""Name of the file that shows that the previous run identified its vehicle and took responsibility for it.

The next start removes the file.
"""

T = TypeVar("T")


async def mark_served(state: Path) -> None:
    """Allow heartbeats during the next start: this run has identified its vehicle.

    Args:
        state: State directory of the service.
    """
    try:
        await asyncio.to_thread(write_file, state / SERVED_FILE, b"", durable=False)
    except OSError as error:
        log.warning("startup: cannot allow heartbeats during the next start (error=%s)", error)


async def with_heartbeats(work: Awaitable[T], state: Path, url: str | None) -> T:
    """Await the start of the service, and meanwhile send heartbeats to a drone in flight.

    Args:
        work: The start.
        state: State directory of the service. No other process may use it.
        url: URL of the autopilot; by default the URL of the known vehicle.
    """
    heartbeats = asyncio.ensure_future(_send_heartbeats(state, url))
    try:
        return await work
    finally:
        heartbeats.cancel()
        with suppress(asyncio.CancelledError):
            await heartbeats


async def _send_heartbeats(state: Path, url: str | None) -> None:
    known = read_known_vehicle(state / VEHICLE_FILE)
    try:
        if known is None or url not in (None, known[0]) or not remove_file(state / SERVED_FILE):
            return
        async with asyncio.timeout(TIMEOUT_S):
            await _hold_off_failsafe(*known)
    except TimeoutError:
        log.warning("startup: heartbeats stopped until the service serves, timeout (timeout_s=%g)", TIMEOUT_S)
    except (OSError, BadUrl) as error:
        log.warning("startup: no heartbeats until the service serves (error=%s)", error)
    except Exception:
        log.exception("startup: no heartbeats until the service serves")


async def _hold_off_failsafe(url: str, own: Source) -> None:
    """Reply to heartbeats of the flying vehicle until cancelled."""
    while True:
        responder = _HeartbeatResponder(own)
        with suppress(ConnectionError):
            transport = await open_link(url, responder.received, responder.closed)
            responder.transport = transport
            try:
                while not responder.broken.is_set():
                    responder.send_first_message()
                    with suppress(TimeoutError):
                        async with asyncio.timeout(RETRY_S):
                            await responder.broken.wait()
            finally:
                transport.close()
        await asyncio.sleep(RETRY_S)


class _HeartbeatResponder:
    """Sends a heartbeat for each heartbeat of the vehicle on one connection.

    Args:
        own: System and component id of the drone's own vehicle.
    """

    def __init__(self, own: Source) -> None:
        self._own = own
        self._endpoint = Endpoint(SYSTEM_ID, COMPONENT_ID)
        self._received_heartbeat = False
        self._logged = False
        self.transport: Transport | None = None
        self.broken = asyncio.Event()

    def closed(self, _error: Exception | None) -> None:
        """Record that the connection broke."""
        self.broken.set()

    def received(self, data: bytes) -> None:
        """Reply to each heartbeat of the vehicle.

        The rate of the replies thereby follows the vehicle's clock, which also determines the timeout of its failsafe.
        """
        for incoming in self._endpoint.decode(data):
            if incoming.name != "HEARTBEAT" or (incoming.sysid, incoming.compid) != self._own:
                continue
            self._received_heartbeat = True
            if _flies_without_failsafe(incoming):
                if not self._logged:
                    log.warning("startup: drone in flight, sending heartbeats (timeout_s=%g)", TIMEOUT_S)
                    self._logged = True
                self._send(heartbeat())

    def send_first_message(self) -> None:
        """Send a message other than a heartbeat, because an autopilot behind UDP sends only to known peers."""
        if not self._received_heartbeat:
            self._send(message("TIMESYNC", ts1=1))

    def _send(self, outgoing: Message) -> None:
        if self.transport is not None:
            self.transport.write(self._endpoint.encode(outgoing.name, outgoing.values))


def _flies_without_failsafe(incoming: Message) -> bool:
    """Return True if a vehicle flies and none of its failsafes acts. A heartbeat would hide an active failsafe from the service."""
    return (
        bool(incoming.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        and incoming.integer("system_status") == mavlink.MAV_STATE_ACTIVE
    )
