"""State of the vehicle, updated from the messages of its autopilot."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from fractus_core.policy.decision_types import Home
from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.mobility.autopilot import COURSE_S, DEFAULT_ERROR_M, VehicleState
from fractus_services.mobility.mavlink.flight_stack import FlightStack
from fractus_services.mobility.mavlink.gimbal import attitude_of

_UNKNOWN_U8 = 0xFF
_UNKNOWN_U16 = 0xFFFF
"""Values of 8 and 16 bits that mean "unknown"."""

_POSITIONED = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_PRED_POS_HORIZ_ABS

MIN_ERROR_M = 0.5
MAX_ERROR_M = 10.0
"""Range of the position error: smaller reported errors are raised to the first, and larger ones give no position."""

STATUS_MAX_AGE_S = 10.0
"""Maximum age of the estimator and GPS status.

The autopilot sends them at least once per second. After a longer silence the estimator may be using dead reckoning.
"""

STOPPED_S = 0.7
"""Heartbeats, one per second, must report stopped motors in flight for this time before they are accepted."""

STARTED_S = 5.0
"""A drone whose motors have run for less may be about to take off. After a longer silence it may have landed."""

PATH_KEPT_S = 12.0
"""ArduCopter discards its path after 15 s without a position and reports that once. This limit is lower, because the text may be lost."""


@dataclass(slots=True)
class Vehicle(VehicleState):
    """Vehicle state with the rules that update it from messages.

    Attributes:
        stack: Firmware of the autopilot.
        foreign: Description of a vehicle with another firmware; empty for this firmware.
        gimbal_measured: True if the firmware measures the attitude of its gimbal; None until it reports the gimbal's type.
        placed_at: Time at which the estimator last had a position.
        received_at: Time of the last GPS message.
        fenced: True if the vehicle's fence is enabled, None if it has no fence; reported at `checks_at`.
        started_at: Time of the first heartbeat that reported running motors.
        stopping_at: Time of the first of the latest heartbeats that reported stopped motors in flight; infinite if the last did not.
        gimbal_limits: Smallest and largest pitch and yaw of the gimbal, degrees; None until they are reported.
    """

    stack: FlightStack = field(kw_only=True)
    foreign: str = ""
    gimbal_measured: bool | None = None
    gimbal_limits: tuple[tuple[float, float], ...] | None = None
    placed_at: float = -math.inf
    received_at: float = -math.inf
    fenced: bool | None = None
    started_at: float = -math.inf
    stopping_at: float = math.inf

    def take(self, message: Message, now: float) -> None:
        """Update the state from a message."""
        handler = _HANDLERS.get(message.name)
        if handler is not None:
            handler(self, message, now)


def _heartbeat(vehicle: Vehicle, message: Message, now: float) -> None:
    vehicle.silent_s = now - vehicle.heartbeat_at if math.isfinite(vehicle.heartbeat_at) else 0.0
    vehicle.heartbeat_at = now
    vehicle.foreign = vehicle.stack.foreign(message.integer("type"), message.integer("autopilot"))
    armed = bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    # Heartbeats from before the start may arrive late or twice, and they have no time stamp. If they were accepted, the next
    # heartbeat would seem to report motors that another station started.
    flies = vehicle.in_air or now - vehicle.started_at < STARTED_S
    stops = vehicle.armed and not armed and flies and vehicle.silent_s < STARTED_S
    vehicle.stopping_at = min(vehicle.stopping_at, now) if stops else math.inf
    if stops and now - vehicle.stopping_at < STOPPED_S:
        return
    vehicle.mode = vehicle.stack.mode(message.integer("custom_mode"))
    if armed and not vehicle.armed:
        # Arming moves home to the position of the vehicle, so the previous home does not apply to this flight.
        vehicle.ground_home = None
        vehicle.started_at = now
    vehicle.armed = armed
    vehicle.path_lost = vehicle.path_lost and vehicle.armed
    vehicle.failsafe = message.integer("system_status") in {mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_EMERGENCY}


def _place(lat_e7: int, lon_e7: int) -> tuple[float, float] | None:
    """Return a place in degrees; None if it is invalid, or zero as ArduPilot sends it before the origin and home are set."""
    if (lat_e7 == 0 and lon_e7 == 0) or abs(lat_e7) > 90 * 10**7 or abs(lon_e7) > 180 * 10**7:
        return None
    return lat_e7 / 1e7, lon_e7 / 1e7


def _position(vehicle: Vehicle, message: Message, now: float) -> None:
    # Even with a GPS fix the estimator may be using dead reckoning, and its position drifts.
    told = math.isfinite(vehicle.estimated_at)
    reckons = told and not (vehicle.estimated and now - vehicle.estimated_at <= STATUS_MAX_AGE_S)
    if reckons or not vehicle.located or now - vehicle.received_at > STATUS_MAX_AGE_S:
        return
    place = _place(message.integer("lat"), message.integer("lon"))
    if place is None:
        return
    vehicle.lat, vehicle.lon = place
    vehicle.altitude_m = message.integer("relative_alt") / 1e3
    vehicle.amsl_m = message.integer("alt") / 1e3
    vehicle.north_mps, vehicle.east_mps, vehicle.down_mps = (message.integer(name) / 100 for name in ("vx", "vy", "vz"))
    told_s = message.integer("time_boot_ms") / 1e3
    vehicle.courses.append((told_s, vehicle.north_mps, vehicle.east_mps))
    # Also drop velocities from before a restart.
    while not told_s - COURSE_S <= vehicle.courses[0][0] <= told_s:
        vehicle.courses.popleft()
    heading_cdeg = message.integer("hdg")
    if heading_cdeg != _UNKNOWN_U16:
        vehicle.yaw_deg = heading_cdeg / 100
    vehicle.position_at = now


def _attitude(vehicle: Vehicle, message: Message, now: float) -> None:
    angles = [math.degrees(message.real(name)) for name in ("roll", "pitch", "yaw")]
    # An attitude that was overtaken by a later one is outdated.
    if all(map(math.isfinite, angles)) and now >= vehicle.attitude_at:
        vehicle.roll_deg = angles[0]
        vehicle.pitch_deg = angles[1]
        vehicle.heading_deg = angles[2] % 360.0
        vehicle.attitude_at = now


def _gimbal(vehicle: Vehicle, message: Message, now: float) -> None:
    # 0 is of a release that does not number gimbals, 1 is the first one.
    if message.integer("gimbal_device_id") > 1 or now < vehicle.gimbal_at:
        return
    vehicle.gimbal = attitude_of(message, vehicle.heading_deg) if vehicle.gimbal_measured else None
    vehicle.gimbal_at = min(now, vehicle.attitude_at)


def _gimbal_limits(vehicle: Vehicle, message: Message, _now: float) -> None:
    if message.integer("gimbal_device_id") <= 1:
        least, most = (
            [math.degrees(message.real(f"{axis}_{end}")) for axis in ("pitch", "yaw")] for end in ("min", "max")
        )
        # A float32 in radians differs slightly from the degrees that it represents.
        limits = tuple((round(low, 3), round(high, 3)) for low, high in zip(least, most, strict=True))
        vehicle.gimbal_limits = limits if all(low < high for low, high in limits) else None


def _parameter(vehicle: Vehicle, message: Message, _now: float) -> None:
    if message.text("param_id") == vehicle.stack.gimbal_type:
        measures = message.real("param_value") in vehicle.stack.measured_gimbals
        # A changed type takes effect after the next start, which requests it again.
        vehicle.gimbal_measured = measures and vehicle.gimbal_measured is not False


def _home(vehicle: Vehicle, message: Message, _now: float) -> None:
    place = _place(message.integer("latitude"), message.integer("longitude"))
    if place is None:
        return
    vehicle.home = Home(*place, message.integer("altitude") / 1e3)
    # The first home after arming may have been lost. Then the next one counts, wherever the vehicle is.
    if not vehicle.in_air or vehicle.ground_home is None:
        vehicle.ground_home = vehicle.home


def _landed(vehicle: Vehicle, message: Message, now: float) -> None:
    vehicle.landed_state = message.integer("landed_state")
    vehicle.landed_at = now


def _status(vehicle: Vehicle, message: Message, now: float) -> None:
    # -1 and 0xFFFF: not measured.
    percent = message.integer("battery_remaining")
    millivolts = message.integer("voltage_battery")
    centiamperes = message.integer("current_battery")
    vehicle.battery_remaining = percent / 100 if percent >= 0 else math.nan
    vehicle.battery_v = millivolts / 1e3 if millivolts != _UNKNOWN_U16 else math.nan
    vehicle.battery_a = centiamperes / 100 if centiamperes >= 0 else math.nan
    present = message.integer("onboard_control_sensors_present") & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    healthy = message.integer("onboard_control_sensors_health") & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    vehicle.ready = bool(healthy) if present else vehicle.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX
    fence = mavlink.MAV_SYS_STATUS_GEOFENCE
    has_fence = message.integer("onboard_control_sensors_present") & fence
    vehicle.fenced = bool(message.integer("onboard_control_sensors_enabled") & fence) if has_fence else None
    vehicle.checks_at = now


def _estimator(vehicle: Vehicle, message: Message, now: float) -> None:
    # In modes that need no position the checks pass without one. The flags show if GUIDED has what it needs.
    vehicle.estimated = message.integer("flags") & _POSITIONED == _POSITIONED
    # A service that starts in flight has no earlier position. A vehicle with a position is assumed to have kept its path.
    begins = vehicle.placed_at == -math.inf and vehicle.estimated
    lost = vehicle.armed and not begins and now - vehicle.placed_at > PATH_KEPT_S
    vehicle.path_lost = vehicle.path_lost or lost
    if vehicle.estimated:
        vehicle.placed_at = now
    vehicle.estimated_at = now


def _gps(vehicle: Vehicle, message: Message, now: float) -> None:
    vehicle.received_at = now
    vehicle.fix_type = message.integer("fix_type")
    accuracy_mm = message.integer("h_acc")
    satellites = message.integer("satellites_visible")
    vehicle.satellites = satellites if satellites != _UNKNOWN_U8 else 0
    error = accuracy_mm / 1e3 if accuracy_mm else DEFAULT_ERROR_M
    vehicle.located = vehicle.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX and error <= MAX_ERROR_M
    if vehicle.located:
        vehicle.position_error_m = max(error, MIN_ERROR_M)


def _text(vehicle: Vehicle, message: Message, now: float) -> None:
    text = message.text("text")
    vehicle.texts.append(text)
    del vehicle.texts[:-20]
    number = vehicle.reports[-1][0] + 1 if vehicle.reports else 1
    vehicle.reports.append((number, message.integer("severity"), text))
    if vehicle.stack.tells_path_lost(text):
        vehicle.path_lost = True
    if vehicle.stack.tells_failsafe(text):
        vehicle.failsafe_text = text
        vehicle.failsafe_text_at = now


def _wind(vehicle: Vehicle, message: Message, now: float) -> None:
    from_deg = message.real("direction")
    speed_mps = message.real("speed")
    if math.isfinite(from_deg) and math.isfinite(speed_mps):
        vehicle.wind_from_deg = from_deg % 360.0
        vehicle.wind_mps = speed_mps
        vehicle.wind_at = now


_HANDLERS = {
    "HEARTBEAT": _heartbeat,
    "GLOBAL_POSITION_INT": _position,
    "ATTITUDE": _attitude,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": _gimbal,
    "GIMBAL_MANAGER_INFORMATION": _gimbal_limits,
    "PARAM_VALUE": _parameter,
    "HOME_POSITION": _home,
    "EXTENDED_SYS_STATE": _landed,
    "SYS_STATUS": _status,
    "EKF_STATUS_REPORT": _estimator,
    "GPS_RAW_INT": _gps,
    "STATUSTEXT": _text,
    "WIND": _wind,
}
