"""The one link to the autopilot: connects until it is stopped, streams the vehicle's state, carries messages both ways."""

from __future__ import annotations

import asyncio
import logging
import math
import random
from collections.abc import Callable
from contextlib import AbstractContextManager

from fractus_runtime.mavlink_codec import Endpoint, Message, message

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.companion import COMPONENT_ID, SYSTEM_ID, heartbeat
from fractus_services.mobility.mavlink.flight_stack import FlightStack
from fractus_services.mobility.mavlink.listeners import Listeners
from fractus_services.mobility.mavlink.neighbours import Memory, Neighbours, Source
from fractus_services.mobility.mavlink.timing import PROBE_S, Timing
from fractus_services.mobility.mavlink.transport import BadUrl, Transport, open_link
from fractus_services.mobility.mavlink.vehicle import Vehicle

log = logging.getLogger(__name__)

HEARTBEAT_S = 1.0
SILENCE_S = 3.0
RECONNECT_AFTER_S = 6.0
BACKOFF_S = (0.2, 3.0)


def ignore(_data: bytes) -> None:
    """What takes copies of frames that no one wants."""


class Link:
    """A link to one vehicle.

    Args:
        url: where the autopilot is, see `open_link`.
        stack: its firmware.
        alive: whether the companion does its duty; when not, no heartbeat holds off the autopilot's own failsafe.
        on_found: called when the vehicle is heard first, again after each reconnection.
        on_heartbeat: called for every heartbeat after the state took it.
        sysid: the system that speaks at this end.
        memory: keeps which vehicle is the drone's own; without it the one that is heard first is.
        received: takes a copy of all bytes that come; returns at once and raises nothing, and so does the next.
        sent: takes a copy of each frame that goes.

    Attributes:
        vehicle: the streamed state.
        timing: how late that comes, and how late commands take effect.
        target: system and component of the vehicle, from its first heartbeat until the connection breaks.
    """

    def __init__(
        self,
        url: str,
        stack: FlightStack,
        *,
        alive: Callable[[], bool] = lambda: True,
        on_found: Callable[[], None] = lambda: None,
        on_heartbeat: Callable[[], None] = lambda: None,
        sysid: int = SYSTEM_ID,
        memory: Memory | None = None,
        received: Callable[[bytes], None] = ignore,
        sent: Callable[[bytes], None] = ignore,
    ) -> None:
        self._copy_received, self._copy_sent = received, sent
        self.url = url
        self._sysid = sysid
        self.stack = stack
        self._alive, self._on_found, self._on_heartbeat = alive, on_found, on_heartbeat
        self.vehicle = Vehicle(stack=stack)
        self.timing = Timing()
        self._endpoint = Endpoint(sysid, COMPONENT_ID)
        self._transport: Transport | None = None
        self.target: Source | None = None
        self._neighbours = Neighbours(memory)
        self._broken, self._updated = asyncio.Event(), asyncio.Event()
        self._listeners = Listeners(sysid)

    @property
    def now(self) -> float:
        """Monotonic seconds."""
        return asyncio.get_running_loop().time()

    @property
    def found(self) -> bool:
        """Whether the vehicle was heard since the link came up."""
        return self.target is not None

    @property
    def connected(self) -> bool:
        """Whether the vehicle is heard."""
        return self.target is not None and self.now - self.vehicle.heartbeat_at < SILENCE_S

    @property
    def pace(self) -> float:
        """How many of the vehicle's seconds go by in one of ours."""
        return self.timing.pace

    @property
    def latency_s(self) -> float:
        """See `Autopilot`."""
        return self.timing.latency_s(self.now)

    @property
    def link_problem(self) -> str:
        """Why the link lets nothing arm; empty when nothing is wrong."""
        return self.timing.problem(self.now)

    async def run(self) -> None:
        """Keep the link open until cancelled."""
        delay = BACKOFF_S[0]
        said = ""
        while True:
            try:
                self._broken.clear()
                # Half a frame of the connection that broke must not swallow the beginning of this one.
                self._endpoint = Endpoint(self._sysid, COMPONENT_ID)
                self._transport = await open_link(self.url, self._received, self._closed)
            except BadUrl:
                raise
            except (OSError, TimeoutError) as error:
                problem = f"{type(error).__name__} {error}".strip()
                if problem != said:
                    log.warning(
                        "link: no connection to the autopilot yet, trying again (url=%s, error=%s)", self.url, problem
                    )
                    said = problem
            else:
                said, delay = "", BACKOFF_S[0]
                await self._serve()
                log.warning("link: the connection to the autopilot broke (url=%s)", self.url)
            await asyncio.sleep(delay * random.uniform(0.5, 1.0))  # noqa: S311 - jitter
            delay = min(delay * 2, BACKOFF_S[1])

    async def _serve(self) -> None:
        """Heartbeats until the link breaks or falls silent."""
        opened = due = self.now
        beat_at = -math.inf
        try:
            while not self._broken.is_set():
                # The failsafe that heartbeats hold off counts the vehicle's seconds.
                if self.now - beat_at >= HEARTBEAT_S / self.timing.pace - PROBE_S / 2:
                    beat_at = self.now
                    self.beat()
                self._probe(due)
                due = max(due + PROBE_S, self.now - PROBE_S)
                try:
                    async with asyncio.timeout_at(due):
                        await self._broken.wait()
                except TimeoutError:
                    if self.now - max(opened, self.vehicle.heartbeat_at) > RECONNECT_AFTER_S:
                        log.warning("link: the autopilot is silent, connecting again (url=%s)", self.url)
                        break
        finally:
            if self._transport is not None:
                self._transport.close()
            self._transport = None
            self.target = None
            self.timing.reset()
            self._lost()

    def _probe(self, due: float) -> None:
        """Measure the delay of the link."""
        number = self.timing.request(due) if self.found else None
        if number is not None:
            self.send(message("TIMESYNC", ts1=number))

    def beat(self) -> None:
        """Send a heartbeat now, if the companion does its duty."""
        if not self._alive():
            if not self.found:
                self._knock()
            return
        self.send(heartbeat())

    def _knock(self) -> None:
        """Speak without a heartbeat: an autopilot behind UDP answers only those it has heard."""
        self.send(message("PARAM_REQUEST_READ", param_index=-1, param_id=self.stack.witness.encode()))

    def _lost(self) -> None:
        """The link broke: what was agreed with the vehicle on it no longer holds."""

    def send(self, outgoing: Message) -> None:
        """Send a message; without a link it is dropped."""
        if self._transport is not None:
            frame = self._endpoint.encode(outgoing.name, outgoing.values)
            self._transport.write(frame)
            self._copy_sent(frame)

    def _closed(self, error: Exception | None) -> None:
        if error is not None:
            log.warning("link: the connection failed (url=%s, error=%s)", self.url, error)
        self._broken.set()

    def _received(self, data: bytes) -> None:
        self._copy_received(data)
        for incoming in self._endpoint.decode(data):
            source = (incoming.sysid, incoming.compid)
            if self.target is None and self._neighbours.finds(incoming, self.now, flying=self.vehicle.armed):
                self.target = source
                self.vehicle.take(incoming, self.now)
                self._on_found()
            if incoming.name == "HEARTBEAT":
                self.vehicle.unclear = self._neighbours.problem(incoming, self.now)
            if source == self.target:
                self.take(incoming)

    def take(self, incoming: Message) -> None:
        """Hand on a message of the vehicle."""
        at = self.now
        if incoming.name == "GLOBAL_POSITION_INT":
            late_s = self.timing.sampled(incoming.integer("time_boot_ms"), at)
            if late_s is None or self._restarted():
                return
            at -= late_s
        elif incoming.has("time_boot_ms"):
            at -= self.timing.age_s(incoming.integer("time_boot_ms"), at)
        elif incoming.name == "TIMESYNC":
            self.timing.replied(incoming.integer("tc1"), incoming.integer("ts1"), at)
            if self._restarted():
                return
        self.vehicle.take(incoming, at)
        self._listeners.take(incoming)
        if incoming.name == "HEARTBEAT":
            self._on_heartbeat()
        if incoming.name in {"GLOBAL_POSITION_INT", "HEARTBEAT", "EXTENDED_SYS_STATE"}:
            self.notify()

    def _restarted(self) -> bool:
        """Whether the vehicle has restarted: streams, parameters and what else was agreed with it begin as on a new connection."""
        if self.timing.restarted and not self._broken.is_set():
            log.warning("link: the autopilot has restarted, connecting again (url=%s)", self.url)
            self._broken.set()
        return self.timing.restarted

    def notify(self) -> None:
        """Wake those that wait for an update of the vehicle's state."""
        self._updated.set()
        self._updated = asyncio.Event()

    async def update(self, timeout_s: float) -> bool:
        """Wait for a message of the vehicle; False when none came in time."""
        event = self._updated
        try:
            async with asyncio.timeout(timeout_s):
                await event.wait()
        except TimeoutError:
            return False
        return True

    def listening(self, *kinds: str) -> AbstractContextManager[asyncio.Queue[Message]]:
        """The vehicle's messages of some kinds, from now until the block ends."""
        return self._listeners.listening(*kinds)

    def recipient(self) -> dict[str, int]:
        """The vehicle, as messages name their target, even if it is silent at the moment.

        Raises:
            AutopilotError: it was not heard since the link came up.
        """
        if self.target is None:
            raise AutopilotError("the autopilot is not connected", link=True)
        return {"target_system": self.target[0], "target_component": self.target[1]}

    def address(self) -> dict[str, int]:
        """The vehicle, as messages name their target.

        Raises:
            AutopilotError: it is not connected.
        """
        if not self.connected:
            raise AutopilotError("the autopilot is not connected", link=True)
        return self.recipient()
