"""Commands of the autopilot: each is acknowledged, or sent again, or fails with a reason."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from contextlib import nullcontext, suppress

from fractus_core.control.state import FlightMode
from fractus_runtime.mavlink_codec import Message, Value, enum_name, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError
from fractus_services.mobility.autopilot import COURSE_S, Permit, always
from fractus_services.mobility.mavlink.acknowledgements import ACK_TIMEOUT_S, Acknowledgements, Answer
from fractus_services.mobility.mavlink.companion import SYSTEM_ID
from fractus_services.mobility.mavlink.flight_stack import FlightStack
from fractus_services.mobility.mavlink.home_watch import HomeWatch
from fractus_services.mobility.mavlink.link import Link, ignore
from fractus_services.mobility.mavlink.neighbours import Memory
from fractus_services.mobility.mavlink.orders import Orders, Velocity, moves
from fractus_services.mobility.mavlink.parameters import Parameters
from fractus_services.mobility.mavlink.pointing import point
from fractus_services.mobility.mavlink.streams import Streams

log = logging.getLogger(__name__)

MODE_TIMEOUT_S = 2.0
REJECTED_RETRY_S = 0.3
TAKEOFF_TIMEOUT_S = 3.0
ATTEMPTS = 4

# In common.xml, but not in the dialect that pymavlink 2.4.50 ships.
_MAV_RESULT_CANCELLED = 6

_AT_ONCE = frozenset({mavlink.MAV_CMD_DO_SET_MODE})
_RESULTS: dict[int, str] = {
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED: "temporarily rejected",
    mavlink.MAV_RESULT_DENIED: "denied",
    mavlink.MAV_RESULT_UNSUPPORTED: "unsupported",
    mavlink.MAV_RESULT_FAILED: "failed",
    _MAV_RESULT_CANCELLED: "cancelled",
}
_VELOCITY_AND_YAW = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
)  # fmt: skip
_VELOCITY_ONLY = _VELOCITY_AND_YAW | mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE


class MavlinkAutopilot(Link):
    """One vehicle behind one link, and what it can be told.

    Args:
        url: the link, see `open_link`.
        stack: the vehicle's firmware.
        alive, on_found, on_heartbeat, sysid, memory, received, sent: see `Link`.
        on_parameter: called with the name of a parameter that someone else changed.

    Attributes:
        starting: held by the one who prepares to start the motors.
        vehicle_parameters: reads and writes the vehicle's parameters.
    """

    def __init__(
        self,
        url: str,
        stack: FlightStack,
        *,
        alive: Callable[[], bool] = lambda: True,
        on_found: Callable[[], None] = lambda: None,
        on_heartbeat: Callable[[], None] = lambda: None,
        on_parameter: Callable[[str], None] = lambda _name: None,
        sysid: int = SYSTEM_ID,
        memory: Memory | None = None,
        received: Callable[[bytes], None] = ignore,
        sent: Callable[[bytes], None] = ignore,
    ) -> None:
        super().__init__(
            url,
            stack,
            alive=alive,
            on_found=on_found,
            on_heartbeat=on_heartbeat,
            sysid=sysid,
            memory=memory,
            received=received,
            sent=sent,
        )
        self.starting = asyncio.Lock()
        self.vehicle_parameters = Parameters(self, on_parameter)
        self._locks: dict[int, asyncio.Lock] = {}
        self._acknowledgements = Acknowledgements(sysid, self.timing)
        self._streams, self._home_watch = Streams(), HomeWatch(self)
        self._probing: asyncio.Task[None] | None = None
        self._orders = Orders()

    @property
    def way_s(self) -> float:
        """See `Autopilot`."""
        return self.timing.way_s(self.now)

    @property
    def pending(self) -> tuple[Velocity, ...]:
        """What the vehicle was told of late, or turns onto; how fast it speeds up is known from velocities that go back further."""
        vehicle, moment = self.vehicle, self.now - (self.latency_s + COURSE_S) / self.pace
        return self._orders.since(moment, (vehicle.north_mps, vehicle.east_mps, vehicle.down_mps))

    @property
    def at_rest(self) -> bool:
        """Whether the vehicle surely stands, and was told nothing else."""
        return self.vehicle.at_rest(self.now) and not any(map(moves, self.pending))

    def _probe(self, due: float) -> None:
        """A vehicle that answers no TIMESYNC acknowledges a command that changes nothing."""
        super()._probe(due)
        if self.timing.unanswering and self.connected and (self._probing is None or self._probing.done()):
            self._probing = asyncio.get_running_loop().create_task(self._probe_by_command())

    async def _probe_by_command(self) -> None:
        with suppress(AutopilotError):
            await self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HEARTBEAT, attempts=1)

    def _lost(self) -> None:
        self.vehicle.gimbal_measured = self.vehicle.gimbal_limits = None
        self.vehicle.unclear = ""
        # The first heartbeat of a new connection is believed: the drone may have landed meanwhile.
        self.vehicle.stopping_at = -math.inf
        for part in (self._streams, self._home_watch, self._acknowledgements, self.vehicle_parameters):
            part.forget()

    def take(self, incoming: Message) -> None:
        """Hand on a message of the vehicle."""
        self._streams.take(incoming.name)
        if incoming.name == "PARAM_VALUE":
            self.vehicle_parameters.take(incoming)
        elif incoming.name == "COMMAND_ACK":
            self._acknowledgements.take(incoming, self.now)
        elif incoming.name == "GIMBAL_DEVICE_ATTITUDE_STATUS" and self.vehicle.gimbal_measured is None:
            self.vehicle_parameters.ask(self.stack.gimbal_type)
        super().take(incoming)
        self._home_watch.take(incoming.name)

    async def command(
        self,
        command: int,
        *params: float,
        place: tuple[float, float, float] | None = None,
        frame: int = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
        permit: Permit = always,
        attempts: int = ATTEMPTS,
    ) -> None:
        """Run a MAVLink command and wait for its acknowledgement.

        Args:
            command: which.
            params: param1 onwards; the rest is zero.
            place: latitude, longitude and altitude: sends COMMAND_INT.
            frame: what the altitude is measured from; home by default.
            permit: asked before each sending; what it raises ends the command.
            attempts: how often to send it.

        Raises:
            AutopilotError: it was refused, or there was no answer.
        """
        # Sent again, one would undo another. No change of mode waits for one without an answer, for it may be the way home.
        async with nullcontext() if command in _AT_ONCE else self._locks.setdefault(command, asyncio.Lock()):
            answer = Answer()
            for attempt in range(attempts):
                permit()
                if attempt and self._acknowledgements.overtaken(command, answer):
                    raise AutopilotError(
                        f"a later command {enum_name('MAV_CMD', command)} has overtaken one that was not answered",
                        link=True,
                    )
                answer = Answer() if answer.done() else answer
                result = await self._attempt(
                    _outgoing(command, params, place, frame, confirmation=attempt, **self.address()), command, answer
                )
                if result is None:
                    continue
                if result == mavlink.MAV_RESULT_ACCEPTED:
                    return
                if result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED and attempt + 1 < attempts:
                    await asyncio.sleep(REJECTED_RETRY_S)
                    continue
                raise AutopilotError(self._refusal(command, result), refused=True)
        raise AutopilotError(f"the autopilot did not answer command {enum_name('MAV_CMD', command)}", link=True)

    async def _attempt(self, outgoing: Message, command: int, answer: Answer) -> int | None:
        """The result of a command that is sent, for the first time or again; None without one in time."""
        self._acknowledgements.sent(command, answer, self.now)
        self.send(outgoing)
        if not answer.done():
            await asyncio.wait([answer], timeout=self._acknowledgements.timeout_s)
        return answer.result() if answer.done() else None

    def _refusal(self, command: int, result: int) -> str:
        why = [t for t in self.vehicle.texts[-4:] if self.stack.explains_refusal(t)]
        said = f": {why[-1]}" if why else ""
        return f"the autopilot {_RESULTS.get(result, 'refused')} command {enum_name('MAV_CMD', command)}{said}"

    async def set_mode(self, mode: FlightMode, permit: Permit = always) -> None:
        """Change the flight mode and wait until the autopilot flies it."""
        await self.command(
            mavlink.MAV_CMD_DO_SET_MODE,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
            *self.stack.mode_parameters(mode),
            permit=permit,
        )
        deadline = self.now + MODE_TIMEOUT_S
        while self.vehicle.mode != mode:
            if self.now > deadline:
                raise AutopilotError(f"the autopilot accepted mode {mode.name} and stays in {self.vehicle.mode.name}")
            await self.update(0.3)

    async def arm(self, permit: Permit = always) -> None:
        """Start the motors."""
        self.vehicle.texts.clear()
        await self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, permit=permit)

    async def disarm(self, permit: Permit = always) -> None:
        """Stop the motors; the autopilot refuses in the air."""
        await self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, permit=permit)

    async def set_home(self, lat: float, lon: float, amsl_m: float) -> None:
        """Fix home, so that arming elsewhere does not move it."""
        await self.command(mavlink.MAV_CMD_DO_SET_HOME, place=(lat, lon, amsl_m), frame=mavlink.MAV_FRAME_GLOBAL)

    async def take_off(self, altitude_m: float, permit: Permit = always) -> None:
        """Begin to climb to an altitude above home."""
        for attempt in range(ATTEMPTS):
            try:
                await self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m, permit=permit, attempts=1)
            except AutopilotError as error:
                # A vehicle that takes off already, though its acknowledgement was lost, refuses to do so again.
                if attempt and not error.link and await self._takes_off():
                    return
                if not error.link or attempt + 1 == ATTEMPTS:
                    raise
            else:
                return

    async def _takes_off(self) -> bool:
        deadline = self.now + TAKEOFF_TIMEOUT_S
        while not self.vehicle.in_air and self.now < deadline:
            await self.update(ACK_TIMEOUT_S)
        return self.vehicle.in_air

    async def go_to(
        self, lat: float, lon: float, altitude_m: float, yaw_deg: float | None, permit: Permit = always
    ) -> None:
        """Begin to fly straight to a point; altitude above home.

        The autopilot falls back to its own speed when it was not flying to a place before: see `set_speed`.
        """
        yaw = math.nan if yaw_deg is None else yaw_deg

        def ordered() -> None:
            permit()
            self._orders.go_to(lat, lon, altitude_m, self.vehicle, self.now)

        await self.command(mavlink.MAV_CMD_DO_REPOSITION, -1, 0, 0, yaw, place=(lat, lon, altitude_m), permit=ordered)

    async def turn(self, yaw_deg: float, permit: Permit = always) -> None:
        """Point the nose, on the leg under way."""
        await self.command(mavlink.MAV_CMD_CONDITION_YAW, yaw_deg % 360.0, 0, 0, 0, permit=permit)

    async def set_speed(self, speed_mps: float, permit: Permit = always) -> None:
        """Fly the leg under way with this horizontal speed over ground; one to a place may begin with the default again."""
        await self.command(
            mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.SPEED_TYPE_GROUNDSPEED, speed_mps, -1, permit=permit
        )

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float, permit: Permit = always) -> None:
        """Turn the camera: pitch over the horizon, yaw clockwise from the nose."""
        await point(self, pitch_deg, yaw_deg, permit)

    def stop(self) -> None:
        """Brake and hold: a velocity of zero; GUIDED keeps the position when it times out."""
        self.fly(0.0, 0.0, 0.0)

    def fly(self, north_mps: float, east_mps: float, down_mps: float, yaw_deg: float | None = None) -> None:
        """Fly with a velocity over ground, which the autopilot gives up by itself after GUID_TIMEOUT."""
        if self.found:
            self._orders.fly((north_mps, east_mps, down_mps), self.now)
            self.send(
                message(
                    "SET_POSITION_TARGET_LOCAL_NED",
                    coordinate_frame=mavlink.MAV_FRAME_LOCAL_NED,
                    type_mask=_VELOCITY_ONLY if yaw_deg is None else _VELOCITY_AND_YAW,
                    vx=north_mps,
                    vy=east_mps,
                    vz=down_mps,
                    yaw=math.radians(yaw_deg or 0.0),
                    **self.recipient(),
                )
            )

    async def set_rates(self, flying: bool) -> None:
        """Ask for the streams, more often in the air, and again for those that do not come."""
        await self._streams.ask(self, flying)

    async def ask_home(self) -> None:
        """Ask for the home position now."""
        await self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HOME_POSITION)


def _outgoing(
    command: int,
    params: tuple[float, ...],
    place: tuple[float, float, float] | None,
    frame: int,
    *,
    confirmation: int,
    **address: int,
) -> Message:
    values: dict[str, Value] = {f"param{i}": float(value) for i, value in enumerate(params, 1)}
    values |= {"command": command, **address}
    if place is None:
        return message("COMMAND_LONG", confirmation=confirmation, **values)
    # COMMAND_INT has degrees times 1e7; the 32-bit floats of COMMAND_LONG would be metres off.
    values |= {"frame": frame, "x": round(place[0] * 1e7), "y": round(place[1] * 1e7), "z": place[2]}
    return message("COMMAND_INT", **values)
