"""What the vehicle reports: one builder per message, and ArduCopter's grouping of messages into streams."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from fractus_sim.vehicle.body import GRAVITY
from fractus_sim.vehicle.control import Axis
from fractus_sim.vehicle.mav import (
    AUTOPILOT_ARDUPILOTMEGA,
    CAPABILITIES,
    FLIGHT_VERSION,
    TYPE_QUADROTOR,
    Mode,
    ModeFlag,
    State,
)
from fractus_sim.vehicle.shaping import clamp

if TYPE_CHECKING:
    from fractus_sim.vehicle.vehicle import Vehicle
    from fractus_sim.vehicle.wire import Value

Values = Mapping[str, "Value"]
Builder = Callable[["Vehicle"], "Values | None"]

_U16 = 65535
_PREARM_CHECK = 0x10000000
_SENSORS_PRESENT = 0x5321DC2F  # gyro, accel, mag, baro, GPS, controllers, motors, AHRS, logging, battery, pre-arm
_SENSOR_GPS = 0x20
_SENSOR_AHRS = 0x200000
_SENSOR_BATTERY = 0x2000000
_SENSOR_FENCE = 0x100000
_MOTOR_OUTPUTS = 0x8000
_POSITION_CONTROLS = 0x6000


def _ms(vehicle: Vehicle) -> int:
    return int(vehicle.time_s * 1000.0) & 0xFFFFFFFF


def _us(vehicle: Vehicle) -> int:
    return int(vehicle.time_s * 1e6)


def _cm(value: float) -> int:
    return int(clamp(round(value * 100.0), -32768, 32767))


def _milli(value: float) -> int:
    return int(clamp(round(value * 1000.0), -32768, 32767))


def heartbeat(v: Vehicle) -> Values:
    """HEARTBEAT as ArduCopter fills it."""
    flags = ModeFlag.CUSTOM
    if v.mode not in (Mode.STABILIZE,):
        flags |= ModeFlag.GUIDED if v.mode in (Mode.AUTO, Mode.RTL, Mode.GUIDED, Mode.LOITER) else ModeFlag.CUSTOM
    flags |= ModeFlag.STABILIZE | ModeFlag.MANUAL_INPUT
    if v.armed:
        flags |= ModeFlag.SAFETY_ARMED
    state = State.STANDBY if v.landed else State.ACTIVE
    if v.failsafes.any_active:
        state = State.CRITICAL
    return {
        "type": TYPE_QUADROTOR,
        "autopilot": AUTOPILOT_ARDUPILOTMEGA,
        "base_mode": int(flags),
        "custom_mode": int(v.mode),
        "system_status": int(state),
        "mavlink_version": 3,
    }


def global_position_int(v: Vehicle) -> Values:
    """GLOBAL_POSITION_INT: the estimate; zeros until there is one."""
    e = v.est
    if v.origin is None:
        return {"time_boot_ms": _ms(v), "hdg": v.heading_cdeg}
    place = v.place
    relative = place.alt_m - (v.home.alt_m if v.home is not None else v.origin.alt_m)
    return {
        "time_boot_ms": _ms(v),
        "lat": place.lat_e7,
        "lon": place.lon_e7,
        "alt": round(place.alt_m * 1000.0),
        "relative_alt": round(relative * 1000.0),
        "vx": _cm(e.vn),
        "vy": _cm(e.ve),
        "vz": _cm(e.vd),
        "hdg": v.heading_cdeg,
    }


def local_position_ned(v: Vehicle) -> Values | None:
    """LOCAL_POSITION_NED, from the estimator's origin."""
    if v.origin is None:
        return None
    e = v.est
    return {"time_boot_ms": _ms(v), "x": e.north, "y": e.east, "z": e.down, "vx": e.vn, "vy": e.ve, "vz": e.vd}


def attitude(v: Vehicle) -> Values:
    """ATTITUDE."""
    e = v.est
    return {
        "time_boot_ms": _ms(v),
        "roll": e.roll,
        "pitch": e.pitch,
        "yaw": e.yaw,
        "rollspeed": e.p,
        "pitchspeed": e.q,
        "yawspeed": e.r,
    }


def attitude_quaternion(v: Vehicle) -> Values:
    """ATTITUDE_QUATERNION."""
    w, x, y, z = v.est.quaternion
    e = v.est
    return {
        "time_boot_ms": _ms(v),
        "q1": w,
        "q2": x,
        "q3": y,
        "q4": z,
        "rollspeed": e.p,
        "pitchspeed": e.q,
        "yawspeed": e.r,
    }


def attitude_target(v: Vehicle) -> Values:
    """ATTITUDE_TARGET."""
    roll, pitch = v.control.lean
    yaw = v.control.yaw_setpoint
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    q = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    return {"time_boot_ms": _ms(v), "type_mask": 0, "q": q, "thrust": v.control.thrust_share}


def vfr_hud(v: Vehicle) -> Values:
    """VFR_HUD; `alt` is above mean sea level."""
    e = v.est
    speed = math.hypot(e.vn, e.ve)
    return {
        "airspeed": speed,
        "groundspeed": speed,
        "heading": round(v.heading_cdeg / 100.0) % 360,
        "throttle": v.throttle_percent,
        "alt": v.place.alt_m,
        "climb": -e.vd,
    }


def sys_status(v: Vehicle) -> Values:
    """SYS_STATUS with the health bits that clients look at."""
    enabled = _SENSORS_PRESENT & ~(_SENSOR_FENCE | _MOTOR_OUTPUTS | _POSITION_CONTROLS)
    if v.armed:
        enabled |= _MOTOR_OUTPUTS
    if v.mode not in (Mode.STABILIZE, Mode.ALT_HOLD):
        enabled |= _POSITION_CONTROLS
    if v.fence.enabled:
        enabled |= _SENSOR_FENCE
    healthy = _SENSORS_PRESENT
    if v.gps.fix_type < 3:
        healthy &= ~_SENSOR_GPS
    if not v.position_ok:
        healthy &= ~_SENSOR_AHRS
    if v.failsafes.battery:
        healthy &= ~_SENSOR_BATTERY
    if v.fence.breaches:
        healthy &= ~_SENSOR_FENCE
    if v.arming_refusal() is not None:
        healthy &= ~_PREARM_CHECK
    return {
        "onboard_control_sensors_present": _SENSORS_PRESENT,
        "onboard_control_sensors_enabled": enabled,
        "onboard_control_sensors_health": healthy,
        "load": 250,
        "voltage_battery": round(v.battery.voltage_v * 1000.0),
        "current_battery": int(clamp(round(v.battery.current_a * 100.0), -1, 32767)),
        "battery_remaining": v.battery.percent,
        "drop_rate_comm": 0,
        "errors_comm": 0,
    }


def battery_status(v: Vehicle) -> Values:
    """BATTERY_STATUS of the one battery."""
    cells = (round(v.battery.voltage_v * 1000.0),) + (_U16,) * 9
    return {
        "id": 0,
        "battery_function": 0,
        "type": 0,
        "temperature": 32767,
        "voltages": cells,
        "current_battery": int(clamp(round(v.battery.current_a * 100.0), -1, 32767)),
        "current_consumed": round(v.battery.used_mah),
        "energy_consumed": round(v.battery.used_j / 100.0),
        "battery_remaining": v.battery.percent,
        "time_remaining": 0,
        "charge_state": 3 if v.failsafes.battery_critical else 2 if v.failsafes.battery else 1,
    }


def gps_raw_int(v: Vehicle) -> Values:
    """GPS_RAW_INT: the receiver's own fix, with its noise."""
    g = v.gps
    if g.fix_type < 2 or g.place is None:
        return {
            "time_usec": _us(v),
            "fix_type": g.fix_type,
            "eph": 9999,
            "epv": 9999,
            "satellites_visible": g.satellites,
        }
    return {
        "time_usec": _us(v),
        "fix_type": g.fix_type,
        "lat": g.place.lat_e7,
        "lon": g.place.lon_e7,
        "alt": round(g.place.alt_m * 1000.0),
        "eph": 121,
        "epv": 200,
        "vel": max(0, _cm(math.hypot(g.vn, g.ve))),
        "cog": round(math.degrees(math.atan2(g.ve, g.vn)) % 360.0 * 100.0) % 36000,
        "satellites_visible": g.satellites,
        "h_acc": 300,
        "v_acc": 300,
        "vel_acc": 40,
    }


def home_position(v: Vehicle) -> Values | None:
    """HOME_POSITION; None until home is known."""
    if v.home is None or v.origin is None:
        return None
    north, east, down = v.origin.vector_to(v.home)
    return {
        "latitude": v.home.lat_e7,
        "longitude": v.home.lon_e7,
        "altitude": round(v.home.alt_m * 1000.0),
        "x": north,
        "y": east,
        "z": down,
        "q": (1.0, 0.0, 0.0, 0.0),
        "time_usec": _us(v),
    }


def gps_global_origin(v: Vehicle) -> Values | None:
    """GPS_GLOBAL_ORIGIN: where the local frame begins."""
    if v.origin is None:
        return None
    return {
        "latitude": v.origin.lat_e7,
        "longitude": v.origin.lon_e7,
        "altitude": round(v.origin.alt_m * 1000.0),
        "time_usec": _us(v),
    }


def ekf_status_report(v: Vehicle) -> Values:
    """EKF_STATUS_REPORT."""
    return {
        "flags": v.ekf_flags,
        "velocity_variance": 0.02 if v.position_ok else 1.2,
        "pos_horiz_variance": 0.03 if v.position_ok else 1.5,
        "pos_vert_variance": 0.01,
        "compass_variance": 0.01,
    }


def extended_sys_state(v: Vehicle) -> Values:
    """EXTENDED_SYS_STATE."""
    return {"vtol_state": 0, "landed_state": int(v.landed_state)}


def autopilot_version(v: Vehicle) -> Values:
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


def mission_current(v: Vehicle) -> Values:
    """MISSION_CURRENT."""
    total = max(0, len(v.mission.items) - 1)
    return {
        "seq": v.mission.current,
        "total": total if total else _U16,
        "mission_state": v.mission_state(),
        "mission_mode": 1 if v.mode is Mode.AUTO else 2,
    }


def _imu(v: Vehicle) -> dict[str, Value]:
    w, x, y, z = v.body.quaternion
    fn, fe, fd = v.body.specific_force
    # World to body.
    bx = (1 - 2 * (y * y + z * z)) * fn + 2 * (x * y + w * z) * fe + 2 * (x * z - w * y) * fd
    by = 2 * (x * y - w * z) * fn + (1 - 2 * (x * x + z * z)) * fe + 2 * (y * z + w * x) * fd
    bz = 2 * (x * z + w * y) * fn + 2 * (y * z - w * x) * fe + (1 - 2 * (x * x + y * y)) * fd
    yaw = v.est.yaw
    return {
        "xacc": _milli(bx / GRAVITY),
        "yacc": _milli(by / GRAVITY),
        "zacc": _milli(bz / GRAVITY),
        "xgyro": _milli(v.body.p),
        "ygyro": _milli(v.body.q),
        "zgyro": _milli(v.body.r),
        "xmag": round(230 * math.cos(yaw)),
        "ymag": round(-230 * math.sin(yaw)),
        "zmag": 400,
        "temperature": 4500,
    }


def raw_imu(v: Vehicle) -> Values:
    """RAW_IMU."""
    return {"time_usec": _us(v), **_imu(v)}


def scaled_imu2(v: Vehicle) -> Values:
    """SCALED_IMU2."""
    return {"time_boot_ms": _ms(v), **_imu(v)}


def scaled_pressure(v: Vehicle) -> Values:
    """SCALED_PRESSURE from the standard atmosphere."""
    altitude = v.true_altitude_amsl_m
    return {
        "time_boot_ms": _ms(v),
        "press_abs": 1013.25 * (1.0 - 2.25577e-5 * altitude) ** 5.25588,
        "temperature": 3500,
    }


def power_status(_v: Vehicle) -> Values:
    """POWER_STATUS."""
    return {"Vcc": 5000, "Vservo": 0, "flags": 0}


def meminfo(_v: Vehicle) -> Values:
    """MEMINFO."""
    return {"brkval": 0, "freemem": _U16, "freemem32": 131072}


def nav_controller_output(v: Vehicle) -> Values:
    """NAV_CONTROLLER_OUTPUT."""
    c = v.control
    dn, de = c.target[0] - v.est.north, c.target[1] - v.est.east
    distance = math.hypot(dn, de) if c.horizontal is Axis.POSITION and not v.landed else 0.0
    bearing = round(math.degrees(math.atan2(de, dn))) if distance > 0.1 else 0
    return {
        "nav_roll": math.degrees(c.lean[0]),
        "nav_pitch": math.degrees(c.lean[1]),
        "nav_bearing": round(math.degrees(v.est.yaw)),
        "target_bearing": bearing,
        "wp_dist": int(min(distance, _U16)),
        "alt_error": (v.est.down - c.pos[2]) if not v.landed else 0.0,
    }


def fence_status(v: Vehicle) -> Values | None:
    """FENCE_STATUS, while a fence is enabled."""
    if not v.fence.enabled:
        return None
    return {
        "breach_status": 1 if v.fence.breaches else 0,
        "breach_count": v.fence.breach_count,
        "breach_type": v.fence.breach_type,
        "breach_time": int(v.fence.breach_time_s * 1000.0),
    }


def position_target_global_int(v: Vehicle) -> Values | None:
    """POSITION_TARGET_GLOBAL_INT while a guided or automatic flight has a target."""
    if v.origin is None or v.mode not in (Mode.GUIDED, Mode.AUTO, Mode.RTL) or v.landed:
        return None
    c = v.control
    place = v.origin.offset(c.target[0], c.target[1], c.target_down)
    moving = c.horizontal is Axis.VELOCITY
    return {
        "time_boot_ms": _ms(v),
        "coordinate_frame": 5,
        "type_mask": 0xDC7 if moving else 0xDF8,
        "lat_int": 0 if moving else place.lat_e7,
        "lon_int": 0 if moving else place.lon_e7,
        "alt": 0.0 if moving else place.alt_m,
        "vx": c.target_velocity[0],
        "vy": c.target_velocity[1],
        "vz": c.target_vd,
    }


def position_target_local_ned(v: Vehicle) -> Values | None:
    """POSITION_TARGET_LOCAL_NED while in GUIDED."""
    if v.origin is None or v.mode is not Mode.GUIDED or v.landed:
        return None
    c = v.control
    moving = c.horizontal is Axis.VELOCITY
    return {
        "time_boot_ms": _ms(v),
        "coordinate_frame": 1,
        "type_mask": 0xDC7 if moving else 0xDF8,
        "x": 0.0 if moving else c.target[0],
        "y": 0.0 if moving else c.target[1],
        "z": 0.0 if moving else c.target_down,
        "vx": c.target_velocity[0],
        "vy": c.target_velocity[1],
        "vz": c.target_vd,
    }


def servo_output_raw(v: Vehicle) -> Values:
    """SERVO_OUTPUT_RAW: motor 1 to 4."""
    full = v.body.airframe.full_thrust_n
    values: dict[str, Value] = {"time_usec": _us(v) & 0xFFFFFFFF, "port": 0}
    for at, thrust in enumerate(v.body.motors, start=1):
        values[f"servo{at}_raw"] = 1000 if not v.armed else round(1100 + 850 * math.sqrt(clamp(thrust / full, 0, 1)))
    return values


def rc_channels(v: Vehicle) -> Values:
    """RC_CHANNELS: the sticks."""
    values: dict[str, Value] = {"time_boot_ms": _ms(v), "chancount": 16, "rssi": 255}
    for at, pwm in enumerate(v.sticks, start=1):
        values[f"chan{at}_raw"] = pwm
    return values


def ahrs(_v: Vehicle) -> Values:
    """AHRS."""
    return {"error_rp": 0.002, "error_yaw": 0.002}


def ahrs2(v: Vehicle) -> Values:
    """AHRS2: the secondary estimate."""
    e = v.est
    place = v.place
    return {
        "roll": e.roll,
        "pitch": e.pitch,
        "yaw": e.yaw,
        "altitude": place.alt_m,
        "lat": place.lat_e7,
        "lng": place.lon_e7,
    }


def simstate(v: Vehicle) -> Values:
    """SIMSTATE: the truth behind the estimate."""
    roll, pitch, yaw = v.body.euler()
    fn, fe, fd = v.body.specific_force
    place = v.true_place
    return {
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw,
        "xacc": fn,
        "yacc": fe,
        "zacc": fd,
        "xgyro": v.body.p,
        "ygyro": v.body.q,
        "zgyro": v.body.r,
        "lat": place.lat_e7,
        "lng": place.lon_e7,
    }


def system_time(v: Vehicle) -> Values:
    """SYSTEM_TIME."""
    return {"time_unix_usec": v.unix_us, "time_boot_ms": _ms(v)}


def wind(v: Vehicle) -> Values:
    """WIND: direction it comes from, speed."""
    return {"direction": (v.wind.from_deg + 180.0) % 360.0 - 180.0, "speed": v.wind.speed_mps, "speed_z": 0.0}


def vibration(v: Vehicle) -> Values:
    """VIBRATION."""
    level = 3.0 * v.control.thrust_share if v.armed and not v.landed else 0.002
    return {"time_usec": _us(v), "vibration_x": level, "vibration_y": level, "vibration_z": 1.5 * level}


def terrain_report(v: Vehicle) -> Values:
    """TERRAIN_REPORT over flat ground at the start's altitude."""
    place = v.place
    return {
        "lat": place.lat_e7,
        "lon": place.lon_e7,
        "spacing": 100,
        "terrain_height": v.start.alt_m,
        "current_height": place.alt_m - v.start.alt_m,
        "loaded": 504,
    }


def esc_telemetry(v: Vehicle) -> Values:
    """ESC_TELEMETRY_1_TO_4."""
    full = v.body.airframe.full_thrust_n
    volts = round(v.battery.voltage_v * 100.0)
    amps = round(v.battery.current_a * 25.0)
    rpm = tuple(round(9000 * math.sqrt(clamp(thrust / full, 0, 1))) for thrust in v.body.motors)
    return {
        "temperature": (35, 35, 35, 35),
        "voltage": (volts,) * 4,
        "current": (min(amps, _U16),) * 4,
        "totalcurrent": (round(v.battery.used_mah / 4) & 0xFFFF,) * 4,
        "rpm": rpm,
        "count": (_ms(v) // 20 & 0xFFFF,) * 4,
    }


def altitude(v: Vehicle) -> Values:
    """ALTITUDE."""
    place = v.place
    home = v.home.alt_m if v.home is not None else v.start.alt_m
    relative = place.alt_m - home
    return {
        "time_usec": _us(v),
        "altitude_monotonic": place.alt_m,
        "altitude_amsl": place.alt_m,
        "altitude_local": -v.est.down,
        "altitude_relative": relative,
        "altitude_terrain": place.alt_m - v.start.alt_m,
        "bottom_clearance": place.alt_m - v.start.alt_m,
    }


BUILDERS: dict[str, Builder] = {
    "HEARTBEAT": heartbeat,
    "GLOBAL_POSITION_INT": global_position_int,
    "LOCAL_POSITION_NED": local_position_ned,
    "ATTITUDE": attitude,
    "ATTITUDE_QUATERNION": attitude_quaternion,
    "ATTITUDE_TARGET": attitude_target,
    "VFR_HUD": vfr_hud,
    "SYS_STATUS": sys_status,
    "BATTERY_STATUS": battery_status,
    "GPS_RAW_INT": gps_raw_int,
    "HOME_POSITION": home_position,
    "GPS_GLOBAL_ORIGIN": gps_global_origin,
    "EKF_STATUS_REPORT": ekf_status_report,
    "EXTENDED_SYS_STATE": extended_sys_state,
    "AUTOPILOT_VERSION": autopilot_version,
    "MISSION_CURRENT": mission_current,
    "RAW_IMU": raw_imu,
    "SCALED_IMU2": scaled_imu2,
    "SCALED_PRESSURE": scaled_pressure,
    "POWER_STATUS": power_status,
    "MEMINFO": meminfo,
    "NAV_CONTROLLER_OUTPUT": nav_controller_output,
    "FENCE_STATUS": fence_status,
    "POSITION_TARGET_GLOBAL_INT": position_target_global_int,
    "POSITION_TARGET_LOCAL_NED": position_target_local_ned,
    "SERVO_OUTPUT_RAW": servo_output_raw,
    "RC_CHANNELS": rc_channels,
    "AHRS": ahrs,
    "AHRS2": ahrs2,
    "SIMSTATE": simstate,
    "SYSTEM_TIME": system_time,
    "WIND": wind,
    "VIBRATION": vibration,
    "TERRAIN_REPORT": terrain_report,
    "ESC_TELEMETRY_1_TO_4": esc_telemetry,
    "ALTITUDE": altitude,
}

# MAV_DATA_STREAM groups as ArduCopter fills them; the second column names the SRn_ parameter.
GROUPS: dict[int, tuple[str, tuple[str, ...]]] = {
    1: ("RAW_SENS", ("RAW_IMU", "SCALED_IMU2", "SCALED_PRESSURE")),
    2: (
        "EXT_STAT",
        (
            "SYS_STATUS",
            "POWER_STATUS",
            "MEMINFO",
            "MISSION_CURRENT",
            "GPS_RAW_INT",
            "NAV_CONTROLLER_OUTPUT",
            "FENCE_STATUS",
            "POSITION_TARGET_GLOBAL_INT",
        ),
    ),
    3: ("RC_CHAN", ("SERVO_OUTPUT_RAW", "RC_CHANNELS")),
    4: ("RAW_CTRL", ()),
    6: ("POSITION", ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED")),
    10: ("EXTRA1", ("ATTITUDE", "SIMSTATE", "AHRS2")),
    11: ("EXTRA2", ("VFR_HUD",)),
    12: (
        "EXTRA3",
        (
            "AHRS",
            "SYSTEM_TIME",
            "WIND",
            "TERRAIN_REPORT",
            "BATTERY_STATUS",
            "EKF_STATUS_REPORT",
            "VIBRATION",
            "ESC_TELEMETRY_1_TO_4",
        ),
    ),
}
ALL_GROUPS = (1, 2, 3, 4, 6, 10, 11, 12)
