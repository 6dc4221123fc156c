"""Sensor noise, target frames, and tlog recording of the simulated vehicle."""

from __future__ import annotations

import io
import math
import statistics
import struct
from dataclasses import replace

import pytest
from fractus_runtime.mavlink_codec import Message, Parser
from fractus_vehicle.noise import gaussian
from fractus_vehicle.state import VehicleState
from fractus_vehicle.telemetry import send
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import CONFIG, START, airborne, alone, distance_m, upload


def _messages(pilot: Pilot, number: int, name: str, duration_s: float) -> list[Message]:
    assert pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 20_000) == mavlink.MAV_RESULT_ACCEPTED
    return [m for _ in range(round(duration_s * 100)) for m in pilot.step() if m.name == name]


def test_sensor_noise_is_normal_independent_and_repeatable():
    first = [gaussian(1, tick, 0) for tick in range(4000)]
    two = [gaussian(1, tick, 1) for tick in range(4000)]
    assert statistics.fmean(first) == pytest.approx(0.0, abs=0.05)
    assert statistics.stdev(first) == pytest.approx(1.0, abs=0.05)
    assert abs(statistics.correlation(first, two)) < 0.05
    assert abs(statistics.correlation(first[1:], first[:-1])) < 0.05
    assert first[7] == gaussian(1, 7, 0) != gaussian(2, 7, 0)


def test_imu_noise_increases_in_flight():
    still, pilot = alone(config=replace(CONFIG, seed=5))
    pilot.fly_on(3.0)
    at_rest = [m.integer("xacc") for m in _messages(pilot, 27, "RAW_IMU", 4.0)]
    _, flying = airborne(10.0)
    in_flight = [m.integer("xacc") for m in _messages(flying, 27, "RAW_IMU", 4.0)]
    assert 0.0 < statistics.stdev(at_rest) < statistics.stdev(in_flight)
    assert statistics.fmean(m.integer("zacc") for m in _messages(flying, 27, "RAW_IMU", 4.0)) == pytest.approx(
        -1000, abs=25
    )
    assert still.ticks > 0


def test_estimated_attitude_drifts_around_true_attitude():
    vehicle, pilot = airborne(10.0)
    errors = []
    for _ in range(200):
        pilot.fly_on(0.2)
        true = vehicle.body.euler()
        errors.append(max(abs(vehicle.est.roll - true[0]), abs(vehicle.est.pitch - true[1])))
    assert 0.0 < max(errors) < math.radians(1.0)
    assert math.hypot(*vehicle.est.quaternion) == pytest.approx(1.0, abs=1e-3)


def _mask(pilot: Pilot, frame: int, mask: int, **values: float) -> None:
    target = {"target_system": 1, "target_component": 1, "coordinate_frame": frame, "type_mask": mask}
    pilot.send("SET_POSITION_TARGET_LOCAL_NED", target | values)


def _flying_north() -> tuple[VehicleState, Pilot]:
    vehicle, pilot = airborne(10.0)
    pilot.go_to(200.0, 0.0, 10.0)
    pilot.wait(lambda: vehicle.body.vn > 5.0, 10.0)
    return vehicle, pilot


@pytest.mark.parametrize(
    ("frame", "mask"),
    [
        (1, 0x9FF),  # yaw only
        (1, 0x5FF),  # yaw rate only
        (1, 0xFFF),  # nothing
        (1, 0xE00 | 0x03F),  # force flag
        (1, 0xC00 | 0x038),  # position and acceleration without velocity
        (12, 0xDC7),  # frame unsupported by ArduCopter
        (3, 0xDF8),  # global frame in a local message
    ],
)
def test_invalid_target_stops_vehicle(frame: int, mask: int):
    vehicle, pilot = _flying_north()
    _mask(pilot, frame, mask, vx=9.0, x=500.0, yaw=1.0)
    pilot.fly_on(8.0)
    assert abs(vehicle.body.vn) < 0.2


def test_force_flag_without_acceleration_is_ignored():
    vehicle, pilot = airborne(10.0)
    _mask(pilot, 1, 0xDF8 | 0x200, x=15.0, y=0.0, z=-10.0)
    pilot.fly_on(10.0)
    assert distance_m(vehicle, 15.0, 0.0) < 0.7


@pytest.mark.parametrize(("known", "altitude_m"), [(1, 14.0), (0, 10.0)])
def test_terrain_targets_require_terrain_data(known: int, altitude_m: float):
    vehicle, pilot = airborne(10.0, TERRAIN_ENABLE=known)
    place = START.offset(10.0, 0.0)
    pilot.send(
        "SET_POSITION_TARGET_GLOBAL_INT",
        {
            "target_system": 1,
            "target_component": 1,
            "coordinate_frame": 11,
            "type_mask": 0xDF8,
            "lat_int": place.lat_e7,
            "lon_int": place.lon_e7,
            "alt": 14.0,
        },
    )
    pilot.fly_on(12.0)
    assert vehicle.altitude_m == pytest.approx(altitude_m, abs=0.5)
    values = {"frame": 11, "x": place.lat_e7, "y": place.lon_e7, "z": 12.0}
    expected = mavlink.MAV_RESULT_ACCEPTED if known else mavlink.MAV_RESULT_DENIED
    assert pilot.command_int(mavlink.MAV_CMD_DO_REPOSITION, values) is expected
    assert send(vehicle, pilot.channel, "TERRAIN_REPORT") is bool(known)


def test_mission_above_unknown_terrain_returns():
    vehicle, pilot = airborne(10.0, TERRAIN_ENABLE=0)
    place = START.offset(60.0, 0.0)
    home = {"command": 16, "frame": 0, "x": START.lat_e7, "y": START.lon_e7, "z": 150.0}
    waypoint = {"command": 16, "frame": 10, "x": place.lat_e7, "y": place.lon_e7, "z": 12.0}
    assert upload(pilot, 0, [home, waypoint]) == 0
    pilot.mode(mavlink.COPTER_MODE_AUTO)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_RTL, 2.0)
    assert "Failsafe: Terrain data missing" in pilot.texts


def test_tlog_contains_both_directions():
    _, pilot = alone()
    log = io.BytesIO()
    pilot.craft.record(log)
    pilot.send("COMMAND_LONG", {"target_system": 1, "target_component": 1, "command": 520, "param1": 1.0})
    pilot.fly_on(2.0)
    entries = []
    data = log.getvalue()
    at = 0
    while at < len(data):
        time_us = struct.unpack(">Q", data[at : at + 8])[0]
        length = data[at + 9] + 12
        message = Parser().feed(data[at + 8 : at + 8 + length])[0]
        entries.append((time_us, message.sysid, message.name))
        at += 8 + length
    assert entries == sorted(entries, key=lambda entry: entry[0])
    assert {(255, "COMMAND_LONG"), (255, "HEARTBEAT"), (1, "HEARTBEAT"), (1, "ATTITUDE")} <= {e[1:] for e in entries}
