"""Telemetry of state: heartbeat, health, version, mission and fence."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.accessories import relays_present
from fractus_vehicle.copter import CAPABILITIES, FLIGHT_VERSION
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.report_units import UNKNOWN_U16, Values, boot_ms
from fractus_vehicle.shaping import clamp
from fractus_vehicle.state import VehicleState

_POSITION_CONTROLS = (
    mavlink.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL | mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
)
_CONTROLS = (
    mavlink.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mavlink.MAV_SYS_STATUS_SENSOR_YAW_POSITION
) | mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
_SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_TERRAIN
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    | mavlink.MAV_SYS_STATUS_PREARM_CHECK
    | mavlink.MAV_SYS_STATUS_SENSOR_PROPULSION
)
_PRESENT = _SENSORS | _CONTROLS | _POSITION_CONTROLS | mavlink.MAV_SYS_STATUS_GEOFENCE | mavlink.MAV_SYS_STATUS_LOGGING
_HEALTHY = (
    _SENSORS
    | mavlink.MAV_SYS_STATUS_GEOFENCE
    | mavlink.MAV_SYS_STATUS_LOGGING
    | mavlink.MAV_SYS_STATUS_SENSOR_PROXIMITY
)
_ALTITUDE_ONLY = frozenset({mavlink.COPTER_MODE_ALT_HOLD, mavlink.COPTER_MODE_GUIDED_NOGPS})
WITHOUT_POSITION_CONTROL = _ALTITUDE_ONLY | {
    mavlink.COPTER_MODE_STABILIZE,
    mavlink.COPTER_MODE_ACRO,
    mavlink.COPTER_MODE_DRIFT,
}


def heartbeat(v: VehicleState) -> Values:
    """Build HEARTBEAT like ArduCopter."""
    flags = (
        mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        | mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    )
    # The guided flag is set in modes with position control. In all modes, it is also set until the main loop starts.
    if v.mode not in WITHOUT_POSITION_CONTROL or not v.estimator.initialised:
        flags |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
    if v.armed or v.motor_test_until_s is not None:
        flags |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    state = mavlink.MAV_STATE_STANDBY if v.landed else mavlink.MAV_STATE_ACTIVE
    if not v.estimator.initialised:
        state = mavlink.MAV_STATE_BOOT
    elif v.failsafes.any:
        state = mavlink.MAV_STATE_CRITICAL
    return {
        "type": mavlink.MAV_TYPE_QUADROTOR,
        "autopilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        "base_mode": int(flags),
        "custom_mode": int(v.mode),
        "system_status": int(state),
        "mavlink_version": 3,
    }


def sys_status(v: VehicleState) -> Values:
    """Build SYS_STATUS with health bits."""
    controls = _CONTROLS
    if v.mode in _ALTITUDE_ONLY:
        controls |= mavlink.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
    elif v.mode not in WITHOUT_POSITION_CONTROL:
        controls |= _POSITION_CONTROLS
    healthy = _HEALTHY | controls
    if v.gps.fix_type < mavlink.GPS_FIX_TYPE_3D_FIX:
        healthy &= ~mavlink.MAV_SYS_STATUS_SENSOR_GPS
    if not v.estimator.active:
        healthy &= ~mavlink.MAV_SYS_STATUS_AHRS
    if v.failsafes.radio:
        healthy &= ~mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    if v.failsafes.battery:
        healthy &= ~mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    if v.fence.breaches:
        healthy &= ~mavlink.MAV_SYS_STATUS_GEOFENCE
    if not v.armed and arming_refusals(v):
        healthy &= ~mavlink.MAV_SYS_STATUS_PREARM_CHECK
    return {
        "onboard_control_sensors_present": _PRESENT,
        "onboard_control_sensors_enabled": _SENSORS
        | controls
        | (mavlink.MAV_SYS_STATUS_GEOFENCE if v.fence.enabled else 0),
        "onboard_control_sensors_health": healthy,
        "load": 250,
        "voltage_battery": round(v.battery.voltage_v * 1000.0),
        "current_battery": int(clamp(round(v.battery.current_a * 100.0), -1, 32767)),
        "battery_remaining": v.battery.percent,
        "drop_rate_comm": 0,
        "errors_comm": 0,
    }


def extended_sys_state(v: VehicleState) -> Values:
    """Build EXTENDED_SYS_STATE."""
    return {"vtol_state": mavlink.MAV_VTOL_STATE_MC, "landed_state": int(v.landed_state)}


def autopilot_version(_v: VehicleState) -> Values:
    """Build AUTOPILOT_VERSION."""
    return {
        "capabilities": CAPABILITIES,
        "flight_sw_version": FLIGHT_VERSION,
        "middleware_sw_version": 0,
        "os_sw_version": 0,
        "board_version": 0,
        "flight_custom_version": tuple(b"fractus0"),
    }


def mission_current(v: VehicleState) -> Values:
    """Build MISSION_CURRENT."""
    return v.mission.report(v.mode)


def mission_item_reached(v: VehicleState) -> Values:
    """Build MISSION_ITEM_REACHED: the last reached item, or 65535 if no item was reached since the start."""
    return {"seq": UNKNOWN_U16 if v.last_item_reached is None else v.last_item_reached}


def relay_status(v: VehicleState) -> Values:
    """Build RELAY_STATUS: bit masks of the enabled relays, and of the relays that are on."""
    present = relays_present(v)
    return {
        "time_boot_ms": boot_ms(v),
        "present": sum(1 << number for number in present),
        "on": sum(1 << number for number in present & v.relays_on),
    }


def hwstatus(_v: VehicleState) -> Values:
    """Build HWSTATUS."""
    return {"Vcc": 5000, "I2Cerr": 0}


def power_status(_v: VehicleState) -> Values:
    """Build POWER_STATUS."""
    return {"Vcc": 5000, "Vservo": 0, "flags": 0}


def meminfo(_v: VehicleState) -> Values:
    """Build MEMINFO."""
    return {"brkval": 0, "freemem": UNKNOWN_U16, "freemem32": 131072}


def fence_status(v: VehicleState) -> Values | None:
    """Build FENCE_STATUS if a fence is enabled."""
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
    """Build SYSTEM_TIME."""
    return {"time_unix_usec": v.unix_us, "time_boot_ms": boot_ms(v)}
