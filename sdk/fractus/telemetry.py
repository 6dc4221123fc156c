"""The drone's state as its mobility service tells it: all of it, or one thing each time that changes."""

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
    """How well the satellite receiver knows where it is; `GPS_FIX_TYPE` of MAVLink."""

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
    """How serious a text of the autopilot is; `MAV_SEVERITY` of MAVLink, the most serious first."""

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
    """What the satellite receiver says of itself.

    Attributes:
        fix: how well it knows where it is.
        satellites: how many it sees.
        position_error_m: bound of the horizontal error of the position in metres; None while that is unknown.
    """

    fix: Fix
    satellites: int
    position_error_m: float | None


@dataclass(frozen=True, slots=True)
class Battery:
    """The flight battery.

    Attributes:
        remaining: 0 to 1; 0 while the autopilot does not measure it.
        voltage_v: volts; 0 while it is not measured.
        current_a: amperes, positive while it discharges; 0 while it is not measured.
    """

    remaining: float
    voltage_v: float
    current_a: float


@dataclass(frozen=True, slots=True)
class Health:
    """Whether the drone could take off.

    Attributes:
        ready: whether the motors could be started now.
        problem: why not, in a sentence: the autopilot's checks, its failsafes, the link; empty when they could.
        autopilot_connected: whether the autopilot is heard.
    """

    ready: bool
    problem: str
    autopilot_connected: bool


@dataclass(frozen=True, slots=True)
class Wind:
    """The wind as the autopilot estimates it.

    Attributes:
        from_deg: where it comes from, degrees clockwise from true north.
        speed_mps: metres per second.
    """

    from_deg: float
    speed_mps: float


@dataclass(frozen=True, slots=True)
class StatusText:
    """Something that the autopilot said."""

    severity: Severity
    text: str


@dataclass(frozen=True, slots=True)
class Telemetry:
    """One sample of the drone's state.

    Attributes:
        time: when the service sent it, UTC.
        position: degrees, and metres above home; None while it is unknown, or older than a second.
        altitude_amsl_m: metres above mean sea level.
        velocity: over ground; None while the position is.
        yaw_deg: where the nose points, degrees clockwise from true north.
        battery_remaining: 0 to 1; `battery` has more.
        armed: whether the motors run.
        in_air: whether it flies; in doubt it does.
        mode: the autopilot's name of its flight mode: GUIDED, RTL.
        ready: whether the motors could be started now; `health` says why not.
        home: degrees, and metres above mean sea level; None until the autopilot has one.
        flight_state: inactive, charging, takingOff, flying or landing.
        controller: who flies: `system`, `pilot`, or the SPIFFE id of the driver instance.
        attitude: None while it is unknown.
        gimbal: how the gimbal turns the camera, as measured: its yaw from true north; None while it is unknown.
        position_error_m: bound of the horizontal error in metres; None while the position is.
        autopilot_connected: whether the autopilot is heard.
        gps: None until the receiver has told.
        battery: charge, voltage and current.
        health: whether the drone could take off, and why not.
        wind: None while the autopilot does not estimate it.
        texts: what the autopilot has said since the last sample; in the first one, what it said of late.
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
        """Read the wire form."""
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
            texts=tuple(StatusText(Severity(min(t.severity, Severity.DEBUG)), t.text) for t in message.texts),
        )


def _gps(message: mobility_pb2.Telemetry, error_m: float | None) -> Gps | None:
    if not message.HasField("gps"):
        return None
    # A kind of fix that this release does not know is a three-dimensional one at least.
    fix = Fix(message.gps.fix_type) if message.gps.fix_type in Fix._value2member_map_ else Fix.FIX_3D
    return Gps(fix, message.gps.satellites, error_m)


class Watch:
    """One thing of the drone's state, each time it changes: `async for gps in drone.watch.gps()`.

    Each iteration begins with the value of the moment, goes on after a restart of the service, and ends when it is left.
    Like `Mobility.telemetry` it needs the method GetPosition.
    """

    def __init__(self, telemetry: Callable[[float], AsyncGenerator[Telemetry, None]]) -> None:
        self._telemetry = telemetry

    def gps(self, interval_s: float = 0.5) -> AsyncGenerator[Gps, None]:
        """Fix, satellites and error of the satellite receiver."""
        return self._changes(interval_s, lambda sample: sample.gps)

    def battery(self, interval_s: float = 1.0) -> AsyncGenerator[Battery, None]:
        """Charge, voltage and current."""
        return self._changes(interval_s, lambda sample: sample.battery)

    def health(self, interval_s: float = 0.5) -> AsyncGenerator[Health, None]:
        """Whether the drone could take off, and why not."""
        return self._changes(interval_s, lambda sample: sample.health)

    def attitude(self, interval_s: float = 0.1) -> AsyncGenerator[Attitude, None]:
        """Roll, pitch and yaw."""
        return self._changes(interval_s, lambda sample: sample.attitude)

    def gimbal(self, interval_s: float = 0.1) -> AsyncGenerator[Attitude, None]:
        """Roll, pitch and yaw of the camera on the gimbal, as measured."""
        return self._changes(interval_s, lambda sample: sample.gimbal)

    def wind(self, interval_s: float = 1.0) -> AsyncGenerator[Wind, None]:
        """The wind, as the autopilot estimates it."""
        return self._changes(interval_s, lambda sample: sample.wind)

    async def status_texts(self, interval_s: float = 0.5) -> AsyncGenerator[StatusText, None]:
        """What the autopilot says; at first what it said of late."""
        async with aclosing(self._telemetry(interval_s)) as samples:
            async for sample in samples:
                for text in sample.texts:
                    yield text

    async def _changes(self, interval_s: float, of: Callable[[Telemetry], T | None]) -> AsyncGenerator[T, None]:
        last: T | None = None
        async with aclosing(self._telemetry(interval_s)) as samples:
            async for sample in samples:
                value = of(sample)
                if value is not None and value != last:
                    last = value
                    yield value
