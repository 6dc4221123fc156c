"""What the autopilot last said of the vehicle, and what that means for the policy engine."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from fractus_core.geo import LocalFrame
from fractus_core.policy.values import STANDING_MPS, Airframe, Home, Situation

GUIDED, RTL, LAND, SMART_RTL, BRAKE = 4, 6, 9, 21, 17
MODE_NAMES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE", 9: "LAND",
    11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW", 19: "AVOID_ADSB",
    20: "GUIDED_NOGPS", 21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW", 24: "ZIGZAG", 25: "SYSTEMID", 26: "HELI_AUTOROTATE",
    27: "AUTO_RTL", 28: "TURTLE",
}  # fmt: skip
HOMEWARD = frozenset({RTL, LAND, SMART_RTL, 27})
"""Modes in which the vehicle comes down by itself."""

_ARMED = 0x80
_CRITICAL, _EMERGENCY = 5, 6
_PREARM = 0x10000000
_ON_GROUND = 1
TOLD_S = 2.0
SURELY_M, UNTOLD_M = 1.5, 0.5
"""Above this a drone flies though it says it stands; above the other when it does not say."""
_IN_AIR = frozenset({2, 3, 4})
_FIX_3D = 3
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
        yaw_deg: heading as the position says it; `heading_deg` is the attitude's.
        path_lost: whether the autopilot has given up remembering its path since it was armed.
        located: whether GPS has a three-dimensional fix of some accuracy; positions without one are not taken.
    """

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
    mode: int = -1
    armed: bool = False
    failsafe: bool = False
    heartbeat_at: float = -math.inf
    landed_state: int = 0
    landed_at: float = -math.inf
    battery_remaining: float = math.nan
    battery_v: float = math.nan
    battery_a: float = math.nan
    ready: bool = False
    fix_type: int = 0
    located: bool = False
    position_error_m: float = _UNTOLD_ERROR_M
    courses: deque[tuple[float, float, float]] = field(default_factory=deque)
    texts: list[str] = field(default_factory=list)
    path_lost: bool = False
    failsafe_text: str = ""
    failsafe_text_at: float = -math.inf

    @property
    def mode_name(self) -> str:
        """The autopilot's name of its mode."""
        return MODE_NAMES.get(self.mode, f"MODE{self.mode}" if self.mode >= 0 else "UNKNOWN")

    @property
    def _landed_told(self) -> bool:
        """Whether the landed state is as fresh as the rest."""
        return max(self.heartbeat_at, self.position_at) - self.landed_at <= TOLD_S

    @property
    def standing(self) -> bool:
        """Whether the autopilot says, now, that it stands on the ground."""
        return self._landed_told and self.landed_state == _ON_GROUND

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
        if self.landed_state == 3:
            return "takingOff"
        return "landing" if self.landed_state == 4 or self.mode == LAND else "flying"

    def take(self, message: Any, now: float) -> None:
        """Update from one message."""
        handler = _HANDLERS.get(message.get_type())
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


def _heartbeat(vehicle: Vehicle, message: Any, now: float) -> None:
    vehicle.heartbeat_at = now
    vehicle.mode = message.custom_mode
    vehicle.armed = bool(message.base_mode & _ARMED)
    vehicle.path_lost = vehicle.path_lost and vehicle.armed
    vehicle.failsafe = message.system_status in {_CRITICAL, _EMERGENCY}


def _position(vehicle: Vehicle, message: Any, now: float) -> None:
    if not vehicle.located:
        return
    if message.lat == 0 and message.lon == 0:
        return
    vehicle.lat, vehicle.lon = message.lat / 1e7, message.lon / 1e7
    vehicle.altitude_m, vehicle.amsl_m = message.relative_alt / 1e3, message.alt / 1e3
    vehicle.north_mps, vehicle.east_mps, vehicle.down_mps = message.vx / 100, message.vy / 100, message.vz / 100
    vehicle.courses.append((now, vehicle.north_mps, vehicle.east_mps))
    while vehicle.courses[0][0] < now - COURSE_S:
        vehicle.courses.popleft()
    if message.hdg != 0xFFFF:
        vehicle.yaw_deg = message.hdg / 100
    vehicle.position_at = now


def _attitude(vehicle: Vehicle, message: Any, now: float) -> None:
    angles = [math.degrees(radians) for radians in (message.roll, message.pitch, message.yaw)]
    if all(map(math.isfinite, angles)):
        vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg = angles[0], angles[1], angles[2] % 360.0
        vehicle.attitude_at = now


def _home(vehicle: Vehicle, message: Any, _now: float) -> None:
    vehicle.home = Home(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)


def _landed(vehicle: Vehicle, message: Any, now: float) -> None:
    vehicle.landed_state, vehicle.landed_at = message.landed_state, now


def _status(vehicle: Vehicle, message: Any, _now: float) -> None:
    vehicle.battery_remaining = message.battery_remaining / 100 if message.battery_remaining >= 0 else math.nan
    vehicle.battery_v = message.voltage_battery / 1e3 if message.voltage_battery != 0xFFFF else math.nan
    vehicle.battery_a = message.current_battery / 100 if message.current_battery >= 0 else math.nan
    present = message.onboard_control_sensors_present & _PREARM
    healthy = message.onboard_control_sensors_health & _PREARM
    vehicle.ready = bool(healthy) if present else vehicle.fix_type >= 3


def _gps(vehicle: Vehicle, message: Any, _now: float) -> None:
    vehicle.fix_type = message.fix_type
    error = message.h_acc / 1e3 if message.h_acc else _UNTOLD_ERROR_M
    vehicle.located = message.fix_type >= _FIX_3D and error <= _WORST_ERROR_M
    if vehicle.located:
        vehicle.position_error_m = max(error, _LEAST_ERROR_M)


def _text(vehicle: Vehicle, message: Any, now: float) -> None:
    raw = message.text.split(b"\0", 1)[0] if isinstance(message.text, bytes) else message.text.encode()
    text = raw.decode("utf-8", "replace")
    vehicle.texts.append(text)
    del vehicle.texts[:-20]
    if text.startswith("SmartRTL deactivated"):
        vehicle.path_lost = True
    if ("ailsafe" in text or "fence" in text.lower()) and "leared" not in text:
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
