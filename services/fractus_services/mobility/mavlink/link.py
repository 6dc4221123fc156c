"""The one link to the autopilot: connects for ever, streams its state, carries commands and parameters."""

from __future__ import annotations

import asyncio
import logging
import math
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.dialect import Codec, message
from fractus_services.mobility.mavlink.transport import BadUrl, Transport, open_link
from fractus_services.mobility.mavlink.vehicle import Vehicle

log = logging.getLogger(__name__)

SYSTEM_ID, COMPONENT_ID = 244, 191
"""The companion is a system of its own, whose heartbeats alone hold off the autopilot's failsafe: ground stations, which
are 255 as a rule, must not. 191 is the onboard computer."""

HEARTBEAT_S = 1.0
SILENCE_S = 3.0
RECONNECT_AFTER_S = 6.0
BACKOFF_S = (0.2, 3.0)
ACK_TIMEOUT_S = 0.7
ATTEMPTS = 4

_ONBOARD_CONTROLLER, _NO_AUTOPILOT, _ACTIVE = 18, 8, 4
_GLOBAL, _GLOBAL_RELATIVE = 0, 6
_SET_HOME = 179
_SET_MODE, _ARM, _TAKEOFF, _SPEED, _REPOSITION, _YAW, _INTERVAL, _REQUEST = 176, 400, 22, 178, 192, 115, 511, 512
_ACCEPTED, _TEMPORARILY_REJECTED, _IN_PROGRESS = 0, 1, 5
_RESULTS = {1: "temporarily rejected", 2: "denied", 3: "unsupported", 4: "failed", 6: "cancelled"}
_VELOCITY_ONLY, _VELOCITY_AND_YAW = 0x0DC7, 0x09C7
_LOCAL_NED = 1

# Message ids and their rates in Hz on the ground and in the air.
STREAMS = {33: (4.0, 20.0), 30: (2.0, 10.0), 245: (2.0, 5.0), 1: (1.0, 1.0), 24: (1.0, 2.0), 242: (0.2, 0.2)}


Permit = Callable[[], None]
"""Asked before each sending of a command; raises when it must not be sent any more."""


def always() -> None:
    """The permit of what may be sent at any time."""


class Autopilot:
    """One ArduPilot vehicle behind one link.

    Args:
        url: the link, see `open_link`.

    Attributes:
        vehicle: the streamed state.
        on_message: called for every message after the state took it.
        on_found: called when the vehicle is heard first, again after each reconnection.
        alive: whether the companion does its duty; when not, no heartbeat holds off the autopilot's own failsafe.
        starting: held by the one who prepares to start the motors.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.on_message: Callable[[Any], None] = lambda _m: None
        self.on_found: Callable[[], None] = lambda: None
        self.alive: Callable[[], bool] = lambda: True
        self.vehicle = Vehicle()
        self.starting = asyncio.Lock()
        self._codec = Codec(SYSTEM_ID, COMPONENT_ID)
        self._transport: Transport | None = None
        self._target: tuple[int, int] | None = None
        self._broken = asyncio.Event()
        self._updated = asyncio.Event()
        self._acks: dict[int, asyncio.Queue[Any]] = {}
        self._params: dict[str, asyncio.Queue[float]] = {}
        self._listeners: list[tuple[frozenset[str], asyncio.Queue[Any]]] = []
        self._locks: dict[int | str, asyncio.Lock] = {}
        self._flying_rates: bool | None = None

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
                self._codec = Codec(SYSTEM_ID, COMPONENT_ID)
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
            self._flying_rates = None

    def beat(self) -> None:
        """Send a heartbeat now, if the companion does its duty."""
        self._heartbeat()

    def _heartbeat(self) -> None:
        if not self.alive():
            if not self.found:
                self._knock()
            return
        self.send(
            message(
                "HEARTBEAT", type=_ONBOARD_CONTROLLER, autopilot=_NO_AUTOPILOT, system_status=_ACTIVE, mavlink_version=3
            )
        )

    def _knock(self) -> None:
        """Speak without a heartbeat: an autopilot behind a datagram link answers to whom it has heard."""
        self.send(message("PARAM_REQUEST_READ", param_index=-1, param_id=b"FS_GCS_ENABLE"))

    def send(self, outgoing: Any) -> None:
        """Send a message; without a link it is dropped."""
        if self._transport is not None:
            self._transport.write(self._codec.encode(outgoing))

    def _closed(self, error: Exception | None) -> None:
        if error is not None:
            log.warning("autopilot link: %s", error)
        self._broken.set()

    def _received(self, data: bytes) -> None:
        for incoming in self._codec.decode(data):
            source = (incoming.get_srcSystem(), incoming.get_srcComponent())
            if self._target is None:
                if incoming.get_type() != "HEARTBEAT" or incoming.autopilot == _NO_AUTOPILOT:
                    continue
                self._target = source
                self.vehicle.take(incoming, self.now)
                self.on_found()
            if source == self._target:
                self._take(incoming)

    def _take(self, incoming: Any) -> None:
        kind = incoming.get_type()
        self.vehicle.take(incoming, self.now)
        if kind == "COMMAND_ACK":
            if incoming.command in self._acks:
                self._acks[incoming.command].put_nowait(incoming)
        elif kind == "PARAM_VALUE":
            name = _text(incoming.param_id)
            if name in self._params:
                self._params[name].put_nowait(float(incoming.param_value))
        for kinds, queue in self._listeners:
            if kind in kinds:
                queue.put_nowait(incoming)
        self.on_message(incoming)
        if kind in {"GLOBAL_POSITION_INT", "HEARTBEAT", "EXTENDED_SYS_STATE"}:
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
    def listening(self, *kinds: str) -> Iterator[asyncio.Queue[Any]]:
        """The vehicle's messages of some kinds, from now until the block ends."""
        listener = frozenset(kinds), asyncio.Queue[Any]()
        self._listeners.append(listener)
        try:
            yield listener[1]
        finally:
            self._listeners.remove(listener)

    def address(self) -> dict[str, int]:
        """The vehicle, as messages name their target.

        Raises:
            AutopilotError: it is not connected.
        """
        if self._target is None or not self.connected:
            raise AutopilotError("the autopilot is not connected", link=True)
        return {"target_system": self._target[0], "target_component": self._target[1]}

    # Commands

    async def command(
        self,
        number: int,
        *params: float,
        place: tuple[float, float, float] | None = None,
        frame: int = _GLOBAL_RELATIVE,
        permit: Permit = always,
        attempts: int = ATTEMPTS,
    ) -> None:
        """Run a MAVLink command and wait for its acknowledgement.

        Args:
            number: MAV_CMD.
            params: param1 onwards; the rest is zero.
            place: latitude, longitude and altitude: sends COMMAND_INT.
            frame: what the altitude is measured from; home by default.
            permit: asked before each sending; what it raises ends the command.
            attempts: how often to send it.

        Raises:
            AutopilotError: it was refused, or nobody answered.
        """
        async with self._locks.setdefault(number, asyncio.Lock()):
            for attempt in range(attempts):
                permit()
                ack = await self._attempt(self._outgoing(number, attempt, params, place, frame), number)
                if ack is None:
                    continue
                if ack.result == _ACCEPTED:
                    return
                if ack.result == _TEMPORARILY_REJECTED and attempt + 1 < attempts:
                    await asyncio.sleep(0.3)
                    continue
                raise AutopilotError(self._refusal(number, ack.result))
        raise AutopilotError(f"the autopilot did not answer command {number}", link=True)

    def _outgoing(
        self,
        number: int,
        attempt: int,
        params: tuple[float, ...],
        place: tuple[float, float, float] | None,
        frame: int,
    ) -> Any:
        address = self.address()
        values = {f"param{i}": float(value) for i, value in enumerate(params, 1)}
        if place is None:
            return message("COMMAND_LONG", command=number, confirmation=attempt, **address, **values)
        return message(
            "COMMAND_INT", command=number, frame=frame, x=round(place[0] * 1e7),
            y=round(place[1] * 1e7), z=place[2], **address, **values,
        )  # fmt: skip

    async def _attempt(self, outgoing: Any, number: int) -> Any:
        acks = self._acks[number] = asyncio.Queue()
        try:
            self.send(outgoing)
            async with asyncio.timeout(ACK_TIMEOUT_S):
                while True:
                    ack = await acks.get()
                    if ack.result != _IN_PROGRESS:
                        return ack
        except TimeoutError:
            return None
        finally:
            del self._acks[number]

    def _refusal(self, number: int, result: int) -> str:
        why = [t for t in self.vehicle.texts[-4:] if t.startswith(("Arm", "PreArm", "Mode", "Takeoff"))]
        said = f": {why[-1]}" if why else ""
        return f"the autopilot {_RESULTS.get(result, 'refused')} command {number}{said}"

    async def set_mode(self, mode: int, permit: Permit = always) -> None:
        """Change the flight mode and wait until the autopilot flies it."""
        await self.command(_SET_MODE, 1, mode, permit=permit)
        deadline = self.now + 2.0
        while self.vehicle.mode != mode:
            if self.now > deadline:
                raise AutopilotError(f"the autopilot accepted mode {mode} and stays in {self.vehicle.mode_name}")
            await self.update(0.3)

    async def arm(self, permit: Permit = always) -> None:
        """Start the motors."""
        self.vehicle.texts.clear()
        await self.command(_ARM, 1, permit=permit)

    async def disarm(self, permit: Permit = always) -> None:
        """Stop the motors; the autopilot refuses in the air."""
        await self.command(_ARM, 0, permit=permit)

    async def set_home(self, lat: float, lon: float, amsl_m: float) -> None:
        """Fix home, so that arming elsewhere does not move it."""
        await self.command(_SET_HOME, place=(lat, lon, amsl_m), frame=_GLOBAL)

    async def take_off(self, altitude_m: float, permit: Permit = always) -> None:
        """Begin to climb to an altitude above home."""
        await self.command(_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m, permit=permit)

    async def go_to(
        self, lat: float, lon: float, altitude_m: float, yaw_deg: float | None, permit: Permit = always
    ) -> None:
        """Begin to fly straight to a point; altitude above home.

        The autopilot falls back to its own speed when it was not flying to a place before: see `set_speed`.
        """
        yaw = math.nan if yaw_deg is None else yaw_deg
        await self.command(_REPOSITION, -1, 0, 0, yaw, place=(lat, lon, altitude_m), permit=permit)

    async def turn(self, yaw_deg: float, permit: Permit = always) -> None:
        """Point the nose, on the leg under way."""
        await self.command(_YAW, yaw_deg % 360.0, 0, 0, 0, permit=permit)

    async def set_speed(self, speed_mps: float, permit: Permit = always) -> None:
        """Fly the leg under way with this horizontal speed over ground; one to a place may begin with the default again."""
        await self.command(_SPEED, 1, speed_mps, -1, permit=permit)

    def stop(self) -> None:
        """Brake and hold: a velocity of zero; GUIDED keeps the position when it times out."""
        self.fly(0.0, 0.0, 0.0)

    def fly(self, north_mps: float, east_mps: float, down_mps: float, yaw_deg: float | None = None) -> None:
        """Fly with a velocity over ground, which the autopilot gives up by itself after GUID_TIMEOUT."""
        target = self._target
        if target is not None:
            self.send(
                message(
                    "SET_POSITION_TARGET_LOCAL_NED", coordinate_frame=_LOCAL_NED, vx=north_mps, vy=east_mps, vz=down_mps,
                    type_mask=_VELOCITY_ONLY if yaw_deg is None else _VELOCITY_AND_YAW, yaw=math.radians(yaw_deg or 0.0),
                    target_system=target[0], target_component=target[1],
                )
            )  # fmt: skip

    async def set_rates(self, flying: bool) -> None:
        """Ask for the streams, more often in the air; one that is refused comes at the autopilot's own rate."""
        if self._flying_rates is flying:
            return
        self._flying_rates = flying
        for number, rates in STREAMS.items():
            try:
                await self.command(_INTERVAL, number, 1e6 / rates[flying], attempts=2)
            except AutopilotError as error:
                log.warning("message %d comes at its own rate: %s", number, error)

    async def ask_home(self) -> None:
        """Ask for the home position now."""
        await self.command(_REQUEST, 242)

    # Parameters

    async def read_parameter(self, name: str, attempts: int = ATTEMPTS) -> float | None:
        """A parameter's value; None when the vehicle does not have it."""
        target = self._target
        if target is None:
            raise AutopilotError("the autopilot is not connected", link=True)
        request = message(
            "PARAM_REQUEST_READ", param_index=-1, param_id=name.encode(),
            target_system=target[0], target_component=target[1],
        )  # fmt: skip
        return await self._exchange(name, request, attempts)

    async def write_parameter(self, name: str, value: float) -> float | None:
        """Set a parameter; returns what the vehicle says it is now."""
        target = self._target
        if target is None:
            raise AutopilotError("the autopilot is not connected", link=True)
        request = message(
            "PARAM_SET", param_id=name.encode(), param_value=value, param_type=9,
            target_system=target[0], target_component=target[1],
        )  # fmt: skip
        return await self._exchange(name, request, ATTEMPTS)

    async def _exchange(self, name: str, request: Any, attempts: int) -> float | None:
        async with self._locks.setdefault(name, asyncio.Lock()):
            answers = self._params[name] = asyncio.Queue()
            try:
                for _ in range(attempts):
                    self.send(request)
                    try:
                        async with asyncio.timeout(ACK_TIMEOUT_S):
                            return await answers.get()
                    except TimeoutError:
                        continue
            finally:
                del self._params[name]
        return None


def _text(value: Any) -> str:
    raw = value if isinstance(value, bytes) else str(value).encode()
    return raw.split(b"\0", 1)[0].decode("ascii", "replace")
