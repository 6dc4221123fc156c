"""What the autopilot last said of the vehicle, and what that means for the policy engine."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from fractus_core.control.values import FlightMode, ModeKind
from fractus_core.geo import LocalFrame
from fractus_core.policy.values import STANDING_MPS, Airframe, Home, Situation
from fractus_mavlink import Message
from fractus_mavlink.enums import (
    GPS_FIX_TYPE,
    MAV_LANDED_STATE,
    MAV_MODE_FLAG,
    MAV_STATE,
    MAV_SYS_STATUS_SENSOR,
)

from fractus_services.mobility.mavlink.flight_stack import FlightStack

_UNKNOWN_U16 = 0xFFFF
"""What 16 bits say of a value that is not known."""

TOLD_S = 2.0
SURELY_M, UNTOLD_M = 1.5, 0.5
"""Above this a drone flies though it says it stands; above the other when it does not say."""
_IN_AIR = frozenset({MAV_LANDED_STATE.IN_AIR, MAV_LANDED_STATE.TAKEOFF, MAV_LANDED_STATE.LANDING})
_LEAST_ERROR_M, _UNTOLD_ERROR_M, _WORST_ERROR_M = 0.5, 1.5, 10.0

MAX_POSITION_AGE_S = 1.0
"""A position older than this is no position: at 20 Hz in flight, twenty in a row were lost."""

COURSE_S = 0.3
"""Velocities this far back tell how the drone speeds up."""

SLOW_MPS = 0.1
"""Below this nobody can tell where a drone heads."""


@dataclass(slots=True)
class Vehicle:
    """The streamed state; times are monotonic seconds.

    Attributes:
        stack: the firmware that says it.
        yaw_deg: heading as the position says it; `heading_deg` is the attitude's.
        path_lost: whether the autopilot has given up remembering its path since it was armed.
        located: whether GPS has a three-dimensional fix of some accuracy; positions without one are not taken.
    """

    stack: FlightStack
    lat: float | None = None
    lon: float | None = None
    altitude_m: float = 0.0
    amsl_m: float = 0.0
    north_mps: float = 0.0
    east_mps: float = 0.0
    down_mps: float = 0.0
    yaw_deg: float = 0.0
    position_at: float = -math.inf
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    heading_deg: float = 0.0
    attitude_at: float = -math.inf
    home: Home | None = None
    mode: FlightMode = field(default_factory=FlightMode)
    armed: bool = False
    failsafe: bool = False
    heartbeat_at: float = -math.inf
    landed_state: int = MAV_LANDED_STATE.UNDEFINED
    landed_at: float = -math.inf
    battery_remaining: float = math.nan
    battery_v: float = math.nan
    battery_a: float = math.nan
    ready: bool = False
    fix_type: int = GPS_FIX_TYPE.NO_GPS
    located: bool = False
    position_error_m: float = _UNTOLD_ERROR_M
    courses: deque[tuple[float, float, float]] = field(default_factory=deque)
    texts: list[str] = field(default_factory=list)
    path_lost: bool = False
    failsafe_text: str = ""
    failsafe_text_at: float = -math.inf

    @property
    def _landed_told(self) -> bool:
        """Whether the landed state is as fresh as the rest."""
        return max(self.heartbeat_at, self.position_at) - self.landed_at <= TOLD_S

    @property
    def standing(self) -> bool:
        """Whether the autopilot says, now, that it stands on the ground."""
        return self._landed_told and self.landed_state == MAV_LANDED_STATE.ON_GROUND

    @property
    def in_air(self) -> bool:
        """Whether it flies, as far as anybody can tell: in doubt it does."""
        if not self.armed:
            return False
        if self.landed_state in _IN_AIR:
            return True
        if self.standing:
            return self.altitude_m > SURELY_M
        return self.position_at == -math.inf or self.altitude_m > UNTOLD_M

    @property
    def speed_mps(self) -> float:
        """Horizontal speed over ground."""
        return math.hypot(self.north_mps, self.east_mps)

    def position_fresh(self, now: float) -> bool:
        """Whether the position is recent enough to judge and to fly by; `now` is monotonic, as `position_at` is."""
        return now - self.position_at <= MAX_POSITION_AGE_S

    def keeps_place(self, now: float) -> bool:
        """Whether it surely stays above one place."""
        return self.position_fresh(now) and self.speed_mps < STANDING_MPS

    def at_rest(self, now: float) -> bool:
        """Whether it surely stands, in the sense of the policy engine."""
        return self.keeps_place(now) and abs(self.down_mps) < STANDING_MPS

    def distance_m(self, lat: float, lon: float) -> float:
        """How far away a place is over ground; infinite while the position is unknown."""
        if self.lat is None or self.lon is None:
            return math.inf
        return math.hypot(*LocalFrame(lat, lon).xy(self.lat, self.lon))

    @property
    def forward_mps2(self) -> float | None:
        """How much it speeds up along its course, over the last velocities; None while these are too few."""
        if len(self.courses) < 2:
            return None
        (begun, north, east), (now, *_) = self.courses[0], self.courses[-1]
        if now - begun < COURSE_S / 3:
            return None
        along = (self.north_mps - north) * self.north_mps + (self.east_mps - east) * self.east_mps
        return along / max(self.speed_mps, SLOW_MPS) / (now - begun)

    @property
    def flight_state(self) -> str:
        """inactive, takingOff, flying or landing."""
        if not self.in_air:
            return "inactive"
        if self.landed_state == MAV_LANDED_STATE.TAKEOFF:
            return "takingOff"
        landing = self.landed_state == MAV_LANDED_STATE.LANDING or self.mode.kind is ModeKind.LANDING
        return "landing" if landing else "flying"

    def take(self, message: Message, now: float) -> None:
        """Update from one message."""
        handler = _HANDLERS.get(message.name)
        if handler is not None:
            handler(self, message, now)

    def situation(self, time_s: float, airframe: Airframe, speed_mps: float, vertical: bool) -> Situation:
        """The state as the engine judges it."""
        return Situation(
            time_s=time_s,
            lat=self.lat,
            lon=self.lon,
            altitude_m=self.altitude_m,
            north_mps=self.north_mps,
            east_mps=self.east_mps,
            down_mps=self.down_mps,
            home=self.home,
            armed=self.armed,
            in_air=self.in_air,
            position_error_m=self.position_error_m,
            speed_setpoint_mps=speed_mps,
            forward_mps2=self.forward_mps2,
            vertical=vertical,
            airframe=airframe,
        )


def _heartbeat(vehicle: Vehicle, message: Message, now: float) -> None:
    vehicle.heartbeat_at = now
    vehicle.mode = vehicle.stack.mode(message.integer("custom_mode"))
    vehicle.armed = bool(message.integer("base_mode") & MAV_MODE_FLAG.SAFETY_ARMED)
    vehicle.path_lost = vehicle.path_lost and vehicle.armed
    vehicle.failsafe = message.integer("system_status") in {MAV_STATE.CRITICAL, MAV_STATE.EMERGENCY}


def _position(vehicle: Vehicle, message: Message, now: float) -> None:
    if not vehicle.located:
        return
    lat_e7, lon_e7 = message.integer("lat"), message.integer("lon")
    # ArduPilot sends zeroes until its estimator has an origin.
    if lat_e7 == 0 and lon_e7 == 0:
        return
    vehicle.lat, vehicle.lon = lat_e7 / 1e7, lon_e7 / 1e7
    vehicle.altitude_m, vehicle.amsl_m = message.integer("relative_alt") / 1e3, message.integer("alt") / 1e3
    vehicle.north_mps, vehicle.east_mps, vehicle.down_mps = (message.integer(name) / 100 for name in ("vx", "vy", "vz"))
    vehicle.courses.append((now, vehicle.north_mps, vehicle.east_mps))
    while vehicle.courses[0][0] < now - COURSE_S:
        vehicle.courses.popleft()
    heading_cdeg = message.integer("hdg")
    if heading_cdeg != _UNKNOWN_U16:
        vehicle.yaw_deg = heading_cdeg / 100
    vehicle.position_at = now


def _attitude(vehicle: Vehicle, message: Message, now: float) -> None:
    angles = [math.degrees(message.real(name)) for name in ("roll", "pitch", "yaw")]
    if all(map(math.isfinite, angles)):
        vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg = angles[0], angles[1], angles[2] % 360.0
        vehicle.attitude_at = now


def _home(vehicle: Vehicle, message: Message, _now: float) -> None:
    lat, lon = message.integer("latitude") / 1e7, message.integer("longitude") / 1e7
    vehicle.home = Home(lat, lon, message.integer("altitude") / 1e3)


def _landed(vehicle: Vehicle, message: Message, now: float) -> None:
    vehicle.landed_state, vehicle.landed_at = message.integer("landed_state"), now


def _status(vehicle: Vehicle, message: Message, _now: float) -> None:
    # -1 and 0xFFFF: the autopilot does not measure it.
    percent, millivolts = message.integer("battery_remaining"), message.integer("voltage_battery")
    centiamperes = message.integer("current_battery")
    vehicle.battery_remaining = percent / 100 if percent >= 0 else math.nan
    vehicle.battery_v = millivolts / 1e3 if millivolts != _UNKNOWN_U16 else math.nan
    vehicle.battery_a = centiamperes / 100 if centiamperes >= 0 else math.nan
    present = message.integer("onboard_control_sensors_present") & MAV_SYS_STATUS_SENSOR.PREARM_CHECK
    healthy = message.integer("onboard_control_sensors_health") & MAV_SYS_STATUS_SENSOR.PREARM_CHECK
    vehicle.ready = bool(healthy) if present else vehicle.fix_type >= GPS_FIX_TYPE.TYPE_3D_FIX


def _gps(vehicle: Vehicle, message: Message, _now: float) -> None:
    vehicle.fix_type, accuracy_mm = message.integer("fix_type"), message.integer("h_acc")
    error = accuracy_mm / 1e3 if accuracy_mm else _UNTOLD_ERROR_M
    vehicle.located = vehicle.fix_type >= GPS_FIX_TYPE.TYPE_3D_FIX and error <= _WORST_ERROR_M
    if vehicle.located:
        vehicle.position_error_m = max(error, _LEAST_ERROR_M)


def _text(vehicle: Vehicle, message: Message, now: float) -> None:
    text = message.text("text")
    vehicle.texts.append(text)
    del vehicle.texts[:-20]
    if vehicle.stack.tells_path_lost(text):
        vehicle.path_lost = True
    if vehicle.stack.tells_failsafe(text):
        vehicle.failsafe_text, vehicle.failsafe_text_at = text, now


_HANDLERS = {
    "HEARTBEAT": _heartbeat,
    "GLOBAL_POSITION_INT": _position,
    "ATTITUDE": _attitude,
    "HOME_POSITION": _home,
    "EXTENDED_SYS_STATE": _landed,
    "SYS_STATUS": _status,
    "GPS_RAW_INT": _gps,
    "STATUSTEXT": _text,
}
