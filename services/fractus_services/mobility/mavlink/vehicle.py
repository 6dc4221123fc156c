"""State of the vehicle, updated from the messages of its autopilot."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field

from fractus_core.policy.decision_types import Home
from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.mobility.autopilot import (
    DEFAULT_ERROR_M,
    MAX_POSITION_AGE_S,
    VELOCITY_HISTORY_S,
    StatusText,
    VehicleState,
)
from fractus_services.mobility.mavlink.flight_stack import FlightStack
from fractus_services.mobility.mavlink.gimbal import attitude_of
from fractus_services.mobility.mavlink.position_checks import VARIANCES, GpsFix, PositionChecks, ReportedPosition

log = logging.getLogger(__name__)

_UNKNOWN_U8 = 0xFF
_UNKNOWN_U16 = 0xFFFF
"""Values of fields of 8 and of 16 bits that mean "unknown"."""

_POSITIONED = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_PRED_POS_HORIZ_ABS

MIN_ERROR_M = 0.5
MAX_ERROR_M = 10.0
"""Range of the position error, in metres (1 sigma).

A reported error below `MIN_ERROR_M` is replaced by `MIN_ERROR_M`. If the reported error is above `MAX_ERROR_M`,
positions are ignored.
"""

STATUS_MAX_AGE_S = 10.0
"""Maximum age of the estimator and GPS status, in seconds of the vehicle's clock.

The autopilot sends them at least once per second. After a longer silence the estimator may be using dead reckoning.
"""

STOPPED_S = 0.7
"""Time for which heartbeats (one per second) must report stopped motors in flight before the motors count as stopped."""

IN_FLIGHT_ALTITUDE_M = 3.0
"""Altitude above home above which a drone whose motors stop has not landed near home."""

STARTED_S = 5.0
"""Time for which a drone counts as flying after its motors have started, because it may be about to take off.

After a gap of this length between heartbeats, a report of stopped motors is accepted at once, because the drone may have
landed during the gap.
"""

TRUSTED_AGAIN_S = 30.0
"""Time for which the position must have been trusted, so that a further sign of a wrong position begins a new problem.

A sign before this time continues the previous problem.

It is in seconds of the vehicle's clock.
"""

PATH_KEPT_S = 12.0
"""Time without a position after which the recorded path counts as lost, in seconds of the vehicle's clock.

ArduCopter discards the path after 15 s and reports that once. The limit is lower, because the report may be lost.
"""


@dataclass(slots=True)
class Vehicle(VehicleState):
    """Vehicle state with the rules that update it from messages.

    Attributes:
        stack: Firmware of the autopilot.
        unsupported: Reason why the vehicle is not supported; empty if it is.
        gimbal_measured: True if the firmware measures the attitude of its gimbal; None until it reports the gimbal's type.
        positioned_at: Time at which the estimator last had a position.
        gps_at: Time of the last GPS message.
        fence_enabled: True if the vehicle's fence is enabled; None if it has no fence. Reported at `checks_at`.
        started_at: Time of the first heartbeat that reported running motors.
        stopping_at: Time since which all heartbeats have reported stopped motors in flight; infinite if the last heartbeat reported running motors.
        gimbal_limits: Smallest and largest pitch and yaw of the gimbal, degrees; None until they are reported.
        position_checks: Signs of a wrong position.
        second_error_m: Position error of the second GPS receiver; 0 without one or if it has no fix.
        second_gps_at: Time of the last message of a second receiver with a fix; infinite without one or if it has no fix.
        reported_at: Time of the last position message, trusted or not.
        resumed_at: Time of the first position message after an interruption.
    """

    stack: FlightStack = field(kw_only=True)
    unsupported: str = ""
    gimbal_measured: bool | None = None
    gimbal_limits: tuple[tuple[float, float], ...] | None = None
    positioned_at: float = -math.inf
    gps_at: float = -math.inf
    fence_enabled: bool | None = None
    started_at: float = -math.inf
    stopping_at: float = math.inf
    position_checks: PositionChecks = field(default_factory=PositionChecks)
    second_error_m: float = 0.0
    second_gps_at: float = math.inf
    reported_at: float = -math.inf
    resumed_at: float = -math.inf

    @property
    def pace(self) -> float:
        """Seconds of the vehicle's clock per second of real time."""
        return self.position_checks.pace

    def estimator_positioned(self, now: float) -> bool:
        """Return True if the estimator has reported an absolute position recently, and not only before an interruption.

        Without such a report, the estimator may be using dead reckoning even with a GPS fix, or may have accepted a wrong position.
        """
        recent = now - self.estimated_at <= STATUS_MAX_AGE_S / self.pace
        return self.estimated and recent and self.estimated_at >= self.resumed_at - MAX_POSITION_AGE_S

    def take(self, message: Message, now: float) -> None:
        """Update the state from a message."""
        handler = _HANDLERS.get(message.name)
        if handler is not None:
            handler(self, message, now)


def _heartbeat(vehicle: Vehicle, message: Message, now: float) -> None:
    vehicle.heartbeat_gap_s = now - vehicle.heartbeat_at if math.isfinite(vehicle.heartbeat_at) else 0.0
    vehicle.heartbeat_at = now
    vehicle.unsupported = vehicle.stack.unsupported(message.integer("type"), message.integer("autopilot"))
    armed = bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    # Heartbeats from before the start of the motors may arrive late or twice, and they have no time stamp. If such a heartbeat
    # were accepted, the next one would seem to report motors that another station started.
    flies = vehicle.in_air or now - vehicle.started_at < STARTED_S
    stops = vehicle.armed and not armed and flies and vehicle.heartbeat_gap_s < STARTED_S
    vehicle.stopping_at = min(vehicle.stopping_at, now) if stops else math.inf
    if stops and now - vehicle.stopping_at < STOPPED_S:
        return
    vehicle.mode = vehicle.stack.mode(message.integer("custom_mode"))
    if armed and not vehicle.armed:
        # Arming moves home to the position of the vehicle, so the previous home does not apply to this flight.
        vehicle.ground_home = None
        vehicle.started_at = now
    if armed or vehicle.armed:
        vehicle.stopped_in_air = not armed and _was_in_flight(vehicle)
    vehicle.armed = armed
    vehicle.path_lost = vehicle.path_lost and vehicle.armed
    vehicle.failsafe = message.integer("system_status") in {mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_EMERGENCY}


def _was_in_flight(vehicle: Vehicle) -> bool:
    """Return True if the last reports before the motors stopped were from a flight above the ground, and not from a landing.

    A drone that landed by itself while the link was cut is still in the mode that brought it down. A restarted autopilot is not.
    """
    flying = vehicle.landed_state == mavlink.MAV_LANDED_STATE_IN_AIR and vehicle.altitude_m > IN_FLIGHT_ALTITUDE_M
    return flying and not vehicle.mode.comes_down


def _place(lat_e7: int, lon_e7: int) -> tuple[float, float] | None:
    """Return a place in degrees. None if it is invalid, or 0, 0, which ArduPilot sends before its origin and home are set."""
    if (lat_e7 == 0 and lon_e7 == 0) or abs(lat_e7) > 90 * 10**7 or abs(lon_e7) > 180 * 10**7:
        return None
    return lat_e7 / 1e7, lon_e7 / 1e7


def _check_position(vehicle: Vehicle, now: float) -> bool:
    """Return True if the position may be trusted. If not, store the problem.

    Only a position that is accepted clears the problem, so that no reader sees a trusted position that is seconds old.
    """
    problem = vehicle.position_checks.problem(now)
    if not problem:
        return True
    if not vehicle.position_problem:
        # Signs that recur soon belong to one problem. Otherwise the drone would wait for its end until the battery is empty.
        if now - vehicle.position_trusted_at > TRUSTED_AGAIN_S / vehicle.pace:
            vehicle.position_problem_at = now
        log.warning("position: no longer trusted (reason=%s)", problem)
    vehicle.position_problem = problem
    return False


def _position(vehicle: Vehicle, message: Message, now: float) -> None:
    place = _place(message.integer("lat"), message.integer("lon"))
    if place is None:
        return
    boot_s = message.integer("time_boot_ms") / 1e3
    amsl_m = message.integer("alt") / 1e3
    north_mps, east_mps, down_mps = (message.integer(name) / 100 for name in ("vx", "vy", "vz"))
    reported = ReportedPosition(boot_s, *place, amsl_m, north_mps, east_mps, down_mps)
    if now - vehicle.reported_at > MAX_POSITION_AGE_S:
        vehicle.resumed_at = now
    vehicle.reported_at = now
    if vehicle.position_checks.take_position(reported, vehicle.position_error_m, now, moves=vehicle.armed):
        log.info("position: the autopilot has restarted")
        vehicle.second_error_m = 0.0
        vehicle.second_gps_at = math.inf
    plausible = _check_position(vehicle, now)
    expected = vehicle.position_checks.expected
    vehicle.expected_place = (expected.position.lat, expected.position.lon) if expected is not None else None
    vehicle.expected_error_m = expected.unseen_m if expected is not None else 0.0
    located = vehicle.located and now - min(vehicle.gps_at, vehicle.second_gps_at) <= STATUS_MAX_AGE_S / vehicle.pace
    if not plausible or not located or not vehicle.estimator_positioned(now):
        return
    if vehicle.position_problem:
        log.info("position: trusted again")
        vehicle.position_problem = ""
        vehicle.position_trusted_at = now
    vehicle.lat, vehicle.lon = place
    vehicle.altitude_m = message.integer("relative_alt") / 1e3
    vehicle.amsl_m = amsl_m
    vehicle.north_mps = north_mps
    vehicle.east_mps = east_mps
    vehicle.down_mps = down_mps
    vehicle.velocity_history.append((boot_s, vehicle.north_mps, vehicle.east_mps))
    # Also drop velocities from before a restart.
    while not boot_s - VELOCITY_HISTORY_S <= vehicle.velocity_history[0][0] <= boot_s:
        vehicle.velocity_history.popleft()
    heading_cdeg = message.integer("hdg")
    if heading_cdeg != _UNKNOWN_U16:
        vehicle.yaw_deg = heading_cdeg / 100
    vehicle.position_at = now


def _attitude(vehicle: Vehicle, message: Message, now: float) -> None:
    angles = [math.degrees(message.real(name)) for name in ("roll", "pitch", "yaw")]
    # An attitude that was overtaken by a later attitude is outdated.
    if all(map(math.isfinite, angles)) and now >= vehicle.attitude_at:
        vehicle.roll_deg = angles[0]
        vehicle.pitch_deg = angles[1]
        vehicle.heading_deg = angles[2] % 360.0
        vehicle.attitude_at = now


def _gimbal(vehicle: Vehicle, message: Message, now: float) -> None:
    # Releases that do not number gimbals report 0. The first gimbal is 1.
    if message.integer("gimbal_device_id") > 1 or now < vehicle.gimbal_at:
        return
    vehicle.gimbal = attitude_of(message, vehicle.heading_deg) if vehicle.gimbal_measured else None
    vehicle.gimbal_at = min(now, vehicle.attitude_at)


def _gimbal_limits(vehicle: Vehicle, message: Message, _now: float) -> None:
    if message.integer("gimbal_device_id") <= 1:
        # The message contains radians as float32. Rounding restores the degrees that the vehicle's owner configured.
        limits = tuple(
            (
                round(math.degrees(message.real(f"{axis}_min")), 3),
                round(math.degrees(message.real(f"{axis}_max")), 3),
            )
            for axis in ("pitch", "yaw")
        )
        vehicle.gimbal_limits = limits if all(low < high for low, high in limits) else None


def _parameter(vehicle: Vehicle, message: Message, _now: float) -> None:
    if message.text("param_id") == vehicle.stack.variance_limit:
        vehicle.position_checks.set_variance_limit(message.real("param_value"))
    if message.text("param_id") == vehicle.stack.gimbal_type:
        measures = message.real("param_value") in vehicle.stack.measured_gimbals
        # If the type was changed, the autopilot uses the new type only after a restart. The type is then requested
        # again.
        vehicle.gimbal_measured = measures and vehicle.gimbal_measured is not False


def _home(vehicle: Vehicle, message: Message, _now: float) -> None:
    place = _place(message.integer("latitude"), message.integer("longitude"))
    if place is None:
        return
    vehicle.home = Home(*place, message.integer("altitude") / 1e3)
    # The home that was reported after arming may have been lost. The next reported home is then used, even in flight.
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
    vehicle.fence_enabled = bool(message.integer("onboard_control_sensors_enabled") & fence) if has_fence else None
    vehicle.checks_at = now


def _estimator(vehicle: Vehicle, message: Message, now: float) -> None:
    # In modes that need no position, the pre-arm checks pass without a position. These flags show if the position that
    # GUIDED needs is available.
    vehicle.estimated = message.integer("flags") & _POSITIONED == _POSITIONED
    # A service that starts in flight received no earlier positions. It assumes that a vehicle with a position has kept its path.
    first_estimate = vehicle.positioned_at == -math.inf and vehicle.estimated
    lost = vehicle.armed and not first_estimate and now - vehicle.positioned_at > PATH_KEPT_S / vehicle.pace
    vehicle.path_lost = vehicle.path_lost or lost
    if vehicle.estimated:
        vehicle.positioned_at = now
    variances = {name: message.real(name) for name in VARIANCES}
    vehicle.position_checks.take_estimator(message.integer("flags"), variances, now, positioned=vehicle.estimated)
    vehicle.estimated_at = now
    _check_position(vehicle, now)


def _gps(vehicle: Vehicle, message: Message, now: float) -> None:
    vehicle.gps_at = now
    vehicle.fix_type = message.integer("fix_type")
    satellites = message.integer("satellites_visible")
    vehicle.satellites = satellites if satellites != _UNKNOWN_U8 else 0
    # The estimator may use either receiver.
    error = max(_gps_error_m(message), vehicle.second_error_m)
    vehicle.located = vehicle.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX and error <= MAX_ERROR_M
    if not vehicle.located:
        return
    vehicle.position_error_m = max(error, MIN_ERROR_M)
    _compare_gps(vehicle, message, now)


def _second_gps(vehicle: Vehicle, message: Message, now: float) -> None:
    """Process GPS2_RAW, which a vehicle with two receivers sends. Its position must agree with the estimate as well."""
    if message.integer("fix_type") < mavlink.GPS_FIX_TYPE_3D_FIX:
        vehicle.second_error_m = 0.0
        vehicle.second_gps_at = math.inf
        vehicle.position_checks.forget_gps(message.name, now)
        return
    vehicle.second_gps_at = now
    vehicle.second_error_m = _gps_error_m(message)
    _compare_gps(vehicle, message, now)


def _gps_error_m(message: Message) -> float:
    """Return the horizontal position error that a GPS receiver reports, 1 sigma in metres."""
    accuracy_mm = message.integer("h_acc")
    return accuracy_mm / 1e3 if accuracy_mm else DEFAULT_ERROR_M


def _compare_gps(vehicle: Vehicle, message: Message, now: float) -> None:
    place = _place(message.integer("lat"), message.integer("lon"))
    if place is not None:
        error_m = max(_gps_error_m(message), MIN_ERROR_M)
        vehicle.position_checks.take_gps(GpsFix(message.name, *place, error_m, message.integer("time_usec")), now)
        _check_position(vehicle, now)


def _text(vehicle: Vehicle, message: Message, now: float) -> None:
    text = message.text("text")
    vehicle.texts.append((now, text))
    del vehicle.texts[:-20]
    number = vehicle.status_texts[-1].number + 1 if vehicle.status_texts else 1
    vehicle.status_texts.append(StatusText(number, now, message.integer("severity"), text))
    if vehicle.stack.reports_path_lost(text):
        vehicle.path_lost = True
    if vehicle.stack.reports_estimator_switch(text):
        vehicle.position_checks.take_estimator_switch(now)
        _check_position(vehicle, now)
    if vehicle.stack.reports_failsafe(text):
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
    "GPS2_RAW": _second_gps,
    "STATUSTEXT": _text,
    "WIND": _wind,
}
