"""Faults injected in flight, compared with the mode and STATUSTEXTs of a real ArduCopter."""

from __future__ import annotations

import math

import pytest
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.state import VehicleState
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import START, airborne, alone, distance_m, upload

HOME = {"command": 16, "frame": 0, "x": START.lat_e7, "y": START.lon_e7, "z": 150.0}


def _in_order(texts: list[str], *prefixes: str) -> bool:
    """Return True if the texts were sent in this order, possibly with others in between."""
    rest = iter(texts)
    return all(any(text.startswith(prefix) for text in rest) for prefix in prefixes)


def _waypoint(north_m: float, altitude_m: float = 10.0) -> dict[str, float]:
    place = START.offset(north_m, 0.0)
    return {"command": 16, "frame": 3, "x": place.lat_e7, "y": place.lon_e7, "z": altitude_m}


def _in_mission(**parameters: float) -> tuple[VehicleState, Pilot]:
    vehicle, pilot = airborne(10.0, **parameters)
    assert upload(pilot, 0, [HOME, _waypoint(150.0), _waypoint(0.0)]) == 0
    assert pilot.mode(mavlink.COPTER_MODE_AUTO) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(3.0)
    return vehicle, pilot


@pytest.mark.parametrize(
    "mode", [mavlink.COPTER_MODE_GUIDED, mavlink.COPTER_MODE_LOITER, mavlink.COPTER_MODE_RTL, mavlink.COPTER_MODE_AUTO]
)
def test_gps_loss_lands_vehicle_after_pause(mode: int):
    vehicle, pilot = _in_mission() if mode == mavlink.COPTER_MODE_AUTO else airborne(15.0)
    if mode != mavlink.COPTER_MODE_AUTO:
        pilot.mode(mode)
    pilot.parameter("SIM_GPS_DISABLE", 1)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_LAND, 12.0)
    assert _in_order(
        pilot.texts,
        "EKF3 IMU0 stopped aiding",
        "EKF variance",
        "EKF Failsafe: changed to LAND Mode",
    )
    height_m = vehicle.height_m
    pilot.fly_on(3.5)
    assert vehicle.height_m == pytest.approx(height_m, abs=1.0), "the landing of a failsafe starts after four seconds"
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert not vehicle.body.crashed


def test_gps_loss_switches_to_alt_hold_if_configured():
    vehicle, pilot = airborne(15.0, FS_EKF_ACTION=2)
    pilot.parameter("SIM_GPS_DISABLE", 1)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_ALT_HOLD, 12.0)
    assert "EKF Failsafe: changed to ALT_HOLD Mode" in pilot.texts
    pilot.parameter("SIM_GPS_DISABLE", 0)
    pilot.wait(lambda: "EKF Failsafe Cleared" in pilot.texts, 10.0)
    assert "EKF3 IMU0 is using GPS" in pilot.texts[-3:]
    assert vehicle.mode == mavlink.COPTER_MODE_ALT_HOLD
    assert pilot.mode(mavlink.COPTER_MODE_GUIDED) == mavlink.MAV_RESULT_ACCEPTED


def test_too_few_satellites_invalidate_position():
    vehicle, pilot = airborne(15.0)
    pilot.parameter("SIM_GPS_NUMSATS", 3)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_LAND, 12.0)
    assert "EKF Failsafe: changed to LAND Mode" in pilot.texts


@pytest.mark.parametrize(
    ("setting", "mode", "text"),
    [
        (1, mavlink.COPTER_MODE_RTL, "GCS Failsafe"),
        (2, mavlink.COPTER_MODE_RTL, "GCS Failsafe"),
        (5, mavlink.COPTER_MODE_LAND, "GCS Failsafe"),
        (6, mavlink.COPTER_MODE_RTL, "Trying RTL Mode"),
        (7, mavlink.COPTER_MODE_BRAKE, "GCS Failsafe"),
    ],
)
def test_gcs_failsafe_action_follows_setting_when_node_loses_power(setting: int, mode: int, text: str):
    vehicle, pilot = airborne(10.0, FS_GCS_ENABLE=setting)
    pilot.go_to(40.0, 0.0, 10.0)
    pilot.heartbeats = False
    pilot.wait(lambda: vehicle.mode is mode, 8.0)
    assert pilot.texts[-1] == text
    pilot.heartbeats = True
    pilot.wait(lambda: "GCS Failsafe Cleared" in pilot.texts, 3.0)
    assert vehicle.mode is mode


@pytest.mark.parametrize(
    ("options", "mode", "stays", "text"),
    [
        (2, mavlink.COPTER_MODE_AUTO, True, "GCS Failsafe - Continuing Auto Mode"),
        (0, mavlink.COPTER_MODE_AUTO, False, "GCS Failsafe"),
        (8, mavlink.COPTER_MODE_LAND, True, "GCS Failsafe - Continuing Landing"),
        (16, mavlink.COPTER_MODE_LOITER, True, "GCS Failsafe - Continuing Pilot Control"),
        (0, mavlink.COPTER_MODE_LOITER, False, "GCS Failsafe"),
    ],
)
def test_gcs_failsafe_continues_modes_selected_by_fs_options(options: int, mode: int, stays: bool, text: str):
    vehicle, pilot = _in_mission(FS_GCS_ENABLE=1, FS_OPTIONS=options)
    pilot.mode(mode)
    pilot.heartbeats = False
    pilot.wait(lambda: vehicle.failsafes.gcs, 8.0)
    assert text in pilot.texts
    assert (vehicle.mode is mode) is stays


@pytest.mark.parametrize(
    ("setting", "mode"), [(1, mavlink.COPTER_MODE_RTL), (3, mavlink.COPTER_MODE_LAND), (7, mavlink.COPTER_MODE_BRAKE)]
)
def test_radio_failsafe_action_follows_setting(setting: int, mode: int):
    vehicle, pilot = airborne(10.0, FS_THR_ENABLE=setting)
    pilot.go_to(30.0, 0.0, 10.0)
    pilot.fly_on(3.0)
    pilot.parameter("SIM_RC_FAIL", 1)
    assert pilot.wait(lambda: vehicle.mode is mode, 3.0) == pytest.approx(1.0, abs=0.2)
    assert pilot.texts[-1] == "Radio Failsafe"
    pilot.parameter("SIM_RC_FAIL", 0)
    pilot.wait(lambda: pilot.texts[-1] == "Radio Failsafe Cleared", 1.0)


@pytest.mark.parametrize(
    ("options", "watched", "text"),
    [(4, 1, "Radio Failsafe - Continuing Guided Mode"), (4, 0, "Radio Failsafe"), (0, 1, "Radio Failsafe")],
)
def test_radio_failsafe_continues_guided_only_if_gcs_failsafe_is_enabled(options: int, watched: int, text: str):
    vehicle, pilot = airborne(10.0, FS_OPTIONS=options, FS_GCS_ENABLE=watched)
    pilot.parameter("SIM_RC_FAIL", 1)
    pilot.wait(lambda: vehicle.failsafes.radio, 3.0)
    assert text in pilot.texts
    assert (vehicle.mode == mavlink.COPTER_MODE_GUIDED) is text.endswith("Guided Mode")


def test_radio_failsafe_on_the_ground_disarms_and_prevents_arming():
    vehicle, pilot = alone()
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    pilot.parameter("SIM_RC_FAIL", 1)
    pilot.wait(lambda: not vehicle.armed, 3.0)
    assert "Radio Failsafe - Disarming" in pilot.texts
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_FAILED
    assert "Arm: Radio failsafe on" in pilot.texts


@pytest.mark.parametrize(
    ("setting", "mode"),
    [
        (0, mavlink.COPTER_MODE_GUIDED),
        (1, mavlink.COPTER_MODE_LAND),
        (2, mavlink.COPTER_MODE_RTL),
        (6, mavlink.COPTER_MODE_RTL),
        (7, mavlink.COPTER_MODE_BRAKE),
    ],
)
def test_battery_failsafe_action_follows_setting(setting: int, mode: int):
    vehicle, pilot = airborne(10.0, BATT_LOW_VOLT=11.5, BATT_FS_LOW_ACT=setting)
    pilot.go_to(30.0, 0.0, 10.0)
    pilot.fly_on(3.0)
    pilot.parameter("SIM_BATT_VOLTAGE", 10.4)
    pilot.wait(lambda: vehicle.failsafes.battery, 15.0)
    assert vehicle.mode is mode
    assert _in_order(pilot.texts, "Battery 1 is low 1", "Battery Failsafe")
    assert (
        pilot.last["HEARTBEAT"].integer("system_status") == 4 or pilot.expect("HEARTBEAT").integer("system_status") == 5
    )


def test_terminate_action_of_battery_failsafe_disarms():
    vehicle, pilot = airborne(10.0, BATT_CRT_VOLT=11.5, BATT_FS_CRT_ACT=5)
    pilot.parameter("SIM_BATT_VOLTAGE", 10.4)
    pilot.wait(lambda: not vehicle.armed, 15.0)
    assert _in_order(pilot.texts, "Battery 1 is critical 1", "Battery Failsafe", "Disarming motors")


def test_battery_landing_continues_after_gcs_failsafe():
    vehicle, pilot = airborne(25.0, BATT_CRT_VOLT=11.5, BATT_FS_CRT_ACT=1, FS_GCS_ENABLE=1, FS_OPTIONS=0)
    pilot.parameter("SIM_BATT_VOLTAGE", 10.4)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_LAND, 15.0)
    pilot.heartbeats = False
    pilot.wait(lambda: vehicle.failsafes.gcs, 8.0)
    assert pilot.texts[-1] == "GCS + Battery Failsafe - Continuing Landing"
    assert vehicle.mode == mavlink.COPTER_MODE_LAND


@pytest.mark.parametrize("motor", [0, 1, 2, 3])
def test_dead_motor_causes_crash_and_disarm(motor: int):
    vehicle, pilot = airborne(15.0)
    pilot.parameter("SIM_ENGINE_MUL", 0.0)
    pilot.parameter("SIM_ENGINE_FAIL", 1 << motor)
    pilot.wait(lambda: not vehicle.armed, 30.0)
    assert vehicle.body.crashed
    assert _in_order(pilot.texts, "Crash: Disarming: AngErr=", "Disarming motors")


def test_thrust_loss_is_reported_before_ground_contact():
    vehicle, pilot = airborne(30.0)
    pilot.parameter("SIM_ENGINE_MUL", 0.36)
    pilot.parameter("SIM_ENGINE_FAIL", 15)
    pilot.wait(lambda: any(text.startswith("Potential Thrust Loss (") for text in pilot.texts), 15.0)
    assert not vehicle.body.on_ground
    assert pilot.last["STATUSTEXT"].integer("severity") == mavlink.MAV_SEVERITY_EMERGENCY


def test_gust_is_compensated_without_mode_change():
    vehicle, pilot = airborne(15.0)
    texts_before = len(pilot.texts)
    pilot.parameter("SIM_WIND_DIR", 0)
    pilot.parameter("SIM_WIND_SPD", 10)
    worst = lean = 0.0
    for step in range(1500):
        if step == 600:
            pilot.parameter("SIM_WIND_SPD", 0)
        pilot.step()
        worst = max(worst, distance_m(vehicle, 0.0, 0.0))
        lean = max(lean, math.hypot(vehicle.est.roll, vehicle.est.pitch))
    assert 0.3 < worst < 5.0
    assert lean > math.radians(5)
    assert distance_m(vehicle, 0.0, 0.0) < 0.8
    assert (vehicle.mode, pilot.texts[texts_before:]) == (mavlink.COPTER_MODE_GUIDED, [])


def test_vehicle_blown_away_by_storm_returns():
    vehicle, pilot = airborne(30.0)
    pilot.parameter("SIM_WIND_SPD", 45)
    pilot.fly_on(8.0)
    assert distance_m(vehicle, 0.0, 0.0) > 10.0
    pilot.parameter("SIM_WIND_SPD", 0)
    pilot.fly_on(40.0)
    assert distance_m(vehicle, 0.0, 0.0) < 5.0
    assert vehicle.mode == mavlink.COPTER_MODE_GUIDED
    assert not vehicle.body.crashed


def test_fence_action_is_land_far_outside_fence():
    vehicle, pilot = airborne(10.0, FENCE_RADIUS=50, FENCE_ACTION=1)
    pilot.go_to(200.0, 0.0, 10.0)
    pilot.wait(lambda: vehicle.body.north > 190.0, 60.0)
    assert pilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1) == mavlink.MAV_RESULT_ACCEPTED
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_LAND, 3.0)
    assert "Circle fence breached" in pilot.texts


GLITCH_DEG = 0.0003
GLITCHING = 33599
"""Flags of EKF_STATUS_REPORT of a real ArduCopter during a GPS glitch. Without one they are 831."""


def _request(pilot: Pilot, message_id: int) -> None:
    pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 100_000)


@pytest.mark.parametrize("name", ["SIM_GPS_GLITCH_X", "SIM_GPS1_GLTCH_X"])
def test_gps_glitch_is_reported_accepted_and_cleared_as_by_real_autopilot(name: str):
    vehicle, pilot = airborne(15.0)
    _request(pilot, mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    pilot.go_to(0.0, 150.0, 15.0)
    pilot.fly_on(4.0)
    began_s = vehicle.time_s
    pilot.parameter(name, GLITCH_DEG)
    assert pilot.wait(lambda: pilot.last["EKF_STATUS_REPORT"].integer("flags") == GLITCHING, 2.0) >= 0.8
    assert "GPS Glitch or Compass error" in pilot.texts
    pilot.wait(lambda: vehicle.est.north - vehicle.body.north > 30.0, 10.0)
    assert vehicle.time_s - began_s == pytest.approx(8.5, abs=0.5)
    pilot.fly_on(10.0 - (vehicle.time_s - began_s))
    pilot.parameter(name, 0.0)
    pilot.fly_on(4.0)
    assert vehicle.body.north < -10.0, "the autopilot flies back to a course that it has not left"
    pilot.wait(lambda: pilot.last["EKF_STATUS_REPORT"].integer("flags") == 831, 20.0)
    assert vehicle.time_s - began_s == pytest.approx(30.0, abs=1.5)
    assert abs(vehicle.est.north - vehicle.body.north) < 1.0


def test_gps_glitch_moves_reported_gps_position_at_once_with_unchanged_accuracy():
    _, pilot = airborne(15.0)
    _request(pilot, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT)
    before = pilot.expect("GPS_RAW_INT")
    pilot.parameter("SIM_GPS_GLITCH_X", GLITCH_DEG)
    pilot.parameter("SIM_GPS_GLITCH_Z", 20.0)
    pilot.fly_on(1.0)
    after = pilot.expect("GPS_RAW_INT")
    assert after.integer("lat") - before.integer("lat") == pytest.approx(3000, abs=60)
    assert after.integer("alt") - before.integer("alt") == pytest.approx(20000, abs=2000)
    assert after.integer("h_acc") == before.integer("h_acc")


def test_hovering_vehicle_does_not_move_when_estimator_accepts_glitch():
    vehicle, pilot = airborne(15.0)
    pilot.mode(mavlink.COPTER_MODE_BRAKE)
    pilot.fly_on(3.0)
    north_m = vehicle.body.north
    pilot.parameter("SIM_GPS_GLITCH_X", GLITCH_DEG)
    pilot.fly_on(15.0)
    assert vehicle.est.north - vehicle.body.north > 30.0
    assert vehicle.body.north == pytest.approx(north_m, abs=1.0)


def test_slow_drift_of_gps_is_followed_without_report():
    vehicle, pilot = airborne(15.0)
    _request(pilot, mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    for second in range(60):
        pilot.parameter("SIM_GPS_GLITCH_X", 0.5 * second / 111_319.0)
        pilot.fly_on(1.0)
    assert vehicle.body.north == pytest.approx(-29.0, abs=2.5)
    assert pilot.expect("EKF_STATUS_REPORT").integer("flags") == 831
