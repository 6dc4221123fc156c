"""Startup of the vehicle: STATUSTEXTs, arming checks by mode, and status bits."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.state import VehicleConfig, VehicleState
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import START, alone, upload

COLD = VehicleConfig(start=replace(START, alt_m=0.1))
WITHOUT_POSITION = 167
WITH_POSITION = 831
TEXTS = """Calibrating barometer
Barometer 1 calibration complete
Barometer 2 calibration complete
ArduPilot Ready
AHRS: DCM active
RC7: SaveWaypoint LOW
EKF3 IMU0 initialised
EKF3 IMU1 initialised
AHRS: EKF3 active
EKF3 IMU0 tilt alignment complete
EKF3 IMU1 tilt alignment complete
EKF3 IMU0 MAG0 initial yaw alignment complete
EKF3 IMU1 MAG0 initial yaw alignment complete
GPS 1: probing for u-blox at 230400 baud
GPS 1: detected u-blox
EKF3 IMU0 origin set
Field Elevation Set: 0m
EKF3 IMU1 origin set
EKF3 IMU0 is using GPS
EKF3 IMU1 is using GPS"""


def _cold() -> tuple[VehicleState, Pilot]:
    vehicle, pilot = alone(config=COLD)
    for number in (1, 193):
        pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 200_000)
    return vehicle, pilot


def _prearm(pilot: Pilot) -> bool:
    return bool(
        pilot.expect("SYS_STATUS").integer("onboard_control_sensors_health") & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    )


def _refusals(pilot: Pilot) -> list[str]:
    before = len(pilot.texts)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_FAILED
    return [text for text in pilot.texts[before:] if text.startswith("Arm: ")]


def test_cold_start_sends_statustexts_of_real_vehicle():
    _, pilot = _cold()
    pilot.fly_on(42.0)
    assert [text for text in pilot.texts if not text.startswith("PreArm: ")] == TEXTS.splitlines()
    assert pilot.texts.count("PreArm: AHRS: waiting for home") == 1, "the text is repeated every 30 s, first after 15 s"


def test_warm_start_sends_same_statustexts():
    _, pilot = alone(config=replace(COLD, ready_after_s=1.0))
    pilot.fly_on(1.2)
    assert pilot.texts == TEXTS.splitlines()


def test_prearm_bit_is_healthy_before_guided_can_arm():
    vehicle, pilot = _cold()
    pilot.wait(lambda: _prearm(pilot), 60.0)
    assert vehicle.time_s == pytest.approx(22.0, abs=1.0)
    assert pilot.expect("EKF_STATUS_REPORT").integer("flags") == WITHOUT_POSITION
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    assert _refusals(pilot) == ["Arm: Need Position Estimate"]
    assert not _prearm(pilot)
    pilot.wait(lambda: _prearm(pilot), 60.0)
    assert vehicle.time_s == pytest.approx(41.0, abs=1.0)
    assert pilot.expect("EKF_STATUS_REPORT").integer("flags") == WITH_POSITION
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_ACCEPTED


def test_all_failed_arming_checks_are_reported_per_mode():
    _, pilot = _cold()
    pilot.fly_on(3.5)
    first = ["Arm: Accels inconsistent", "Arm: EKF attitude is bad", "Arm: AHRS: not using configured AHRS type"]
    assert _refusals(pilot) == first
    pilot.fly_on(2.0)
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    later = ["Need Alt Estimate", "Accels inconsistent", "EKF attitude is bad", "AHRS: waiting for home"]
    assert _refusals(pilot) == [f"Arm: {text}" for text in later]
    pilot.fly_on(2.0)
    before = len(pilot.texts)
    assert pilot.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.texts[before:] == ["PreArm: Accels inconsistent", "PreArm: AHRS: waiting for home"]


def test_position_is_required_for_forced_arming_and_with_disabled_checks():
    _, pilot = _cold()
    pilot.parameter("ARMING_CHECK", 0.0)
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.fly_on(25.0)
    assert _refusals(pilot) == ["Arm: Need Position Estimate"]
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, 2989.0) == mavlink.MAV_RESULT_FAILED
    pilot.mode(mavlink.COPTER_MODE_STABILIZE)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_ACCEPTED


def test_first_heartbeats_report_boot_state():
    _, pilot = _cold()
    beat = pilot.expect("HEARTBEAT")
    assert beat.integer("system_status") == mavlink.MAV_STATE_BOOT
    assert beat.integer("base_mode") & mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
    pilot.fly_on(3.0)
    beat = pilot.expect("HEARTBEAT")
    assert beat.integer("system_status") == mavlink.MAV_STATE_STANDBY
    assert not beat.integer("base_mode") & mavlink.MAV_MODE_FLAG_GUIDED_ENABLED


RALLY = {"command": 5100, "frame": 3, "x": START.lat_e7, "y": START.lon_e7, "z": 10.0}
FAILED_CHECKS: list[tuple[dict[str, float], int, list[str]]] = [
    ({"GPS_HDOP_GOOD": 50}, 4, ["High GPS HDOP"]),
    ({"GPS_HDOP_GOOD": 50}, 0, []),
    ({"ARMING_MIS_ITEMS": 1}, 4, ["Missing mission item: land"]),
    ({"ARMING_MIS_ITEMS": 8}, 4, ["Missing mission item: takeoff"]),
    ({"ARMING_MIS_ITEMS": 32}, 4, ["No sufficiently close rally point located"]),
    ({"ARMING_MIS_ITEMS": 64}, 4, ["Missing mission item: RTL"]),
    ({"SIM_MAG1_FAIL": 1}, 4, ["Compass not healthy"]),
    ({"SIM_MAG1_FAIL": 1, "COMPASS_USE": 0}, 4, []),
    ({"SIM_MAG1_FAIL": 1, "COMPASS_ENABLE": 0}, 4, []),
    ({"SIM_ACC1_BIAS_X": 8}, 4, ["Accels inconsistent"]),
    ({"SIM_ACC2_BIAS_Z": 1.4}, 4, []),
    ({"SIM_ACC2_BIAS_Z": 1.6}, 4, ["Accels inconsistent"]),
    ({"FRAME_CLASS": 0}, 4, ["Motors: Check frame class and type"]),
    ({"FRAME_CLASS": 0, "ARMING_CHECK": 0}, 4, ["Motors: Check frame class and type"]),
    ({"PILOT_SPEED_UP": 0}, 4, ["Check PILOT_SPEED_UP"]),
    ({"ANGLE_MAX": 500}, 4, ["Check ANGLE_MAX"]),
    ({"ANGLE_MAX": 8100, "PILOT_SPEED_UP": 0}, 4, ["Check ANGLE_MAX"]),
    ({"ACRO_BAL_ROLL": 50}, 4, ["Check ACRO_BAL_ROLL/PITCH"]),
    ({"ACRO_BAL_PITCH": 50}, 4, ["Check ACRO_BAL_ROLL/PITCH"]),
    ({"FS_THR_VALUE": 2000}, 4, ["Check FS_THR_VALUE", "Throttle below failsafe", "Radio failsafe on"]),
    ({"FS_THR_VALUE": 2000, "FS_THR_ENABLE": 0}, 4, []),
    (
        {"AHRS_EKF_TYPE": 2},
        4,
        ["Need Alt Estimate", "EKF attitude is bad", "AHRS: not using configured AHRS type"],
    ),
    ({"ANGLE_MAX": 500, "GPS_HDOP_GOOD": 50, "SIM_MAG1_FAIL": 1, "ARMING_MIS_ITEMS": 1, "ARMING_CHECK": 0}, 4, []),
]


@pytest.mark.parametrize(("parameters", "mode", "texts"), FAILED_CHECKS, ids=str)
def test_arming_check_reports_what_a_real_vehicle_reports(parameters: dict[str, float], mode: int, texts: list[str]):
    vehicle, pilot = alone()
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    for name, value in parameters.items():
        pilot.parameter(name, value)
    pilot.mode(mode)
    pilot.fly_on(0.2)
    assert arming_refusals(vehicle) == texts
    result = mavlink.MAV_RESULT_FAILED if texts else mavlink.MAV_RESULT_ACCEPTED
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == result


def test_required_mission_items_are_found():
    vehicle, pilot = alone(ARMING_MIS_ITEMS=1 | 8 | 32 | 64)
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    home = {"command": 16, "frame": 0}
    upload(pilot, 0, [home, {"command": 22, "frame": 3, "z": 5.0}, {"command": 20}, {"command": 21, "frame": 3}])
    upload(pilot, 2, [RALLY])
    assert arming_refusals(vehicle) == []


def test_accelerometers_must_agree_for_ten_seconds_after_a_difference():
    vehicle, pilot = alone(SIM_ACC1_BIAS_X=8)
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    pilot.parameter("SIM_ACC1_BIAS_X", 0.0)
    pilot.fly_on(9.5)
    assert arming_refusals(vehicle) == ["Accels inconsistent"]
    pilot.fly_on(1.0)
    assert arming_refusals(vehicle) == []
