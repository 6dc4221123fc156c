"""Telemetry of the drone: complete samples, or the changes of one part of the state."""

from __future__ import annotations

import enum
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TypeVar

from fractus_proto.v1 import mobility_pb2

from fractus.values import Attitude, Position, Velocity

T = TypeVar("T")


class Fix(enum.IntEnum):
    """Fix type of the satellite receiver; `GPS_FIX_TYPE` of MAVLink."""

    NO_GPS = 0
    NO_FIX = 1
    FIX_2D = 2
    FIX_3D = 3
    DGPS = 4
    RTK_FLOAT = 5
    RTK_FIXED = 6
    STATIC = 7
    PPP = 8


class Severity(enum.IntEnum):
    """Severity of an autopilot text, most severe first; `MAV_SEVERITY` of MAVLink."""

    EMERGENCY = 0
    ALERT = 1
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6
    DEBUG = 7


@dataclass(frozen=True, slots=True)
class Gps:
    """State of the satellite receiver.

    Attributes:
        fix: Fix type.
        satellites: Number of visible satellites.
        position_error_m: Bound of the horizontal position error in metres; None if the position is unknown.
    """

    fix: Fix
    satellites: int
    position_error_m: float | None


@dataclass(frozen=True, slots=True)
class Battery:
    """The flight battery.

    Attributes:
        remaining: Remaining charge, 0 to 1; 0 if it is not measured.
        voltage_v: Voltage in volts; 0 if it is not measured.
        current_a: Current in amperes, positive during discharge; 0 if it is not measured.
    """

    remaining: float
    voltage_v: float
    current_a: float


@dataclass(frozen=True, slots=True)
class Health:
    """Readiness for takeoff.

    Attributes:
        ready: True if the motors can be started now.
        problem: Reason why the motors cannot be started, in one sentence; empty if `ready`.
        autopilot_connected: True if messages of the autopilot are received.
    """

    ready: bool
    problem: str
    autopilot_connected: bool


@dataclass(frozen=True, slots=True)
class Wind:
    """Wind estimate of the autopilot.

    Attributes:
        from_deg: Direction from which the wind blows, in degrees clockwise from true north.
        speed_mps: Speed in metres per second.
    """

    from_deg: float
    speed_mps: float


@dataclass(frozen=True, slots=True)
class StatusText:
    """A text message of the autopilot (STATUSTEXT).

    Attributes:
        severity: Severity.
        text: The text.
        time: Time at which the service received the text, UTC.
    """

    severity: Severity
    text: str
    time: datetime


@dataclass(frozen=True, slots=True)
class Telemetry:
    """One sample of the drone's state.

    Attributes:
        time: Time at which the service sent the sample, UTC.
        position: Position with the altitude above home; None if it is unknown or older than one second.
        altitude_amsl_m: Altitude in metres above mean sea level.
        velocity: Velocity over ground; None if the position is unknown.
        yaw_deg: Heading in degrees clockwise from true north.
        battery_remaining: Remaining charge, 0 to 1.
        armed: True while the motors run.
        in_air: True if airborne, or if the landed state is unknown.
        mode: Name of the autopilot's flight mode, for example GUIDED or RTL.
        ready: True if the motors can be started now; `health` contains the reason if not.
        home: Home position with the altitude above mean sea level; None until the autopilot has a home.
        flight_state: inactive, charging, takingOff, flying or landing.
        controller: Control authority: `system`, `pilot`, or the SPIFFE id of the driver instance.
        attitude: Attitude of the airframe; None if it is unknown.
        gimbal: Measured attitude of the gimbal's camera, with the yaw from true north; None if it is unknown.
        position_error_m: Bound of the horizontal position error in metres; None if the position is unknown.
        autopilot_connected: True if messages of the autopilot are received.
        gps: State of the satellite receiver; None until the first report.
        battery: Charge, voltage and current.
        health: Readiness for takeoff.
        wind: Wind estimate; None if the autopilot does not estimate it.
        texts: Texts of the autopilot since the last sample; the first sample contains recent texts.
    """

    time: datetime
    position: Position | None
    altitude_amsl_m: float
    velocity: Velocity | None
    yaw_deg: float
    battery_remaining: float
    armed: bool
    in_air: bool
    mode: str
    ready: bool
    home: Position | None
    flight_state: str
    controller: str
    attitude: Attitude | None
    position_error_m: float | None
    autopilot_connected: bool
    gps: Gps | None
    battery: Battery
    health: Health
    wind: Wind | None
    texts: tuple[StatusText, ...]
    gimbal: Attitude | None

    @classmethod
    def from_proto(cls, message: mobility_pb2.Telemetry) -> Telemetry:
        """Create the value from its protobuf message."""
        located = message.HasField("position")
        error_m = message.position_error_m if located else None
        return cls(
            time=message.time.ToDatetime(tzinfo=UTC),
            position=Position.from_proto(message.position) if located else None,
            altitude_amsl_m=message.altitude_amsl_m,
            velocity=Velocity.from_proto(message.velocity) if located else None,
            yaw_deg=message.yaw_deg,
            battery_remaining=message.battery_remaining,
            armed=message.armed,
            in_air=message.in_air,
            mode=message.mode,
            ready=message.ready,
            home=Position.from_proto(message.home) if message.HasField("home") else None,
            flight_state=message.flight_state,
            controller=message.controller,
            attitude=Attitude.from_proto(message.attitude) if message.HasField("attitude") else None,
            position_error_m=error_m,
            autopilot_connected=message.autopilot_connected,
            gps=_gps(message, error_m),
            battery=Battery(message.battery_remaining, message.battery_voltage_v, message.battery_current_a),
            health=Health(message.ready, message.not_ready_reason, message.autopilot_connected),
            wind=Wind(message.wind.from_deg, message.wind.speed_mps) if message.HasField("wind") else None,
            gimbal=Attitude.from_proto(message.gimbal) if message.HasField("gimbal") else None,
            texts=tuple(_status_text(text, message) for text in message.texts),
        )


def _status_text(text: mobility_pb2.StatusText, message: mobility_pb2.Telemetry) -> StatusText:
    # Services of earlier releases send texts without a time.
    time = text.time if text.HasField("time") else message.time
    return StatusText(Severity(min(text.severity, Severity.DEBUG)), text.text, time.ToDatetime(tzinfo=UTC))


def _gps(message: mobility_pb2.Telemetry, error_m: float | None) -> Gps | None:
    if not message.HasField("gps"):
        return None
    # Fix types that MAVLink adds later are at least three-dimensional.
    fix = Fix(message.gps.fix_type) if message.gps.fix_type in Fix._value2member_map_ else Fix.FIX_3D
    return Gps(fix, message.gps.satellites, error_m)


class Watch:
    """Changes of one part of the drone's state: `async for gps in drone.watch.gps()`.

    Iterations start with the current value, and continue after a restart of the service. `status_texts` has no current value:
    it starts with the next text. The component needs the method GetPosition.
    """

    def __init__(self, telemetry: Callable[[float], AsyncGenerator[Telemetry, None]]) -> None:
        self._telemetry = telemetry

    def gps(self, interval_s: float = 0.5) -> AsyncGenerator[Gps, None]:
        """Yield the state of the satellite receiver."""
        return self._changes(interval_s, lambda sample: sample.gps)

    def battery(self, interval_s: float = 1.0) -> AsyncGenerator[Battery, None]:
        """Yield charge, voltage and current."""
        return self._changes(interval_s, lambda sample: sample.battery)

    def health(self, interval_s: float = 0.5) -> AsyncGenerator[Health, None]:
        """Yield the readiness for takeoff."""
        return self._changes(interval_s, lambda sample: sample.health)

    def attitude(self, interval_s: float = 0.1) -> AsyncGenerator[Attitude, None]:
        """Yield the attitude of the airframe."""
        return self._changes(interval_s, lambda sample: sample.attitude)

    def gimbal(self, interval_s: float = 0.1) -> AsyncGenerator[Attitude, None]:
        """Yield the measured attitude of the gimbal's camera."""
        return self._changes(interval_s, lambda sample: sample.gimbal)

    def wind(self, interval_s: float = 1.0) -> AsyncGenerator[Wind, None]:
        """Yield the wind estimate."""
        return self._changes(interval_s, lambda sample: sample.wind)

    async def status_texts(self, interval_s: float = 0.5) -> AsyncGenerator[StatusText, None]:
        """Yield the texts that the autopilot sends from now on.

        The first sample of `Mobility.telemetry` contains earlier texts.
        """
        last: datetime | None = None
        async with aclosing(self._telemetry(interval_s)) as samples:
            async for sample in samples:
                for text in sample.texts:
                    # The stream repeats recent texts after a restart of the service. If the clock was set back, times say nothing.
                    if last is not None and (text.time > last or sample.time < last):
                        yield text
                last = sample.time

    async def _changes(self, interval_s: float, of: Callable[[Telemetry], T | None]) -> AsyncGenerator[T, None]:
        last: T | None = None
        async with aclosing(self._telemetry(interval_s)) as samples:
            async for sample in samples:
                value = of(sample)
                if value is not None and value != last:
                    last = value
                    yield value
