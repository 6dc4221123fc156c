"""What hangs on the autopilot besides the motors: a gimbal, servos, relays, switches of a radio, and the test of a motor."""

from __future__ import annotations

import math

from fractus_mavlink.enums import COPTER_MODE, GIMBAL_DEVICE_FLAGS, MAV_CMD, MAV_RESULT, MAV_SEVERITY

from fractus_vehicle.state import VehicleState

RELAYS, SERVOS = 6, 32
RELAY_FUNCTION = 1
# SERVOn_FUNCTION: free for commands; others belong to motors and such.
FREE_FUNCTIONS = frozenset({0, 1})
MAX_MOTOR_TEST_S = 600.0
# RCn_OPTION: switches that choose a mode when they are up.
SWITCHED_MODES = {
    4: COPTER_MODE.RTL,
    16: COPTER_MODE.AUTO,
    18: COPTER_MODE.LAND,
    33: COPTER_MODE.BRAKE,
    42: COPTER_MODE.SMART_RTL,
    52: COPTER_MODE.ACRO,
    55: COPTER_MODE.GUIDED,
    56: COPTER_MODE.LOITER,
    68: COPTER_MODE.STABILIZE,
    69: COPTER_MODE.POSHOLD,
    70: COPTER_MODE.ALT_HOLD,
    72: COPTER_MODE.CIRCLE,
    73: COPTER_MODE.DRIFT,
}
SWITCH_LOW, SWITCH_HIGH = 0, 2
FENCE_SWITCH = 11
# Refused without a camera, a mount, a gripper, a winch, a radio or a calibration under way.
ABSENT = (
    MAV_CMD.DO_GRIPPER,
    MAV_CMD.DO_MOUNT_CONFIGURE,
    MAV_CMD.DO_MOUNT_CONTROL,
    MAV_CMD.DO_GIMBAL_MANAGER_CONFIGURE,
    MAV_CMD.IMAGE_START_CAPTURE,
    MAV_CMD.IMAGE_STOP_CAPTURE,
    MAV_CMD.VIDEO_START_CAPTURE,
    MAV_CMD.VIDEO_STOP_CAPTURE,
    MAV_CMD.SET_CAMERA_ZOOM,
    MAV_CMD.SET_CAMERA_FOCUS,
    MAV_CMD.DO_ADSB_OUT_IDENT,
    MAV_CMD.DO_SET_ROI_SYSID,
    MAV_CMD.DO_WINCH,
    MAV_CMD.ACCELCAL_VEHICLE_POS,
    MAV_CMD.START_RX_PAIR,
)
# Accepted without an effect here.
TAKEN = (
    MAV_CMD.DO_DIGICAM_CONFIGURE,
    MAV_CMD.DO_DIGICAM_CONTROL,
    MAV_CMD.DO_SET_CAM_TRIGG_DIST,
    MAV_CMD.DO_SPRAYER,
    MAV_CMD.AIRFRAME_CONFIGURATION,
    MAV_CMD.FIXED_MAG_CAL_YAW,
)


def point_gimbal(v: VehicleState, pitch_deg: float, yaw_deg: float, flags: int) -> MAV_RESULT:
    """DO_GIMBAL_MANAGER_PITCHYAW with angles; rates and the yaw that is locked to north are not simulated."""
    if not v.gimbal.kind or flags & GIMBAL_DEVICE_FLAGS.YAW_LOCK:
        return MAV_RESULT.FAILED
    if not (math.isfinite(pitch_deg) and math.isfinite(yaw_deg)):
        return MAV_RESULT.FAILED
    v.gimbal.point(pitch_deg, yaw_deg)
    return MAV_RESULT.ACCEPTED


def set_servo(v: VehicleState, channel: float, pwm_us: float) -> MAV_RESULT:
    """DO_SET_SERVO and DO_REPEAT_SERVO: one of the outputs that no motor has."""
    if not (math.isfinite(channel) and math.isfinite(pwm_us)) or not 1 <= int(channel) <= SERVOS:
        return MAV_RESULT.FAILED
    number = int(channel)
    if int(v.params.get(f"SERVO{number}_FUNCTION", 0.0)) not in FREE_FUNCTIONS:
        v.say(MAV_SEVERITY.INFO, f"ServoRelayEvent: Channel {number} is already in use")
        return MAV_RESULT.FAILED
    v.servos[number] = int(pwm_us) & 0xFFFF
    return MAV_RESULT.ACCEPTED


def set_relay(v: VehicleState, number: float) -> MAV_RESULT:
    """DO_SET_RELAY and DO_REPEAT_RELAY: relays that RELAYn_FUNCTION enables."""
    if not math.isfinite(number) or not 0 <= int(number) < RELAYS:
        return MAV_RESULT.FAILED
    enabled = int(v.params[f"RELAY{int(number) + 1}_FUNCTION"]) == RELAY_FUNCTION
    return MAV_RESULT.ACCEPTED if enabled else MAV_RESULT.FAILED


def reset_battery(v: VehicleState, batteries: float, percent: float) -> MAV_RESULT:
    """BATTERY_RESET: sets the share of charge that is left, in percent, of the batteries in the mask."""
    if not (math.isfinite(batteries) and math.isfinite(percent)):
        return MAV_RESULT.FAILED
    if int(batteries) & 1:
        v.battery.used_mah = v.battery.capacity_mah * (1.0 - min(max(percent, 0.0), 100.0) / 100.0)
    return MAV_RESULT.ACCEPTED


def start_motor_test(v: VehicleState, motor: float, duration_s: float) -> MAV_RESULT:
    """DO_MOTOR_TEST: on the ground, one motor for a time; the vehicle counts as armed meanwhile, whatever its checks say."""
    if not v.landed:
        v.say(MAV_SEVERITY.CRITICAL, "Motor Test: vehicle not landed")
        return MAV_RESULT.FAILED
    running = v.motor_test_until_s is not None
    if not (math.isfinite(motor) and math.isfinite(duration_s)) or (v.armed and not running):
        return MAV_RESULT.FAILED
    if not running:
        v.say(MAV_SEVERITY.INFO, "starting motor test")
    v.motor_test_until_s = v.time_s + min(max(duration_s, 0.0), MAX_MOTOR_TEST_S)
    return MAV_RESULT.ACCEPTED


def end_motor_test(v: VehicleState) -> None:
    """Stop the motor when its time is over."""
    if v.motor_test_until_s is not None and v.time_s >= v.motor_test_until_s:
        v.motor_test_until_s = None
        v.say(MAV_SEVERITY.INFO, "finished motor test")
