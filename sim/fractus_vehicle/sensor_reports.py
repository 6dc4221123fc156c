"""Telemetry of sensors and actuators."""

from __future__ import annotations

import math

from fractus_runtime.mavlink_codec import Value
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle import noise
from fractus_vehicle.body import GRAVITY
from fractus_vehicle.report_units import UNKNOWN_U16, Values, boot_ms, boot_us, centi, milli
from fractus_vehicle.sensors import GPS_HDOP, Gps
from fractus_vehicle.shaping import clamp
from fractus_vehicle.state import VehicleState

_BARO_AXIS = 16
SERVOS_REPORTED = 16


def gps_raw_int(v: VehicleState) -> Values:
    """Build GPS_RAW_INT from the noisy fix of the first receiver."""
    return _gps_values(v, v.gps)


def gps2_raw(v: VehicleState) -> Values | None:
    """Build GPS2_RAW from the noisy fix of the second receiver, if there is one."""
    receivers = v.estimator.gps_receivers
    return _gps_values(v, receivers.receivers[1]) if receivers.has_second else None


def _gps_values(v: VehicleState, g: Gps) -> Values:
    if g.fix_type < mavlink.GPS_FIX_TYPE_2D_FIX or g.place is None:
        return {
            "time_usec": boot_us(v),
            "fix_type": g.fix_type,
            "eph": 9999,
            "epv": 9999,
            "satellites_visible": g.satellites,
        }
    return {
        "time_usec": round(g.fix_s * 1e6),
        "fix_type": g.fix_type,
        "lat": g.place.lat_e7,
        "lon": g.place.lon_e7,
        "alt": round(g.place.alt_m * 1000.0),
        "eph": GPS_HDOP,
        "epv": 200,
        "vel": max(0, centi(math.hypot(g.vn, g.ve))),
        "cog": round(math.degrees(math.atan2(g.ve, g.vn)) % 360.0 * 100.0) % 36000,
        "satellites_visible": g.satellites,
        "h_acc": round(g.accuracy_m * 1000.0),
        "v_acc": 300,
    }


def _imu(v: VehicleState) -> dict[str, Value]:
    w, x, y, z = v.body.quaternion
    fn, fe, fd = v.body.specific_force
    # Rotate from world to body axes.
    bx = (1 - 2 * (y * y + z * z)) * fn + 2 * (x * y + w * z) * fe + 2 * (x * z - w * y) * fd
    by = 2 * (x * y - w * z) * fn + (1 - 2 * (x * x + z * z)) * fe + 2 * (y * z + w * x) * fd
    bz = 2 * (x * z + w * y) * fn + 2 * (y * z - w * x) * fe + (1 - 2 * (x * x + y * y)) * fd
    yaw = v.est.yaw
    throttle = v.control.thrust_share if v.armed else 0.0
    shake = noise.ACCEL_MPS2 + throttle * (noise.ACCEL_THROTTLE_MPS2 + max(v.params["SIM_ACC1_RND"], 0.0))
    turn = noise.GYRO_RPS + throttle * (noise.GYRO_THROTTLE_RPS + math.radians(max(v.params["SIM_GYR1_RND"], 0.0)))
    bias = [v.params[f"SIM_ACC1_BIAS_{axis}"] for axis in "XYZ"]
    draw = [noise.gaussian(v.noise_seed, v.ticks, axis) for axis in range(9)]
    return {
        "xacc": milli((bx + bias[0] + shake * draw[0]) / GRAVITY),
        "yacc": milli((by + bias[1] + shake * draw[1]) / GRAVITY),
        "zacc": milli((bz + bias[2] + shake * draw[2]) / GRAVITY),
        "xgyro": milli(v.body.p + turn * draw[3]),
        "ygyro": milli(v.body.q + turn * draw[4]),
        "zgyro": milli(v.body.r + turn * draw[5]),
        "xmag": round(230 * math.cos(yaw) + noise.MAG_MGAUSS * draw[6]),
        "ymag": round(-230 * math.sin(yaw) + noise.MAG_MGAUSS * draw[7]),
        "zmag": round(400 + noise.MAG_MGAUSS * draw[8]),
        "temperature": 4500,
    }


def raw_imu(v: VehicleState) -> Values:
    """Build RAW_IMU."""
    return {"time_usec": boot_us(v), **_imu(v)}


def scaled_imu2(v: VehicleState) -> Values:
    """Build SCALED_IMU2."""
    return {"time_boot_ms": boot_ms(v), **_imu(v)}


def scaled_imu3(v: VehicleState) -> Values:
    """Build SCALED_IMU3. The third unit has only a compass."""
    whole = _imu(v)
    return {"time_boot_ms": boot_ms(v), **{name: whole[name] for name in ("xmag", "ymag", "zmag")}}


def scaled_pressure(v: VehicleState) -> Values:
    """Build SCALED_PRESSURE from the standard atmosphere."""
    altitude = v.true_altitude_amsl_m + v.estimator.altitude.barometer_error_m
    altitude += max(v.params["SIM_BARO_RND"], 0.0) * noise.gaussian(v.noise_seed, v.ticks, _BARO_AXIS)
    return {
        "time_boot_ms": boot_ms(v),
        "press_abs": 1013.25 * (1.0 - 2.25577e-5 * altitude) ** 5.25588,
        "temperature": 3500,
    }


def servo_output_raw(v: VehicleState) -> Values:
    """Build SERVO_OUTPUT_RAW with motors 1 to 4 and set servos."""
    full = v.body.airframe.full_thrust_n
    values: dict[str, Value] = {"time_usec": boot_us(v) & 0xFFFFFFFF, "port": 0}
    values |= {f"servo{number}_raw": pwm for number, pwm in v.servos.items() if number <= SERVOS_REPORTED}
    for at, thrust in enumerate(v.body.motors, start=1):
        values[f"servo{at}_raw"] = 1000 if not v.armed else round(1100 + 850 * math.sqrt(clamp(thrust / full, 0, 1)))
    return values


def rc_channels(v: VehicleState) -> Values:
    """Build RC_CHANNELS."""
    values: dict[str, Value] = {"time_boot_ms": boot_ms(v), "chancount": 16, "rssi": 255}
    for at, pwm in enumerate(v.sticks, start=1):
        values[f"chan{at}_raw"] = pwm
    return values


def ahrs(_v: VehicleState) -> Values:
    """Build AHRS."""
    return {"error_rp": 0.002, "error_yaw": 0.002}


def wind(v: VehicleState) -> Values | None:
    """Build WIND: direction of origin and speed. The EKF estimates it only with a position."""
    if not v.position_ok:
        return None
    return {"direction": (v.wind.from_deg + 180.0) % 360.0 - 180.0, "speed": v.wind.speed_mps, "speed_z": 0.0}


def vibration(v: VehicleState) -> Values:
    """Build VIBRATION."""
    level = 3.0 * v.control.thrust_share if v.armed and not v.landed else 0.002
    return {"time_usec": boot_us(v), "vibration_x": level, "vibration_y": level, "vibration_z": 1.5 * level}


def esc_telemetry(v: VehicleState) -> Values:
    """Build ESC_TELEMETRY_1_TO_4."""
    full = v.body.airframe.full_thrust_n
    volts = round(v.battery.voltage_v * 100.0)
    amps = round(v.battery.current_a * 25.0)
    rpm = tuple(round(9000 * math.sqrt(clamp(thrust / full, 0, 1))) for thrust in v.body.motors)
    return {
        "temperature": (35, 35, 35, 35),
        "voltage": (volts,) * 4,
        "current": (min(amps, UNKNOWN_U16),) * 4,
        "totalcurrent": (round(v.battery.used_mah / 4) & 0xFFFF,) * 4,
        "rpm": rpm,
        "count": (boot_ms(v) // 20 & 0xFFFF,) * 4,
    }


def battery_status(v: VehicleState) -> Values:
    """Build BATTERY_STATUS."""
    cells = (round(v.battery.voltage_v * 1000.0),) + (UNKNOWN_U16,) * 9
    return {
        "id": 0,
        "battery_function": mavlink.MAV_BATTERY_FUNCTION_UNKNOWN,
        "type": mavlink.MAV_BATTERY_TYPE_UNKNOWN,
        "temperature": 32767,
        "voltages": cells,
        "current_battery": int(clamp(round(v.battery.current_a * 100.0), -1, 32767)),
        "current_consumed": round(v.battery.used_mah),
        "energy_consumed": round(v.battery.used_j / 100.0),
        "battery_remaining": v.battery.percent,
        "time_remaining": 0,
        "charge_state": _charge_state(v),
    }


def _charge_state(v: VehicleState) -> int:
    if v.failsafes.battery_critical:
        return mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL
    return mavlink.MAV_BATTERY_CHARGE_STATE_LOW if v.failsafes.battery else mavlink.MAV_BATTERY_CHARGE_STATE_OK


def ekf_status_report(v: VehicleState) -> Values:
    """Build EKF_STATUS_REPORT."""
    return {
        "flags": v.estimator.flags,
        "velocity_variance": 0.02 if v.position_ok else 1.2,
        "pos_horiz_variance": 0.03 if v.position_ok else 1.5,
        "pos_vert_variance": v.estimator.altitude.variance,
        "compass_variance": v.estimator.sensors.compass_variance,
    }
