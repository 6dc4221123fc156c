"""Connection to the autopilot: reconnects, sends heartbeats, updates the vehicle's state and distributes its messages."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from fractus_runtime.backoff import Backoff
from fractus_runtime.mavlink_codec import Endpoint, Message, message

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.companion import COMPONENT_ID, SYSTEM_ID, heartbeat
from fractus_services.mobility.mavlink.flight_stack import FlightStack
from fractus_services.mobility.mavlink.timing import PROBE_S, Timing
from fractus_services.mobility.mavlink.transport import BadUrl, Transport, open_link
from fractus_services.mobility.mavlink.vehicle import Vehicle
from fractus_services.mobility.mavlink.vehicle_identification import KnownVehicleFile, Source, VehicleSelector

log = logging.getLogger(__name__)

HEARTBEAT_S = 1.0
"""Interval between heartbeats, in seconds of the vehicle's clock."""

SILENCE_S = 3.0
"""Time without a heartbeat of the vehicle after which it counts as disconnected."""

RECONNECT_AFTER_S = 6.0
"""Time without a heartbeat of the vehicle after which the connection is opened again."""

BACKOFF_S = (0.2, 3.0)
"""First and longest delay between attempts to connect."""


def ignore(_data: bytes) -> None:
    """Default of the callbacks `received` and `sent`, which does nothing."""


class MessageSubscriptions:
    """Message queues of subscribers, filtered by message name.

    Args:
        sysid: System id of the subscribers. Messages for other systems are dropped, because they may answer another station's
            command.
    """

    def __init__(self, sysid: int) -> None:
        self._sysid = sysid
        self._open: list[tuple[frozenset[str], asyncio.Queue[Message]]] = []

    def take(self, message: Message) -> None:
        """Add a message to the queues of its subscribers."""
        if message.has("target_system") and message.integer("target_system") not in {0, self._sysid}:
            return
        for names, queue in self._open:
            if message.name in names:
                queue.put_nowait(message)

    @contextmanager
    def subscribe(self, *names: str) -> Iterator[asyncio.Queue[Message]]:
        """Queue the messages with these names until the block ends."""
        subscription = frozenset(names), asyncio.Queue[Message]()
        self._open.append(subscription)
        try:
            yield subscription[1]
        finally:
            self._open.remove(subscription)


class AutopilotLink:
    """Connection to one vehicle.

    Args:
        url: URL of the autopilot, see `open_link`.
        stack: Firmware of the autopilot.
        alive: Returns True while this service controls the drone. Otherwise no heartbeats are sent, and the autopilot's own
            failsafe acts.
        on_found: Callback invoked when the vehicle is identified, again after each reconnection.
        on_heartbeat: Callback invoked for each heartbeat of the vehicle after the state was updated.
        sysid: System id of this end of the link.
        known_vehicle: File with the identity of the drone's own vehicle. Without it, the first vehicle is selected.
        received: Callback that receives a copy of all received bytes. It must neither block nor raise.
        sent: Callback that receives a copy of each sent frame. It must neither block nor raise.

    Attributes:
        vehicle: State of the vehicle.
        timing: Measured delays of state and commands.
        target: System and component id of the vehicle, from its identification until the connection breaks.
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
        known_vehicle: KnownVehicleFile | None = None,
        received: Callable[[bytes], None] = ignore,
        sent: Callable[[bytes], None] = ignore,
    ) -> None:
        self.url = url
        self.stack = stack
        self.vehicle = Vehicle(stack=stack)
        self.timing = Timing()
        self.target: Source | None = None
        self._alive = alive
        self._on_found = on_found
        self._on_heartbeat = on_heartbeat
        self._copy_received = received
        self._copy_sent = sent
        self._sysid = sysid
        self._endpoint = Endpoint(sysid, COMPONENT_ID)
        self._transport: Transport | None = None
        self._selector = VehicleSelector(known_vehicle)
        self._broken = asyncio.Event()
        self._updated = asyncio.Event()
        self._subscriptions = MessageSubscriptions(sysid)

    @property
    def now(self) -> float:
        """Monotonic seconds."""
        return asyncio.get_running_loop().time()

    @property
    def found(self) -> bool:
        """True if the vehicle was identified since the connection was opened."""
        return self.target is not None

    @property
    def connected(self) -> bool:
        """True while heartbeats of the vehicle arrive."""
        return self.target is not None and self.now - self.vehicle.heartbeat_at < SILENCE_S

    @property
    def pace(self) -> float:
        """Seconds of the vehicle's clock per second of real time."""
        return self.timing.pace

    @property
    def latency_s(self) -> float:
        """See `Autopilot`."""
        return self.timing.latency_s(self.now)

    @property
    def link_problem(self) -> str:
        """Reason why the link's delay forbids arming; empty if there is none."""
        return self.timing.problem(self.now)

    async def run(self) -> None:
        """Keep the connection open until cancelled.

        Raises:
            BadUrl: The URL is invalid.
        """
        backoff = Backoff(*BACKOFF_S)
        logged = ""
        while True:
            try:
                self._broken.clear()
                # Discard an incomplete frame of the old connection. It would corrupt the first frame of the new one.
                self._endpoint = Endpoint(self._sysid, COMPONENT_ID)
                self._transport = await open_link(self.url, self._received, self._closed)
            except BadUrl:
                raise
            except (OSError, TimeoutError) as error:
                problem = f"{type(error).__name__} {error}".strip()
                if problem != logged:
                    log.warning("link: cannot connect to the autopilot, retrying (url=%s, error=%s)", self.url, problem)
                    logged = problem
            else:
                logged = ""
                backoff.succeeded()
                await self._serve()
                log.warning("link: connection to the autopilot broke (url=%s)", self.url)
            await asyncio.sleep(backoff.delay_s())

    async def _serve(self) -> None:
        """Send heartbeats and probes until the connection breaks or the vehicle is silent."""
        opened = due = self.now
        heartbeat_sent_at = -math.inf
        try:
            while not self._broken.is_set():
                # Heartbeats prevent the autopilot's failsafe, whose timeout follows the vehicle's clock.
                if self.now - heartbeat_sent_at >= HEARTBEAT_S / self.timing.pace - PROBE_S / 2:
                    heartbeat_sent_at = self.now
                    self.send_heartbeat()
                self._probe(due)
                due = max(due + PROBE_S, self.now - PROBE_S)
                try:
                    async with asyncio.timeout_at(due):
                        await self._broken.wait()
                except TimeoutError:
                    if self.now - max(opened, self.vehicle.heartbeat_at) > RECONNECT_AFTER_S:
                        log.warning("link: no heartbeat from the autopilot, reconnecting (url=%s)", self.url)
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

    def send_heartbeat(self) -> None:
        """Send a heartbeat now if this service controls the drone."""
        if not self._alive():
            if not self.found:
                self._send_first_message()
            return
        self.send(heartbeat())

    def _send_first_message(self) -> None:
        """Send a message other than a heartbeat, because an autopilot behind UDP sends only to known peers."""
        self.send(message("PARAM_REQUEST_READ", param_index=-1, param_id=self.stack.probe_parameter.encode()))

    def _lost(self) -> None:
        """Discard the state that belongs to the broken connection."""

    def send(self, outgoing: Message) -> None:
        """Send a message. It is dropped if there is no connection."""
        if self._transport is not None:
            frame = self._endpoint.encode(outgoing.name, outgoing.values)
            self._transport.write(frame)
            self._copy_sent(frame)

    def _closed(self, error: Exception | None) -> None:
        if error is not None:
            log.warning("link: connection failed (url=%s, error=%s)", self.url, error)
        self._broken.set()

    def _received(self, data: bytes) -> None:
        self._copy_received(data)
        for incoming in self._endpoint.decode(data):
            source = (incoming.sysid, incoming.compid)
            if self.target is None and self._selector.select(incoming, self.now, flying=self.vehicle.armed):
                self.target = source
                self.vehicle.take(incoming, self.now)
                self._on_found()
            if incoming.name == "HEARTBEAT":
                self.vehicle.identity_problem = self._selector.problem(incoming, self.now)
            if source == self.target:
                self.take(incoming)

    def take(self, incoming: Message) -> None:
        """Process a message of the vehicle."""
        at = self.now
        if incoming.name == "GLOBAL_POSITION_INT":
            late_s = self.timing.take_position(incoming.integer("time_boot_ms"), at)
            if late_s is None or self._restarted():
                return
            at -= late_s
        elif incoming.has("time_boot_ms"):
            at -= self.timing.age_s(incoming.integer("time_boot_ms"), at)
        elif incoming.name == "TIMESYNC":
            self.timing.take_reply(incoming.integer("tc1"), incoming.integer("ts1"), at)
            if self._restarted():
                return
        self.vehicle.position_checks.pace = self.timing.pace
        self.vehicle.take(incoming, at)
        self._subscriptions.take(incoming)
        if incoming.name == "HEARTBEAT":
            self._on_heartbeat()
        if incoming.name in {"GLOBAL_POSITION_INT", "HEARTBEAT", "EXTENDED_SYS_STATE"}:
            self.notify()

    def _restarted(self) -> bool:
        """Return True if the vehicle has restarted. The link then reconnects, because rates and parameters must be set again."""
        if self.timing.restarted and not self._broken.is_set():
            log.warning("link: autopilot restarted, reconnecting (url=%s)", self.url)
            self._broken.set()
        return self.timing.restarted

    def notify(self) -> None:
        """Wake the callers of `update`."""
        self._updated.set()
        self._updated = asyncio.Event()

    async def update(self, timeout_s: float) -> bool:
        """Wait for an update of the vehicle's state; return False after the timeout."""
        event = self._updated
        try:
            async with asyncio.timeout(timeout_s):
                await event.wait()
        except TimeoutError:
            return False
        return True

    def subscribe(self, *names: str) -> AbstractContextManager[asyncio.Queue[Message]]:
        """Queue the vehicle's messages with these names until the block ends."""
        return self._subscriptions.subscribe(*names)

    def address(self, *, silent: bool = False) -> dict[str, int]:
        """Return the target fields of messages to the vehicle.

        Args:
            silent: True for messages that are also sent to a vehicle without recent heartbeats.

        Raises:
            AutopilotError: The vehicle was not identified since the connection was opened. Unless `silent` is True, also if the
                vehicle sends no heartbeats.
        """
        if self.target is None or not (silent or self.connected):
            raise AutopilotError("the autopilot is not connected", link=True)
        return {"target_system": self.target[0], "target_component": self.target[1]}
