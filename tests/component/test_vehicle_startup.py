"""Startup of the vehicle: STATUSTEXTs, arming checks by mode, and status bits."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fractus_vehicle.state import VehicleConfig, VehicleState
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import START, alone

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
