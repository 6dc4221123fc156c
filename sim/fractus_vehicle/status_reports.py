"""Telemetry of state: heartbeat, health, version, mission and fence."""

from __future__ import annotations

from fractus_vehicle.mav import (
    AUTOPILOT_ARDUPILOTMEGA,
    CAPABILITIES,
    FLIGHT_VERSION,
    TYPE_QUADROTOR,
    Mode,
    ModeFlag,
    State,
)
from fractus_vehicle.readiness import arming_refusal
from fractus_vehicle.report_units import UNKNOWN_U16, Values, boot_ms
from fractus_vehicle.shaping import clamp
from fractus_vehicle.state import VehicleState

_PREARM_CHECK = 0x10000000
_SENSORS_PRESENT = 0x5320FC2F  # gyro, accel, mag, baro, GPS, controllers, motors, AHRS, logging, battery, pre-arm
_SENSOR_GPS = 0x20
_SENSOR_AHRS = 0x200000
_SENSOR_BATTERY = 0x2000000
_SENSOR_FENCE = 0x100000
_MOTOR_OUTPUTS = 0x8000
_POSITION_CONTROLS = 0x6000


def heartbeat(v: VehicleState) -> Values:
    """HEARTBEAT as ArduCopter fills it."""
    flags = ModeFlag.CUSTOM
    if v.mode not in (Mode.STABILIZE,):
        flags |= ModeFlag.GUIDED if v.mode in (Mode.AUTO, Mode.RTL, Mode.GUIDED, Mode.LOITER) else ModeFlag.CUSTOM
    flags |= ModeFlag.STABILIZE | ModeFlag.MANUAL_INPUT
    if v.armed:
        flags |= ModeFlag.SAFETY_ARMED
    state = State.STANDBY if v.landed else State.ACTIVE
    if v.failsafes.any:
        state = State.CRITICAL
    return {
        "type": TYPE_QUADROTOR,
        "autopilot": AUTOPILOT_ARDUPILOTMEGA,
        "base_mode": int(flags),
        "custom_mode": int(v.mode),
        "system_status": int(state),
        "mavlink_version": 3,
    }


def sys_status(v: VehicleState) -> Values:
    """SYS_STATUS with the health bits that clients look at."""
    enabled = _SENSORS_PRESENT & ~(_SENSOR_FENCE | _MOTOR_OUTPUTS | _POSITION_CONTROLS)
    if v.armed:
        enabled |= _MOTOR_OUTPUTS
    if v.mode not in (Mode.STABILIZE, Mode.ALT_HOLD):
        enabled |= _POSITION_CONTROLS
    present = _SENSORS_PRESENT
    if v.fence.enabled:
        enabled |= _SENSOR_FENCE
    if v.fence.enabled or v.fence.shapes:
        present |= _SENSOR_FENCE
    healthy = _SENSORS_PRESENT | _SENSOR_FENCE
    if v.gps.fix_type < 3:
        healthy &= ~_SENSOR_GPS
    if not v.position_ok:
        healthy &= ~_SENSOR_AHRS
    if v.failsafes.battery:
        healthy &= ~_SENSOR_BATTERY
    if v.fence.breaches:
        healthy &= ~_SENSOR_FENCE
    if arming_refusal(v) is not None:
        healthy &= ~_PREARM_CHECK
    return {
        "onboard_control_sensors_present": present,
        "onboard_control_sensors_enabled": enabled,
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
    return {"vtol_state": 0, "landed_state": int(v.landed_state)}


def autopilot_version(v: VehicleState) -> Values:
    """AUTOPILOT_VERSION."""
    return {
        "capabilities": CAPABILITIES,
        "flight_sw_version": FLIGHT_VERSION,
        "middleware_sw_version": 0,
        "os_sw_version": 0,
        "board_version": 0,
        "flight_custom_version": tuple(b"fractus0"),
        "uid": v.sysid,
    }


def mission_current(v: VehicleState) -> Values:
    """MISSION_CURRENT."""
    total = max(0, len(v.mission.items) - 1)
    return {
        "seq": v.mission.current,
        "total": total if total else UNKNOWN_U16,
        "mission_state": v.mission.state(v.mode),
        "mission_mode": 1 if v.mode is Mode.AUTO else 2,
    }


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
        "breach_time": int(v.fence.breach_time_s * 1000.0),
    }


def system_time(v: VehicleState) -> Values:
    """SYSTEM_TIME."""
    return {"time_unix_usec": v.unix_us, "time_boot_ms": boot_ms(v)}
