"""Gimbal of the simulated vehicle: turn rate, limits and reported attitude."""

from __future__ import annotations

import math

import pytest
from fractus_runtime.mavlink_codec import message
from fractus_services.mobility.mavlink.gimbal import attitude_of
from fractus_vehicle.motion_reports import gimbal_device_attitude_status, gimbal_manager_information
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_world import alone

SIYI = 8.0
SERVOS = 1.0
PITCHYAW = mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW


def test_vehicle_without_gimbal_sends_no_gimbal_messages() -> None:
    vehicle, pilot = alone()
    assert pilot.command(PITCHYAW, -45.0, 0.0, math.nan, math.nan) == mavlink.MAV_RESULT_FAILED
    assert gimbal_device_attitude_status(vehicle) is None
    assert gimbal_manager_information(vehicle) is None


def test_gimbal_turns_at_its_rate_and_reports_attitude() -> None:
    vehicle, pilot = alone(MNT1_TYPE=SIYI)
    assert pilot.command(PITCHYAW, -90.0, 120.0, math.nan, math.nan) == mavlink.MAV_RESULT_ACCEPTED
    begun_s = vehicle.time_s
    angles = []

    def turned() -> bool:
        report = gimbal_device_attitude_status(vehicle)
        assert report is not None
        attitude = attitude_of(message("GIMBAL_DEVICE_ATTITUDE_STATUS", **report), 0.0)
        assert attitude is not None
        angles.append(attitude.pitch_deg)
        return attitude.pitch_deg < -89.0 and vehicle.gimbal.yaw_deg == 120.0

    pilot.wait(turned, 5.0)
    assert 1.7 < vehicle.time_s - begun_s < 2.5, "a turn by 120 degrees takes 2 s at 60 degrees per second"
    assert any(-60 < angle < -30 for angle in angles), "the gimbal passes intermediate angles"


@pytest.mark.parametrize("angles_deg", [(-120.0, 0.0, -90.0), (60.0, 0.0, 20.0)])
def test_gimbal_angles_are_limited(angles_deg: tuple[float, float, float]) -> None:
    vehicle, pilot = alone(MNT1_TYPE=SIYI)
    pilot.command(PITCHYAW, *angles_deg[:2], math.nan, math.nan)
    pilot.wait(lambda: vehicle.gimbal.pitch_deg == angles_deg[2], 3.0)


def test_servo_gimbal_reports_its_target() -> None:
    vehicle, pilot = alone(MNT1_TYPE=SERVOS)
    pilot.command(PITCHYAW, -90.0, 0.0, math.nan, math.nan)
    assert vehicle.gimbal.pitch_deg > -20.0
    assert vehicle.gimbal.reported_quaternion[2] == pytest.approx(-math.sqrt(0.5))
