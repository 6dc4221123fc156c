"""Devices besides the motors: gimbal, servos, relays, RC switches and the motor test."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.state import CONTROL_STEP_S, VehicleState

RELAYS = 6
SERVOS = 32
RELAY_FUNCTION = 1
# SERVOn_FUNCTION values of outputs that commands may set. Other values assign the output to a motor or another device.
FREE_FUNCTIONS = frozenset({0, 1})
MAX_MOTOR_TEST_S = 600.0
# Radius of the depot, the area around the start position in which the battery charges.
DEPOT_RADIUS_M = 20.0
# RCn_OPTION values of switches that select a flight mode in the high position.
SWITCHED_MODES = {
    4: mavlink.COPTER_MODE_RTL,
    16: mavlink.COPTER_MODE_AUTO,
    18: mavlink.COPTER_MODE_LAND,
    33: mavlink.COPTER_MODE_BRAKE,
    42: mavlink.COPTER_MODE_SMART_RTL,
    52: mavlink.COPTER_MODE_ACRO,
    55: mavlink.COPTER_MODE_GUIDED,
    56: mavlink.COPTER_MODE_LOITER,
    68: mavlink.COPTER_MODE_STABILIZE,
    69: mavlink.COPTER_MODE_POSHOLD,
    70: mavlink.COPTER_MODE_ALT_HOLD,
    72: mavlink.COPTER_MODE_CIRCLE,
    73: mavlink.COPTER_MODE_DRIFT,
}
SWITCH_LOW = 0
SWITCH_HIGH = 2
FENCE_SWITCH = 11
# Commands that fail, because the simulated vehicle lacks their device or function: camera, mount, gripper, winch,
# receiver pairing and accelerometer calibration.
ABSENT_DEVICE = (
    mavlink.MAV_CMD_DO_GRIPPER,
    mavlink.MAV_CMD_DO_MOUNT_CONFIGURE,
    mavlink.MAV_CMD_DO_MOUNT_CONTROL,
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
    mavlink.MAV_CMD_IMAGE_START_CAPTURE,
    mavlink.MAV_CMD_IMAGE_STOP_CAPTURE,
    mavlink.MAV_CMD_VIDEO_START_CAPTURE,
    mavlink.MAV_CMD_VIDEO_STOP_CAPTURE,
    mavlink.MAV_CMD_SET_CAMERA_ZOOM,
    mavlink.MAV_CMD_SET_CAMERA_FOCUS,
    mavlink.MAV_CMD_DO_ADSB_OUT_IDENT,
    mavlink.MAV_CMD_DO_SET_ROI_SYSID,
    mavlink.MAV_CMD_DO_WINCH,
    mavlink.MAV_CMD_ACCELCAL_VEHICLE_POS,
    mavlink.MAV_CMD_START_RX_PAIR,
)
# Commands that are accepted and have no effect.
WITHOUT_EFFECT = (
    mavlink.MAV_CMD_DO_DIGICAM_CONFIGURE,
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL,
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST,
    mavlink.MAV_CMD_DO_SPRAYER,
    mavlink.MAV_CMD_AIRFRAME_CONFIGURATION,
    mavlink.MAV_CMD_FIXED_MAG_CAL_YAW,
)


def point_gimbal(v: VehicleState, pitch_deg: float, yaw_deg: float, flags: int) -> int:
    """Handle DO_GIMBAL_MANAGER_PITCHYAW with angles. Rates and a yaw locked to north are not simulated."""
    if not v.gimbal.kind or flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK:
        return mavlink.MAV_RESULT_FAILED
    if not (math.isfinite(pitch_deg) and math.isfinite(yaw_deg)):
        return mavlink.MAV_RESULT_FAILED
    v.gimbal.point(pitch_deg, yaw_deg)
    return mavlink.MAV_RESULT_ACCEPTED


def set_servo(v: VehicleState, channel: float, pwm_us: float) -> int:
    """Handle DO_SET_SERVO and DO_REPEAT_SERVO for an output that is not assigned to a motor."""
    if not (math.isfinite(channel) and math.isfinite(pwm_us)) or not 1 <= int(channel) <= SERVOS:
        return mavlink.MAV_RESULT_FAILED
    number = int(channel)
    if int(v.params.get(f"SERVO{number}_FUNCTION", 0.0)) not in FREE_FUNCTIONS:
        v.send_text(mavlink.MAV_SEVERITY_INFO, f"ServoRelayEvent: Channel {number} is already in use")
        return mavlink.MAV_RESULT_FAILED
    v.servos[number] = int(pwm_us) & 0xFFFF
    return mavlink.MAV_RESULT_ACCEPTED


def relays_present(v: VehicleState) -> set[int]:
    """Return the numbers of the relays enabled by RELAYn_FUNCTION, from 0."""
    return {number for number in range(RELAYS) if int(v.params[f"RELAY{number + 1}_FUNCTION"]) == RELAY_FUNCTION}


def set_relay(v: VehicleState, number: float, state: float) -> int:
    """Handle DO_SET_RELAY for an enabled relay: 1 switches it on, 0 off."""
    if not (math.isfinite(number) and math.isfinite(state)) or int(number) not in relays_present(v):
        return mavlink.MAV_RESULT_FAILED
    if int(state) == 1:
        v.relays_on.add(int(number))
    elif int(state) == 0:
        v.relays_on.discard(int(number))
    return mavlink.MAV_RESULT_ACCEPTED


def repeat_relay(v: VehicleState, number: float) -> int:
    """Handle DO_REPEAT_RELAY for an enabled relay. The pulses are not simulated."""
    enabled = math.isfinite(number) and int(number) in relays_present(v)
    return mavlink.MAV_RESULT_ACCEPTED if enabled else mavlink.MAV_RESULT_FAILED


def reset_battery(v: VehicleState, batteries: float, percent: float) -> int:
    """Handle BATTERY_RESET: set the remaining charge, in percent, of the batteries in the mask."""
    if not (math.isfinite(batteries) and math.isfinite(percent)):
        return mavlink.MAV_RESULT_FAILED
    if int(batteries) & 1:
        v.battery.used_mah = v.battery.capacity_mah * (1.0 - min(max(percent, 0.0), 100.0) / 100.0)
        _end_battery_failsafe(v)
    return mavlink.MAV_RESULT_ACCEPTED


def charge_at_depot(v: VehicleState) -> None:
    """Charge the battery for one control step if the disarmed vehicle stands on the ground at its depot."""
    if v.config.charge_percent_per_min <= 0.0 or v.battery.used_mah <= 0.0 or not v.body.on_ground:
        return
    north_m, east_m, _ = (v.config.depot or v.config.start).vector_to(v.true_place)
    if math.hypot(north_m, east_m) > DEPOT_RADIUS_M:
        return
    charged_mah = v.battery.capacity_mah * v.config.charge_percent_per_min / 100.0 * CONTROL_STEP_S / 60.0
    v.battery.used_mah = max(v.battery.used_mah - charged_mah, 0.0)
    if v.failsafes.battery:
        _end_battery_failsafe(v)


def _end_battery_failsafe(v: VehicleState) -> None:
    """End the battery failsafe if charge and voltage are above its limits, like ArduCopter after BATTERY_RESET."""
    battery = v.battery
    battery.step(0.0, 0.0)  # updates the voltage
    p = v.params
    left_mah = battery.capacity_mah - battery.used_mah
    low = 0.0 < battery.voltage_v < max(p["BATT_LOW_VOLT"], p["BATT_CRT_VOLT"])
    if not low and left_mah >= max(p["BATT_LOW_MAH"], p["BATT_CRT_MAH"]):
        v.failsafes.battery = v.failsafes.battery_critical = False


def start_motor_test(v: VehicleState, motor: float, duration_s: float) -> int:
    """Handle DO_MOTOR_TEST: run one motor for `duration_s` seconds on the ground.

    During the test, the vehicle reports that it is armed. The arming checks are not run.
    """
    if not v.landed:
        v.send_text(mavlink.MAV_SEVERITY_CRITICAL, "Motor Test: vehicle not landed")
        return mavlink.MAV_RESULT_FAILED
    running = v.motor_test_until_s is not None
    if not (math.isfinite(motor) and math.isfinite(duration_s)) or (v.armed and not running):
        return mavlink.MAV_RESULT_FAILED
    if not running:
        v.send_text(mavlink.MAV_SEVERITY_INFO, "starting motor test")
    v.motor_test_until_s = v.time_s + min(max(duration_s, 0.0), MAX_MOTOR_TEST_S)
    return mavlink.MAV_RESULT_ACCEPTED


def end_motor_test(v: VehicleState) -> None:
    """Stop the motor test after its duration."""
    if v.motor_test_until_s is not None and v.time_s >= v.motor_test_until_s:
        v.motor_test_until_s = None
        v.send_text(mavlink.MAV_SEVERITY_INFO, "finished motor test")
