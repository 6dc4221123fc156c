"""The vehicle behind a MAVLink link: commands, their acknowledgements, and setpoints."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext, suppress

from fractus_core.control.state import FlightMode
from fractus_core.geo import LocalFrame
from fractus_core.policy.decision_types import STATIONARY_MPS
from fractus_runtime import tracing
from fractus_runtime.mavlink_codec import Message, Value, enum_name, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError
from fractus_services.mobility.autopilot import LEG_MPS, VELOCITY_HISTORY_S, Permit, VehicleState, always
from fractus_services.mobility.mavlink.autopilot_link import AutopilotLink, ignore
from fractus_services.mobility.mavlink.companion import SYSTEM_ID
from fractus_services.mobility.mavlink.expected_position import ExpectedPositionFile
from fractus_services.mobility.mavlink.flight_stack import FlightStack
from fractus_services.mobility.mavlink.gimbal import point
from fractus_services.mobility.mavlink.parameters import Parameters
from fractus_services.mobility.mavlink.telemetry_requests import HomePositionMonitor, TelemetryRates
from fractus_services.mobility.mavlink.timing import Timing
from fractus_services.mobility.mavlink.vehicle_identification import KnownVehicleFile

log = logging.getLogger(__name__)

MODE_TIMEOUT_S = 2.0
REJECTED_RETRY_S = 0.3
TAKEOFF_TIMEOUT_S = 3.0
COMMAND_ATTEMPTS = 4

# In common.xml, but not in the dialect that pymavlink 2.4.50 ships.
_MAV_RESULT_CANCELLED = 6

_NOT_SERIALIZED = frozenset({mavlink.MAV_CMD_DO_SET_MODE})
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

ACK_TIMEOUT_S = 0.7
MAX_ACK_TIMEOUT_S = 3.0
ACK_SLACK_S = 0.2
"""Time by which an acknowledgement may be slower than the slowest recent answer."""

MAX_UNACKNOWLEDGED = 16
"""Maximum number of stored transmissions of a command. It limits the memory if a vehicle sends no acknowledgements."""

Answer = asyncio.Future[int]

Velocity = tuple[float, float, float]
"""North, east and down, m/s."""

MAX_SETPOINTS = 200
"""Maximum number of stored setpoints.

Within the longest latency with which the service flies, it sends fewer setpoints.
"""

TURNED_MPS = 0.5
"""A vehicle has turned onto its course if its speed across the course is at most this value."""

LEVEL_M = 0.3
"""Height difference up to which a leg counts as level, in metres."""


class Acknowledgements:
    """Transmissions that are not acknowledged yet, by command.

    COMMAND_ACK contains the command id only. A command that was sent twice is acknowledged twice, and the second
    acknowledgement must not count for the next command with the same id. Links preserve the order of messages. Each
    acknowledgement is therefore assigned to the oldest transmission that can still be answered according to the
    measured delay of the link.

    Args:
        sysid: System id of the sender of the commands. Acknowledgements for other systems are ignored.
        timing: Delays of the link; receives the delay of each acknowledgement.
    """

    def __init__(self, sysid: int, timing: Timing) -> None:
        self._sysid = sysid
        self._timing = timing
        self._sent: dict[int, deque[tuple[float, Answer]]] = {}
        self._latest: dict[int, Answer] = {}
        self._last: tuple[bytes, float] = b"", -math.inf

    @property
    def timeout_s(self) -> float:
        """Time after which a transmission without an acknowledgement counts as lost, in seconds."""
        return max(ACK_TIMEOUT_S, min(self._timing.answer_s + ACK_SLACK_S, MAX_ACK_TIMEOUT_S))

    def _answerable_s(self, now: float) -> float:
        """Return the time for which a transmission can still be answered, in seconds.

        A short time without answers means that the link is becoming slow. A longer time means that the link was interrupted, so
        that the sent commands are lost.
        """
        answer_s = max(self._timing.answer_s, min(self._timing.silence_s(now), MAX_ACK_TIMEOUT_S))
        return max(ACK_TIMEOUT_S, answer_s + ACK_SLACK_S)

    def add_transmission(self, command: int, answer: Answer, now: float) -> None:
        """Record that a command is being sent, for the first time or again.

        Args:
            command: MAV_CMD.
            answer: Future that receives the result of this or another transmission of the same command.
            now: Monotonic seconds.
        """
        self._sent.setdefault(command, deque(maxlen=MAX_UNACKNOWLEDGED)).append((now, answer))
        self._latest[command] = answer

    def is_overtaken(self, command: int, answer: Answer) -> bool:
        """Return True if another command with the same id was sent after the command of this answer."""
        return self._latest.get(command, answer) is not answer

    def take(self, acknowledgement: Message, now: float) -> None:
        """Assign an acknowledgement to its transmission and set the result."""
        if acknowledgement.integer("target_system") not in {0, self._sysid} or self._is_duplicate(acknowledgement, now):
            return
        command = acknowledgement.integer("command")
        result = acknowledgement.integer("result")
        transmissions = self._sent.setdefault(command, deque(maxlen=MAX_UNACKNOWLEDGED))
        # Keep the last transmission: when the link becomes slow, its answer arrives before the new delay is measured.
        while len(transmissions) > 1 and now - transmissions[0][0] > self._answerable_s(now):
            transmissions.popleft()
        if not transmissions:
            log.debug("commands: unexpected acknowledgement (command=%d, result=%d)", command, result)
            return
        sent_at, answer = transmissions.popleft()
        # The acknowledgement of an abandoned command measures the link as well.
        self._timing.take_acknowledgement(sent_at, now)
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            transmissions.appendleft((now, answer))  # The final acknowledgement follows.
        elif answer.done():
            log.debug("commands: acknowledgement of an earlier transmission (command=%d, result=%d)", command, result)
        else:
            answer.set_result(result)

    def _is_duplicate(self, acknowledgement: Message, now: float) -> bool:
        """Return True if the network delivered the last acknowledgement twice.

        Frames contain sequence numbers, so only copies of one frame are equal.
        """
        frame, at = self._last
        self._last = acknowledgement.frame, now
        return frame != b"" and frame == acknowledgement.frame and now - at < ACK_TIMEOUT_S

    def forget(self) -> None:
        """Drop all transmissions, because the connection broke."""
        self._sent.clear()


class RecentSetpoints:
    """Recent setpoints, which the vehicle's reported state may not reflect yet.

    The times of the first and of the last transmission of each setpoint are stored.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[float, float, Velocity]] = deque(maxlen=MAX_SETPOINTS)

    def add_velocity(self, velocity: Velocity, now: float) -> None:
        """Record that a velocity setpoint is being sent now.

        A repetition of the latest setpoint only updates the time of its last transmission.
        """
        first = self._sent.pop()[0] if self._sent and self._sent[-1][2] == velocity else now
        self._sent.append((first, now, velocity))

    def add_leg(self, lat: float, lon: float, altitude_m: float, vehicle: VehicleState, now: float) -> None:
        """Add a leg from the vehicle's position to a point.

        The speed of a leg is unknown, so the leg is stored as a velocity towards the point with the placeholder
        `LEG_MPS`.
        """
        if vehicle.lat is None or vehicle.lon is None:
            return
        east, north = LocalFrame(vehicle.lat, vehicle.lon).xy(lat, lon)
        share = LEG_MPS / max(math.hypot(east, north), 1e-3)
        sink = vehicle.altitude_m - altitude_m
        down = math.copysign(LEG_MPS, sink) if abs(sink) > LEVEL_M else 0.0
        self.add_velocity((north * share, east * share, down), now)

    def pending_since(self, earliest: float, measured: Velocity) -> tuple[Velocity, ...]:
        """Return the setpoints that the vehicle may still be reacting to, the latest last. Drop older setpoints.

        Setpoints sent after `earliest` are always included. The setpoint that was in force at `earliest` is included in two
        cases. If it is a velocity command, the vehicle brakes only until it has reached that velocity. If it is a leg, and
        the vehicle still turns towards the leg, the vehicle will not continue in its measured direction.

        Args:
            earliest: Time on the clock of `add_velocity`.
            measured: The vehicle's measured velocity.
        """
        while len(self._sent) > 1 and self._sent[1][0] < earliest:
            self._sent.popleft()
        if self._sent and self._sent[0][1] < earliest:
            setpoint = self._sent[0][2]
            if not _is_held(setpoint) and not is_turning(measured, setpoint):
                self._sent.popleft()
        return tuple(dict.fromkeys(velocity for *_, velocity in reversed(self._sent)))[::-1]


def _is_held(velocity: Velocity) -> bool:
    """Return True if a setpoint is a velocity command. Return False for a stop, and for a leg stored with `LEG_MPS`."""
    return moves(velocity) and max(map(abs, velocity)) < LEG_MPS / 2


def is_turning(velocity: Velocity, setpoint: Velocity) -> bool:
    """Return True if a moving vehicle does not fly in the direction of its setpoint yet."""
    north, east, _ = velocity
    to_north, to_east, _ = setpoint
    length = math.hypot(to_north, to_east)
    if math.hypot(north, east) < STATIONARY_MPS or length < STATIONARY_MPS:
        return False
    along = (north * to_north + east * to_east) / length
    across = (north * to_east - east * to_north) / length
    return along < -TURNED_MPS or abs(across) > TURNED_MPS


def moves(velocity: Velocity) -> bool:
    """Return True if a vehicle with this velocity is not stationary."""
    north, east, down = velocity
    return math.hypot(north, east) >= STATIONARY_MPS or abs(down) >= STATIONARY_MPS


class MavlinkAutopilot(AutopilotLink):
    """One vehicle behind one link, and its commands. Commands and setpoints appear in the traces of the calls that caused them.

    Args:
        url: URL of the autopilot, see `open_link`.
        stack: Firmware of the autopilot.
        alive, on_found, on_heartbeat, sysid, known_vehicle, received, sent: See `AutopilotLink`.
        on_parameter: Callback invoked with the name of a parameter that another station changed.
        expected_position: File with the expected position while the reported position is not trusted.

    Attributes:
        starting: Lock held while the start of the motors is being prepared.
        vehicle_parameters: Access to the vehicle's parameters.
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
        known_vehicle: KnownVehicleFile | None = None,
        expected_position: ExpectedPositionFile | None = None,
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
            known_vehicle=known_vehicle,
            received=received,
            sent=sent,
        )
        self.starting = asyncio.Lock()
        self._expected_position = expected_position
        if expected_position is not None:
            expected_position.apply_to(self.vehicle.position_checks)
        self.vehicle_parameters = Parameters(self, on_parameter)
        self._locks: dict[int, asyncio.Lock] = {}
        self._acknowledgements = Acknowledgements(sysid, self.timing)
        self._rates = TelemetryRates()
        self._home_monitor = HomePositionMonitor(self)
        self._probing: asyncio.Task[None] | None = None
        self._setpoints = RecentSetpoints()

    @property
    def downlink_latency_s(self) -> float:
        """See `Autopilot`."""
        return self.timing.downlink_latency_s(self.now)

    @property
    def pending(self) -> tuple[Velocity, ...]:
        """Velocities of recent setpoints that the vehicle may still be reacting to.

        Setpoints of the `VELOCITY_HISTORY_S` before are included, because the vehicle's acceleration is computed over that period.
        """
        vehicle = self.vehicle
        earliest = self.now - (self.latency_s + VELOCITY_HISTORY_S) / self.pace
        return self._setpoints.pending_since(earliest, (vehicle.north_mps, vehicle.east_mps, vehicle.down_mps))

    @property
    def at_rest(self) -> bool:
        """True if the vehicle is known to be stationary and no setpoint that moves it is pending."""
        return self.vehicle.at_rest(self.now) and not any(map(moves, self.pending))

    def _probe(self, due: float) -> None:
        """Measure the delay of the link, by a command without effect if the vehicle does not answer TIMESYNC."""
        super()._probe(due)
        if self.timing.unanswering and self.connected and (self._probing is None or self._probing.done()):
            self._probing = asyncio.get_running_loop().create_task(self._probe_by_command())

    async def _probe_by_command(self) -> None:
        with suppress(AutopilotError):
            await self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HEARTBEAT, attempts=1)

    def _lost(self) -> None:
        self.vehicle.gimbal_measured = self.vehicle.gimbal_limits = None
        self.vehicle.identity_problem = ""
        # The vehicle on the next connection may have restarted, or its estimator may have accepted another position meanwhile.
        self.vehicle.estimated_at = -math.inf
        # Let the first heartbeat of a new connection report stopped motors: the drone may have landed meanwhile.
        self.vehicle.stopping_at = -math.inf
        for part in (self._rates, self._home_monitor, self._acknowledgements, self.vehicle_parameters):
            part.forget()

    def take(self, incoming: Message) -> None:
        """Process a message of the vehicle."""
        self._rates.take(incoming.name)
        if incoming.name == "PARAM_VALUE":
            self.vehicle_parameters.take(incoming)
        elif incoming.name == "PARAM_ERROR" and incoming.integer("target_system") in {0, self._sysid}:
            self.vehicle_parameters.take_error(incoming)
        elif incoming.name == "COMMAND_ACK":
            self._acknowledgements.take(incoming, self.now)
        elif incoming.name == "GIMBAL_DEVICE_ATTITUDE_STATUS" and self.vehicle.gimbal_measured is None:
            self.vehicle_parameters.request(self.stack.gimbal_type)
        super().take(incoming)
        self._home_monitor.take(incoming.name)
        checks = self.vehicle.position_checks
        if self._expected_position is not None and incoming.name == "GLOBAL_POSITION_INT" and not checks.blind:
            self._expected_position.keep(checks.expected)

    async def command(
        self,
        command: int,
        *params: float,
        place: tuple[float, float, float] | None = None,
        frame: int = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
        permit: Permit = always,
        attempts: int = COMMAND_ATTEMPTS,
    ) -> None:
        """Run a MAVLink command and wait for its acknowledgement.

        Args:
            command: MAV_CMD.
            params: Parameters from param1 on; the rest is zero.
            place: Latitude, longitude and altitude; sends COMMAND_INT.
            frame: Frame of the altitude; relative to home by default.
            permit: Called before each transmission. An exception that it raises ends the command.
            attempts: Number of transmissions.

        Raises:
            AutopilotError: The autopilot refused the command, or did not answer.
        """
        with tracing.child_span(f"autopilot.{enum_name('MAV_CMD', command)}"):
            # Commands with the same id wait for each other, because a repeated command could undo a later one. Mode
            # changes do not wait for earlier mode changes, because a mode change may start the return flight.
            async with nullcontext() if command in _NOT_SERIALIZED else self._locks.setdefault(command, asyncio.Lock()):
                answer = Answer()
                sent_at = self.now
                for attempt in range(attempts):
                    permit()
                    if attempt and self._acknowledgements.is_overtaken(command, answer):
                        raise AutopilotError(
                            f"a later command {enum_name('MAV_CMD', command)} has overtaken an unanswered one",
                            link=True,
                        )
                    answer = Answer() if answer.done() else answer
                    result = await self._attempt(command, params, place, frame, answer, confirmation=attempt)
                    if result is None:
                        continue
                    if result == mavlink.MAV_RESULT_ACCEPTED:
                        return
                    if result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED and attempt + 1 < attempts:
                        await asyncio.sleep(REJECTED_RETRY_S)
                        continue
                    raise AutopilotError(self._refusal(command, result, sent_at), refused=True)
            raise AutopilotError(f"the autopilot did not answer command {enum_name('MAV_CMD', command)}", link=True)

    async def _attempt(
        self,
        command: int,
        params: tuple[float, ...],
        place: tuple[float, float, float] | None,
        frame: int,
        answer: Answer,
        *,
        confirmation: int,
    ) -> int | None:
        """Send a command, for the first time or again, and return its result; None if no result arrives in time."""
        values: dict[str, Value] = {f"param{i}": float(value) for i, value in enumerate(params, 1)}
        values |= {"command": command, **self.address()}
        if place is None:
            outgoing = message("COMMAND_LONG", confirmation=confirmation, **values)
        else:
            # COMMAND_INT has degrees times 1e7. The 32-bit floats of COMMAND_LONG would be off by metres.
            values |= {"frame": frame, "x": round(place[0] * 1e7), "y": round(place[1] * 1e7), "z": place[2]}
            outgoing = message("COMMAND_INT", **values)
        self._acknowledgements.add_transmission(command, answer, self.now)
        self.send(outgoing)
        if not answer.done():
            await asyncio.wait([answer], timeout=self._acknowledgements.timeout_s)
        return answer.result() if answer.done() else None

    def _refusal(self, command: int, result: int, sent_at: float) -> str:
        """Return a sentence with the reason: a text that the autopilot sent since the command, or else the probable reason."""
        texts = [
            text for at, text in self.vehicle.texts if at >= sent_at and self.stack.explains_refusal(command, text)
        ]
        probable = self.stack.probable_refusal(command) if result == mavlink.MAV_RESULT_FAILED else ""
        reason = ""
        if texts:
            reason = f": {texts[-1]}"
        elif probable:
            reason = f" without a reason; probably {probable}"
        return f"the autopilot {_RESULTS.get(result, 'refused')} command {enum_name('MAV_CMD', command)}{reason}"

    async def set_mode(self, mode: FlightMode, permit: Permit = always) -> None:
        """Change the flight mode and wait until the autopilot reports it."""
        await self.command(
            mavlink.MAV_CMD_DO_SET_MODE,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
            *self.stack.mode_parameters(mode),
            permit=permit,
        )
        deadline = self.now + MODE_TIMEOUT_S
        while self.vehicle.mode != mode:
            if self.now > deadline:
                raise AutopilotError(f"the autopilot accepted mode {mode.name} but remains in {self.vehicle.mode.name}")
            await self.update(0.3)

    async def arm(self, permit: Permit = always) -> None:
        """Start the motors."""
        await self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, permit=permit)

    async def disarm(self, permit: Permit = always) -> None:
        """Stop the motors. The autopilot refuses in the air."""
        await self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, permit=permit)

    async def set_home(self, lat: float, lon: float, amsl_m: float) -> None:
        """Set home to a position. If the vehicle later arms at another position, home does not move there."""
        await self.command(mavlink.MAV_CMD_DO_SET_HOME, place=(lat, lon, amsl_m), frame=mavlink.MAV_FRAME_GLOBAL)

    async def take_off(self, altitude_m: float, permit: Permit = always) -> None:
        """Start to climb to an altitude above home."""
        for attempt in range(COMMAND_ATTEMPTS):
            try:
                await self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m, permit=permit, attempts=1)
            except AutopilotError as error:
                # The acknowledgement of the previous attempt may be lost: a vehicle that is taking off refuses a second takeoff.
                if attempt and not error.link and await self._starts_to_fly():
                    return
                if not error.link or attempt + 1 == COMMAND_ATTEMPTS:
                    raise
            else:
                return

    async def _starts_to_fly(self) -> bool:
        deadline = self.now + TAKEOFF_TIMEOUT_S
        while not self.vehicle.in_air and self.now < deadline:
            await self.update(ACK_TIMEOUT_S)
        return self.vehicle.in_air

    async def go_to(
        self, lat: float, lon: float, altitude_m: float, yaw_deg: float | None, permit: Permit = always
    ) -> None:
        """Start to fly straight to a point. The altitude is above home.

        The autopilot uses its default speed if it was not flying to a point before, see `set_speed`.
        """
        yaw = math.nan if yaw_deg is None else yaw_deg

        def record_setpoint() -> None:
            permit()
            self._setpoints.add_leg(lat, lon, altitude_m, self.vehicle, self.now)

        await self.command(
            mavlink.MAV_CMD_DO_REPOSITION, -1, 0, 0, yaw, place=(lat, lon, altitude_m), permit=record_setpoint
        )

    async def turn(self, yaw_deg: float, permit: Permit = always) -> None:
        """Turn to a heading during the current leg."""
        await self.command(mavlink.MAV_CMD_CONDITION_YAW, yaw_deg % 360.0, 0, 0, 0, permit=permit)

    async def set_speed(self, speed_mps: float, permit: Permit = always) -> None:
        """Set the horizontal ground speed of the current leg. The next leg may start with the default speed."""
        await self.command(
            mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.SPEED_TYPE_GROUNDSPEED, speed_mps, -1, permit=permit
        )

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float, permit: Permit = always) -> None:
        """Point the camera: pitch above the horizon, yaw clockwise from the vehicle's heading."""
        await point(self, pitch_deg, yaw_deg, permit)

    def stop(self) -> None:
        """Brake and hold the position by a velocity of zero. GUIDED keeps the position after the setpoint times out."""
        self.fly(0.0, 0.0, 0.0)

    def fly(self, north_mps: float, east_mps: float, down_mps: float, yaw_deg: float | None = None) -> None:
        """Fly with a velocity over ground. The autopilot stops by itself after GUID_TIMEOUT. No acknowledgement."""
        if not self.found:
            return
        with tracing.child_span("autopilot.SET_POSITION_TARGET_LOCAL_NED"):
            self._setpoints.add_velocity((north_mps, east_mps, down_mps), self.now)
            self.send(
                message(
                    "SET_POSITION_TARGET_LOCAL_NED",
                    coordinate_frame=mavlink.MAV_FRAME_LOCAL_NED,
                    type_mask=_VELOCITY_ONLY if yaw_deg is None else _VELOCITY_AND_YAW,
                    vx=north_mps,
                    vy=east_mps,
                    vz=down_mps,
                    yaw=math.radians(yaw_deg or 0.0),
                    **self.address(silent=True),
                )
            )

    def request_gateway_messages(self) -> None:
        """Request the messages that applications expect and the service itself does not need."""
        self._rates.add_gateway_messages()

    async def known_parameters(self) -> dict[str, float]:
        """Return the vehicle's parameters. In the air, only the known ones, because the list would fill a slow link."""
        if self.vehicle.in_air:
            return dict(self.vehicle_parameters.values)
        return await self.vehicle_parameters.read_all()

    async def set_rates(self, flying: bool) -> None:
        """Request the message rates, which are higher in the air. Request them again if messages are missing."""
        await self._rates.request(self, flying)

    async def request_home(self) -> None:
        """Request HOME_POSITION now."""
        await self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HOME_POSITION)
