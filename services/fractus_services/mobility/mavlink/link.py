"""The one link to the autopilot: connects until it is stopped, streams the vehicle's state, carries messages both ways."""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fractus_mavlink import Endpoint, Message, message
from fractus_mavlink.enums import MAV_AUTOPILOT, MAV_COMPONENT, MAV_STATE, MAV_TYPE

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.flight_stack import FlightStack
from fractus_services.mobility.mavlink.transport import BadUrl, Transport, open_link
from fractus_services.mobility.mavlink.vehicle import Vehicle

log = logging.getLogger(__name__)

SYSTEM_ID, COMPONENT_ID = 244, MAV_COMPONENT.ONBOARD_COMPUTER
"""The companion is a system of its own, whose heartbeats alone hold off the autopilot's failsafe: ground stations, which
are 255 as a rule, must not."""

HEARTBEAT_S = 1.0
SILENCE_S = 3.0
RECONNECT_AFTER_S = 6.0
BACKOFF_S = (0.2, 3.0)
MAVLINK_VERSION = 3
"""What a heartbeat says of the dialect; the frames' version is in their first byte."""


class Link:
    """A link to one vehicle.

    Args:
        url: where the autopilot is, see `open_link`.
        stack: its firmware.
        alive: whether the companion does its duty; when not, no heartbeat holds off the autopilot's own failsafe.
        on_found: called when the vehicle is heard first, again after each reconnection.
        on_heartbeat: called for every heartbeat after the state took it.

    Attributes:
        vehicle: the streamed state.
    """

    def __init__(
        self,
        url: str,
        stack: FlightStack,
        *,
        alive: Callable[[], bool] = lambda: True,
        on_found: Callable[[], None] = lambda: None,
        on_heartbeat: Callable[[], None] = lambda: None,
    ) -> None:
        self.url = url
        self.stack = stack
        self._alive = alive
        self._on_found = on_found
        self._on_heartbeat = on_heartbeat
        self.vehicle = Vehicle(stack=stack)
        self._endpoint = Endpoint(SYSTEM_ID, COMPONENT_ID)
        self._transport: Transport | None = None
        self._target: tuple[int, int] | None = None
        self._broken = asyncio.Event()
        self._updated = asyncio.Event()
        self._listeners: list[tuple[frozenset[str], asyncio.Queue[Message]]] = []

    @property
    def now(self) -> float:
        """Monotonic seconds."""
        return asyncio.get_running_loop().time()

    @property
    def found(self) -> bool:
        """Whether the vehicle was heard since the link came up."""
        return self._target is not None

    @property
    def connected(self) -> bool:
        """Whether the vehicle is heard."""
        return self._target is not None and self.now - self.vehicle.heartbeat_at < SILENCE_S

    async def run(self) -> None:
        """Keep the link open until cancelled."""
        delay = BACKOFF_S[0]
        said = ""
        while True:
            try:
                self._broken.clear()
                self._endpoint = Endpoint(SYSTEM_ID, COMPONENT_ID)
                self._transport = await open_link(self.url, self._received, self._closed)
            except BadUrl:
                raise
            except (OSError, TimeoutError) as error:
                problem = f"{type(error).__name__} {error}".strip()
                if problem != said:
                    log.warning("no link to the autopilot at %s yet: %s; trying again", self.url, problem)
                    said = problem
            else:
                said, delay = "", BACKOFF_S[0]
                await self._serve()
                log.warning("the link to the autopilot at %s broke", self.url)
            await asyncio.sleep(delay * random.uniform(0.5, 1.0))  # noqa: S311 - jitter
            delay = min(delay * 2, BACKOFF_S[1])

    async def _serve(self) -> None:
        """Heartbeats until the link breaks or falls silent."""
        opened = self.now
        try:
            while not self._broken.is_set():
                self._heartbeat()
                try:
                    async with asyncio.timeout(HEARTBEAT_S):
                        await self._broken.wait()
                except TimeoutError:
                    if self.now - max(opened, self.vehicle.heartbeat_at) > RECONNECT_AFTER_S:
                        log.warning("the autopilot is silent; opening the link again")
                        break
        finally:
            if self._transport is not None:
                self._transport.close()
            self._transport = None
            self._target = None
            self._lost()

    def beat(self) -> None:
        """Send a heartbeat now, if the companion does its duty."""
        self._heartbeat()

    def _heartbeat(self) -> None:
        if not self._alive():
            if not self.found:
                self._knock()
            return
        self.send(
            message(
                "HEARTBEAT",
                type=MAV_TYPE.ONBOARD_CONTROLLER,
                autopilot=MAV_AUTOPILOT.INVALID,
                system_status=MAV_STATE.ACTIVE,
                mavlink_version=MAVLINK_VERSION,
            )
        )

    def _knock(self) -> None:
        """Speak without a heartbeat: an autopilot behind a datagram link answers to whom it has heard."""
        self.send(message("PARAM_REQUEST_READ", param_index=-1, param_id=self.stack.witness.encode()))

    def _lost(self) -> None:
        """The link broke: what was agreed with the vehicle on it no longer holds."""

    def send(self, outgoing: Message) -> None:
        """Send a message; without a link it is dropped."""
        if self._transport is not None:
            self._transport.write(self._endpoint.encode(outgoing.name, outgoing.values))

    def _closed(self, error: Exception | None) -> None:
        if error is not None:
            log.warning("autopilot link: %s", error)
        self._broken.set()

    def _received(self, data: bytes) -> None:
        for incoming in self._endpoint.decode(data):
            source = (incoming.sysid, incoming.compid)
            if self._target is None:
                # Cameras, gimbals and ground stations have heartbeats, too, and no autopilot.
                if incoming.name != "HEARTBEAT" or incoming.integer("autopilot") == MAV_AUTOPILOT.INVALID:
                    continue
                self._target = source
                self.vehicle.take(incoming, self.now)
                self._on_found()
            if source == self._target:
                self._take(incoming)

    def _take(self, incoming: Message) -> None:
        self.vehicle.take(incoming, self.now)
        for kinds, queue in self._listeners:
            if incoming.name in kinds:
                queue.put_nowait(incoming)
        if incoming.name == "HEARTBEAT":
            self._on_heartbeat()
        if incoming.name in {"GLOBAL_POSITION_INT", "HEARTBEAT", "EXTENDED_SYS_STATE"}:
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

    @contextmanager
    def listening(self, *kinds: str) -> Iterator[asyncio.Queue[Message]]:
        """The vehicle's messages of some kinds, from now until the block ends."""
        listener = frozenset(kinds), asyncio.Queue[Message]()
        self._listeners.append(listener)
        try:
            yield listener[1]
        finally:
            self._listeners.remove(listener)

    def recipient(self) -> dict[str, int]:
        """The vehicle, as messages name their target, even if it is silent at the moment.

        Raises:
            AutopilotError: it was not heard since the link came up.
        """
        if self._target is None:
            raise AutopilotError("the autopilot is not connected", link=True)
        return {"target_system": self._target[0], "target_component": self._target[1]}

    def address(self) -> dict[str, int]:
        """The vehicle, as messages name their target.

        Raises:
            AutopilotError: it is not connected.
        """
        if not self.connected:
            raise AutopilotError("the autopilot is not connected", link=True)
        return self.recipient()
