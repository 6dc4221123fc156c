"""Telemetry of state: heartbeat, health, version, mission and fence."""

from __future__ import annotations

from fractus_mavlink.enums import (
    COPTER_MODE,
    GPS_FIX_TYPE,
    MAV_AUTOPILOT,
    MAV_MODE_FLAG,
    MAV_STATE,
    MAV_SYS_STATUS_SENSOR,
    MAV_TYPE,
    MAV_VTOL_STATE,
)

from fractus_vehicle.copter import CAPABILITIES, FLIGHT_VERSION
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.report_units import UNKNOWN_U16, Values, boot_ms
from fractus_vehicle.shaping import clamp
from fractus_vehicle.state import VehicleState

_SENSOR = MAV_SYS_STATUS_SENSOR
_POSITION_CONTROLS = _SENSOR.SENSOR_Z_ALTITUDE_CONTROL | _SENSOR.SENSOR_XY_POSITION_CONTROL
_CONTROLS = (
    _SENSOR.SENSOR_ANGULAR_RATE_CONTROL | _SENSOR.SENSOR_ATTITUDE_STABILIZATION | _SENSOR.SENSOR_YAW_POSITION
) | _SENSOR.SENSOR_MOTOR_OUTPUTS
_SENSORS = (
    _SENSOR.SENSOR_3D_GYRO
    | _SENSOR.SENSOR_3D_ACCEL
    | _SENSOR.SENSOR_3D_MAG
    | _SENSOR.SENSOR_ABSOLUTE_PRESSURE
    | _SENSOR.SENSOR_GPS
    | _SENSOR.SENSOR_RC_RECEIVER
    | _SENSOR.AHRS
    | _SENSOR.TERRAIN
    | _SENSOR.SENSOR_BATTERY
    | _SENSOR.PREARM_CHECK
    | _SENSOR.SENSOR_PROPULSION
)
_PRESENT = _SENSORS | _CONTROLS | _POSITION_CONTROLS | _SENSOR.GEOFENCE | _SENSOR.LOGGING
_HEALTHY = _SENSORS | _SENSOR.GEOFENCE | _SENSOR.LOGGING | _SENSOR.SENSOR_PROXIMITY
_ALTITUDE_ONLY = frozenset({COPTER_MODE.ALT_HOLD, COPTER_MODE.GUIDED_NOGPS})
WITHOUT_POSITION_CONTROL = _ALTITUDE_ONLY | {COPTER_MODE.STABILIZE, COPTER_MODE.ACRO, COPTER_MODE.DRIFT}


def heartbeat(v: VehicleState) -> Values:
    """HEARTBEAT as ArduCopter fills it."""
    flags = MAV_MODE_FLAG.CUSTOM_MODE_ENABLED | MAV_MODE_FLAG.STABILIZE_ENABLED | MAV_MODE_FLAG.MANUAL_INPUT_ENABLED
    # Set while the position controller runs, and before the main loop does.
    if v.mode not in WITHOUT_POSITION_CONTROL or not v.estimator.initialised:
        flags |= MAV_MODE_FLAG.GUIDED_ENABLED
    if v.armed or v.motor_test_until_s is not None:
        flags |= MAV_MODE_FLAG.SAFETY_ARMED
    state = MAV_STATE.STANDBY if v.landed else MAV_STATE.ACTIVE
    if not v.estimator.initialised:
        state = MAV_STATE.BOOT
    elif v.failsafes.any:
        state = MAV_STATE.CRITICAL
    return {
        "type": MAV_TYPE.QUADROTOR,
        "autopilot": MAV_AUTOPILOT.ARDUPILOTMEGA,
        "base_mode": int(flags),
        "custom_mode": int(v.mode),
        "system_status": int(state),
        "mavlink_version": 3,
    }


def sys_status(v: VehicleState) -> Values:
    """SYS_STATUS with the health bits that clients look at."""
    controls = _CONTROLS
    if v.mode in _ALTITUDE_ONLY:
        controls |= _SENSOR.SENSOR_Z_ALTITUDE_CONTROL
    elif v.mode not in WITHOUT_POSITION_CONTROL:
        controls |= _POSITION_CONTROLS
    healthy = _HEALTHY | controls
    if v.gps.fix_type < GPS_FIX_TYPE.TYPE_3D_FIX:
        healthy &= ~_SENSOR.SENSOR_GPS
    if not v.estimator.active:
        healthy &= ~_SENSOR.AHRS
    if v.failsafes.radio:
        healthy &= ~_SENSOR.SENSOR_RC_RECEIVER
    if v.failsafes.battery:
        healthy &= ~_SENSOR.SENSOR_BATTERY
    if v.fence.breaches:
        healthy &= ~_SENSOR.GEOFENCE
    if not v.armed and arming_refusals(v):
        healthy &= ~_SENSOR.PREARM_CHECK
    return {
        "onboard_control_sensors_present": _PRESENT,
        "onboard_control_sensors_enabled": _SENSORS | controls | (_SENSOR.GEOFENCE if v.fence.enabled else 0),
        "onboard_control_sensors_health": healthy,
        "load": 250,
        "voltage_battery": round(v.battery.voltage_v * 1000.0),
        "current_battery": int(clamp(round(v.battery.current_a * 100.0), -1, 32767)),
        "battery_remaining": v.battery.percent,
        "drop_rate_comm": 0,
        "errors_comm": 0,
    }


def extended_sys_state(v: VehicleState) -> Values:
    """EXTENDED_SYS_STATE."""
    return {"vtol_state": MAV_VTOL_STATE.MC, "landed_state": int(v.landed_state)}


def autopilot_version(_v: VehicleState) -> Values:
    """AUTOPILOT_VERSION."""
    return {
        "capabilities": CAPABILITIES,
        "flight_sw_version": FLIGHT_VERSION,
        "middleware_sw_version": 0,
        "os_sw_version": 0,
        "board_version": 0,
        "flight_custom_version": tuple(b"fractus0"),
    }


def mission_current(v: VehicleState) -> Values:
    """MISSION_CURRENT."""
    total = max(0, len(v.mission.items) - 1)
    return {
        "seq": v.mission.current,
        "total": total,
        "mission_state": v.mission.state(v.mode),
        "mission_mode": 1 if v.mode is COPTER_MODE.AUTO else 0,
    }


def hwstatus(_v: VehicleState) -> Values:
    """HWSTATUS."""
    return {"Vcc": 5000, "I2Cerr": 0}


def power_status(_v: VehicleState) -> Values:
    """POWER_STATUS."""
    return {"Vcc": 5000, "Vservo": 0, "flags": 0}


def meminfo(_v: VehicleState) -> Values:
    """MEMINFO."""
    return {"brkval": 0, "freemem": UNKNOWN_U16, "freemem32": 131072}


def fence_status(v: VehicleState) -> Values | None:
    """FENCE_STATUS, while a fence is enabled."""
    if not v.fence.enabled:
        return None
    return {
        "breach_status": 1 if v.fence.breaches else 0,
        "breach_count": v.fence.breach_count,
        "breach_type": v.fence.breach_type,
        "breach_mitigation": 1 if v.fence.limiting else 0,
        "breach_time": int(v.fence.breach_time_s * 1000.0),
    }


def system_time(v: VehicleState) -> Values:
    """SYSTEM_TIME."""
    return {"time_unix_usec": v.unix_us, "time_boot_ms": boot_ms(v)}
