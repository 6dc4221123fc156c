"""Telemetry of motion: positions, attitudes and their targets."""

from __future__ import annotations

import math

from fractus_runtime.mavlink_codec import Value
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.control import Axis
from fractus_vehicle.copter import GLOBAL_TARGET_ONLY, POSITION_ONLY, VELOCITY_ONLY
from fractus_vehicle.earth import Place
from fractus_vehicle.gimbal import PITCH_DEG, ROLL_DEG, YAW_DEG
from fractus_vehicle.report_units import UNKNOWN_U16, Values, boot_ms, boot_us, centi
from fractus_vehicle.state import VehicleState

ENDS = ("min", "max")
_AUTOMATIC = frozenset(
    {mavlink.COPTER_MODE_GUIDED, mavlink.COPTER_MODE_AUTO, mavlink.COPTER_MODE_RTL, mavlink.COPTER_MODE_SMART_RTL}
)


def global_position_int(v: VehicleState) -> Values:
    """Build GLOBAL_POSITION_INT. Its position is zero until the estimator has a position."""
    e = v.est
    if v.origin is None:
        return {"time_boot_ms": boot_ms(v), "hdg": v.heading_cdeg}
    place = v.place
    relative = place.alt_m - (v.home.alt_m if v.home is not None else v.origin.alt_m)
    return {
        "time_boot_ms": boot_ms(v),
        "lat": place.lat_e7,
        "lon": place.lon_e7,
        "alt": round(place.alt_m * 1000.0),
        "relative_alt": round(relative * 1000.0),
        "vx": centi(e.vn),
        "vy": centi(e.ve),
        "vz": centi(e.vd),
        "hdg": v.heading_cdeg,
    }


def local_position_ned(v: VehicleState) -> Values | None:
    """Build LOCAL_POSITION_NED, relative to the estimator's origin."""
    if v.origin is None:
        return None
    e = v.est
    return {"time_boot_ms": boot_ms(v), "x": e.north, "y": e.east, "z": e.down, "vx": e.vn, "vy": e.ve, "vz": e.vd}


def _rates(v: VehicleState) -> dict[str, Value]:
    return {"rollspeed": v.est.p, "pitchspeed": v.est.q, "yawspeed": v.est.r}


def attitude(v: VehicleState) -> Values:
    """Build ATTITUDE."""
    e = v.est
    return {"time_boot_ms": boot_ms(v), "roll": e.roll, "pitch": e.pitch, "yaw": e.yaw, **_rates(v)}


def attitude_quaternion(v: VehicleState) -> Values:
    """Build ATTITUDE_QUATERNION."""
    w, x, y, z = v.est.quaternion
    return {"time_boot_ms": boot_ms(v), "q1": w, "q2": x, "q3": y, "q4": z, **_rates(v)}


def attitude_target(v: VehicleState) -> Values:
    """Build ATTITUDE_TARGET."""
    roll, pitch = v.control.lean
    yaw = v.control.yaw_setpoint
    cr = math.cos(roll / 2)
    sr = math.sin(roll / 2)
    cp = math.cos(pitch / 2)
    sp = math.sin(pitch / 2)
    cy = math.cos(yaw / 2)
    sy = math.sin(yaw / 2)
    q = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    return {"time_boot_ms": boot_ms(v), "q": q, "thrust": v.control.thrust_share}


def gimbal_device_attitude_status(v: VehicleState) -> Values | None:
    """Build GIMBAL_DEVICE_ATTITUDE_STATUS, relative to horizon and nose, if there is a gimbal."""
    if not v.gimbal.kind:
        return None
    flags = (
        mavlink.GIMBAL_DEVICE_FLAGS_ROLL_LOCK
        | mavlink.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
        | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    )
    unknown = {f"angular_velocity_{axis}": math.nan for axis in "xyz"}
    return {
        "time_boot_ms": boot_ms(v),
        "flags": int(flags),
        "q": v.gimbal.reported_quaternion,
        "gimbal_device_id": 1,
        **unknown,
    }


def gimbal_manager_information(v: VehicleState) -> Values | None:
    """Build GIMBAL_MANAGER_INFORMATION with the angle limits, if there is a gimbal."""
    if not v.gimbal.kind:
        return None
    ranges = {"roll": ROLL_DEG, "pitch": PITCH_DEG, "yaw": YAW_DEG}
    ends = {
        f"{axis}_{end}": math.radians(deg) for axis, pair in ranges.items() for end, deg in zip(ENDS, pair, strict=True)
    }
    return {"time_boot_ms": boot_ms(v), "gimbal_device_id": 1, **ends}


def vfr_hud(v: VehicleState) -> Values:
    """Build VFR_HUD. `alt` is above mean sea level."""
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


def nav_controller_output(v: VehicleState) -> Values:
    """Build NAV_CONTROLLER_OUTPUT."""
    c = v.control
    dn = c.target[0] - v.est.north
    de = c.target[1] - v.est.east
    distance = math.hypot(dn, de) if c.horizontal is Axis.POSITION and not v.landed else 0.0
    bearing = round(math.degrees(math.atan2(de, dn))) if distance > 0.1 else 0
    return {
        "nav_roll": math.degrees(c.lean[0]),
        "nav_pitch": math.degrees(c.lean[1]),
        "nav_bearing": round(math.degrees(v.est.yaw)),
        "target_bearing": bearing,
        "wp_dist": int(min(distance, UNKNOWN_U16)),
        "alt_error": (v.est.down - c.pos[2]) if not v.landed else 0.0,
    }


def position_target_global_int(v: VehicleState) -> Values | None:
    """Build POSITION_TARGET_GLOBAL_INT if a guided or automatic flight has a position target."""
    if v.origin is None or v.mode not in _AUTOMATIC or v.landed or v.control.horizontal is Axis.VELOCITY:
        return None
    place = v.origin.offset(*v.control.target, v.control.target_down)
    return {
        "time_boot_ms": boot_ms(v),
        "coordinate_frame": mavlink.MAV_FRAME_GLOBAL,
        "type_mask": GLOBAL_TARGET_ONLY,
        "lat_int": place.lat_e7,
        "lon_int": place.lon_e7,
        "alt": place.alt_m,
    }


def position_target_local_ned(v: VehicleState) -> Values | None:
    """Build POSITION_TARGET_LOCAL_NED in GUIDED mode, with a position or a velocity."""
    if v.origin is None or v.mode != mavlink.COPTER_MODE_GUIDED or v.landed:
        return None
    c = v.control
    values: dict[str, Value] = {"time_boot_ms": boot_ms(v), "coordinate_frame": mavlink.MAV_FRAME_LOCAL_NED}
    if c.horizontal is Axis.VELOCITY:
        north, east = c.target_velocity
        return values | {"type_mask": VELOCITY_ONLY, "vx": north, "vy": east, "vz": c.target_vd}
    return values | {"type_mask": POSITION_ONLY, "x": c.target[0], "y": c.target[1], "z": c.target_down}


def home_position(v: VehicleState) -> Values | None:
    """Build HOME_POSITION if home is known."""
    if v.home is None or v.origin is None:
        return None
    north, east, down = v.origin.vector_to(v.home)
    return {
        **_degrees(v.home),
        "x": north,
        "y": east,
        "z": down,
        "q": (1.0, 0.0, 0.0, 0.0),
        "time_usec": boot_us(v),
    }


def gps_global_origin(v: VehicleState) -> Values | None:
    """Build GPS_GLOBAL_ORIGIN, the origin of the local frame."""
    if v.origin is None:
        return None
    return {**_degrees(v.origin), "time_usec": boot_us(v)}


def _degrees(place: Place) -> dict[str, Value]:
    return {"latitude": place.lat_e7, "longitude": place.lon_e7, "altitude": round(place.alt_m * 1000.0)}


def altitude(v: VehicleState) -> Values:
    """Build ALTITUDE."""
    place = v.place
    home = v.home.alt_m if v.home is not None else v.start.alt_m
    relative = place.alt_m - home
    return {
        "time_usec": boot_us(v),
        "altitude_monotonic": place.alt_m,
        "altitude_amsl": place.alt_m,
        "altitude_local": -v.est.down,
        "altitude_relative": relative,
        "altitude_terrain": place.alt_m - v.start.alt_m if int(v.params["TERRAIN_ENABLE"]) else math.nan,
        "bottom_clearance": math.nan,
    }


def terrain_report(v: VehicleState) -> Values | None:
    """Build TERRAIN_REPORT if TERRAIN_ENABLE is set. The ground is flat at the altitude of the start."""
    if not int(v.params["TERRAIN_ENABLE"]):
        return None
    place = v.place
    return {
        "lat": place.lat_e7,
        "lon": place.lon_e7,
        "spacing": 100,
        "terrain_height": v.start.alt_m,
        "current_height": place.alt_m - v.start.alt_m,
        "loaded": 504,
    }


def ahrs2(v: VehicleState) -> Values:
    """Build AHRS2, the secondary estimate."""
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


def simstate(v: VehicleState) -> Values:
    """Build SIMSTATE, the true state."""
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


def sim_state(v: VehicleState) -> Values:
    """Build SIM_STATE, the true state with velocity and altitude."""
    w, x, y, z = v.body.quaternion
    place = v.true_place
    degrees = {"lat": place.lat_e7 * 1e-7, "lon": place.lon_e7 * 1e-7, "lat_int": place.lat_e7, "lon_int": place.lon_e7}
    truth = {name: value for name, value in simstate(v).items() if name not in ("lat", "lng")}
    speed = {"vn": v.body.vn, "ve": v.body.ve, "vd": v.body.vd}
    return truth | {"q1": w, "q2": x, "q3": y, "q4": z, "alt": place.alt_m} | degrees | speed


def high_latency2(v: VehicleState) -> Values:
    """Build HIGH_LATENCY2."""
    place = v.place
    speed = math.hypot(v.est.vn, v.est.ve)
    return {
        "timestamp": boot_ms(v),
        "type": mavlink.MAV_TYPE_QUADROTOR,
        "autopilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        "custom_mode": int(v.mode),
        "latitude": place.lat_e7,
        "longitude": place.lon_e7,
        "altitude": round(place.alt_m),
        "target_altitude": round(place.alt_m),
        "heading": v.heading_cdeg // 200,
        "throttle": v.throttle_percent,
        "groundspeed": round(speed * 5.0),
        "climb_rate": round(-v.est.vd * 10.0),
        "battery": v.battery.percent,
        "wp_num": v.mission.current,
    }
