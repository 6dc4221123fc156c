"""Heartbeats while the service starts: a small computer takes longer for that than the failsafe of a flying drone waits.

They say that the drone is not on its own, before that is quite true: they are sent only for the drone's own vehicle, while that
flies and none of its failsafes acts, for a limited time, and only when the service that ran before came to serve. One that ends
before it serves, however often it is started, thus leaves the drone to the autopilot's failsafe.
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
from fractus_services.mobility.mavlink.neighbours import Source, remembered
from fractus_services.mobility.mavlink.transport import BadUrl, Transport, open_link

log = logging.getLogger(__name__)

TIMEOUT_S = 15.0
"""How long a start may take: the drone then comes home by its failsafe as if no one had started."""

KNOCK_S = 1.0
"""How often an autopilot that is silent is spoken to, or connected with."""

VEHICLE_FILE = "vehicle.json"
SERVED_FILE = "served"
"""Is there since the service before found its vehicle, and decided what becomes of it; used up by the next start."""

T = TypeVar("T")


async def came_to_serve(state: Path) -> None:
    """Let the next start send heartbeats: this one found its vehicle.

    Args:
        state: the service's state directory.
    """
    try:
        await asyncio.to_thread(write_file, state / SERVED_FILE, b"", durable=False)
    except OSError as error:
        log.warning("startup: the next start sends no heartbeats until it serves (error=%s)", error)


async def with_heartbeats(work: Awaitable[T], state: Path, url: str | None) -> T:
    """The outcome of what takes long at the start, with heartbeats for a drone in flight meanwhile.

    Args:
        work: the start.
        state: the service's state directory; no other process may run the service on it.
        url: the autopilot's link; by default that on which it was heard last.
    """
    beating = asyncio.ensure_future(_beat(state, url))
    try:
        return await work
    finally:
        beating.cancel()
        with suppress(asyncio.CancelledError):
            await beating


async def _beat(state: Path, url: str | None) -> None:
    known = remembered(state / VEHICLE_FILE)
    try:
        if known is None or url not in (None, known[0]) or not remove_file(state / SERVED_FILE):
            return
        async with asyncio.timeout(TIMEOUT_S):
            await _keep_from_failsafe(*known)
    except TimeoutError:
        log.warning("startup: it takes too long, heartbeats end until the service serves (timeout_s=%g)", TIMEOUT_S)
    except (OSError, BadUrl) as error:
        log.warning("startup: no heartbeats until the service serves (error=%s)", error)
    except Exception:
        log.exception("startup: no heartbeats until the service serves")


async def _keep_from_failsafe(url: str, own: Source) -> None:
    """Answer each heartbeat of the vehicle that needs it, until cancelled."""
    while True:
        speaker = _Speaker(own)
        with suppress(ConnectionError):
            transport = await open_link(url, speaker.received, speaker.closed)
            speaker.transport = transport
            try:
                while not speaker.broken.is_set():
                    speaker.knock()
                    with suppress(TimeoutError):
                        async with asyncio.timeout(KNOCK_S):
                            await speaker.broken.wait()
            finally:
                transport.close()
        await asyncio.sleep(KNOCK_S)


class _Speaker:
    """This end of one connection.

    Args:
        own: the drone's own vehicle.
    """

    def __init__(self, own: Source) -> None:
        self._own = own
        self._endpoint = Endpoint(SYSTEM_ID, COMPONENT_ID)
        self._heard = self._told = False
        self.transport: Transport | None = None
        self.broken = asyncio.Event()

    def closed(self, _error: Exception | None) -> None:
        """The connection broke."""
        self.broken.set()

    def received(self, data: bytes) -> None:
        """Answer the vehicle's heartbeats: so ours keep the pace of its clock, as its failsafe does."""
        for incoming in self._endpoint.decode(data):
            if incoming.name != "HEARTBEAT" or (incoming.sysid, incoming.compid) != self._own:
                continue
            self._heard = True
            if _flies_soundly(incoming):
                if not self._told:
                    log.warning(
                        "startup: the drone flies, heartbeats keep it from its failsafe (timeout_s=%g)", TIMEOUT_S
                    )
                    self._told = True
                self._send(heartbeat())

    def knock(self) -> None:
        """Speak without a heartbeat: an autopilot behind UDP answers only those it has heard."""
        if not self._heard:
            self._send(message("TIMESYNC", ts1=1))

    def _send(self, outgoing: Message) -> None:
        if self.transport is not None:
            self.transport.write(self._endpoint.encode(outgoing.name, outgoing.values))


def _flies_soundly(told: Message) -> bool:
    """Whether a vehicle flies, by its heartbeat, and none of its failsafes acts: a heartbeat would hide that from the service."""
    return (
        bool(told.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        and told.integer("system_status") == mavlink.MAV_STATE_ACTIVE
    )
