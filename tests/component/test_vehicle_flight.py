"""Motion of the simulated vehicle, and preconditions of its commands."""

from __future__ import annotations

import itertools
import math

import pytest
from fractus_core.policy.kinematics import stopping_distance_m
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.shaping import sqrt_controller, wrap_pi
from fractus_vehicle.state import VehicleState
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import START, airborne, alone, distance_m


def _target(pilot: Pilot, name: str, **values: float) -> None:
    pilot.send(name, {"target_system": 1, "target_component": 1} | values)


def _local(pilot: Pilot, frame: int, mask: int, **values: float) -> None:
    _target(pilot, "SET_POSITION_TARGET_LOCAL_NED", coordinate_frame=frame, type_mask=mask, **values)


def test_flight_performance_matches_real_vehicle_within_20_percent():
    vehicle, pilot = alone()
    climb_s = pilot.take_off(10.0)  # 95 % of 10 m
    assert 7.6 <= climb_s <= 11.4
    pilot.fly_on(6.0)
    pilot.go_to(50.0, 0.0, 10.0)
    peak = 0.0
    begun = pilot.simulation.time_s
    while distance_m(vehicle, 50.0, 0.0) > 1.0:
        pilot.step()
        peak = max(peak, math.hypot(vehicle.body.vn, vehicle.body.ve))
        assert pilot.simulation.time_s - begun < 20.0
    assert 7.44 <= pilot.simulation.time_s - begun <= 11.16
    assert 6.72 <= peak <= 10.08
    pilot.fly_on(6.0)
    assert pilot.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH) == mavlink.MAV_RESULT_ACCEPTED
    home_s = pilot.wait(lambda: not vehicle.armed, 120.0)
    assert 39.2 <= home_s <= 58.8
    assert distance_m(vehicle, 0.0, 0.0) < 1.0


def test_motion_overshoots_like_the_real_vehicle():
    """A real ArduCopter flies at up to 1.05 times its speed, 0.11 m above its altitude, and passes its target by 0.5 m."""
    vehicle, pilot = airborne(20.0, WPNAV_SPEED=770, SIM_WIND_SPD=4.0)
    pilot.fly_on(6.0)
    pilot.go_to(80.0, 0.0, 30.0)
    fastest_mps = 0.0
    highest_m = 0.0
    farthest_m = 0.0
    passing_mps = 0.0
    for _ in range(3000):
        pilot.step()
        body = vehicle.body
        fastest_mps = max(fastest_mps, math.hypot(body.vn, body.ve))
        highest_m = max(highest_m, -body.down)
        farthest_m = max(farthest_m, body.north)
        if not passing_mps and body.north >= 80.5:
            passing_mps = body.vn
    assert 1.01 * 7.7 < fastest_mps < 1.05 * 7.7
    assert 30.05 < highest_m < 30.15
    assert 80.5 < farthest_m < 81.3
    assert passing_mps > 0.3
    assert distance_m(vehicle, 80.0, 0.0) < 0.2, "the vehicle comes back to its target"


def test_velocity_zero_near_target_stops_beyond_it():
    """A real ArduCopter restarts its trajectory from the measured velocity when the controller changes."""
    vehicle, pilot = airborne(20.0)
    pilot.fly_on(6.0)
    pilot.go_to(60.0, 0.0, 20.0)
    pilot.wait(lambda: vehicle.body.north > 59.5, 30.0)
    for _ in range(500):
        _local(pilot, 1, 0b111111000111)
        pilot.step()
    assert vehicle.body.north > 60.3


def test_motion_respects_limits():
    vehicle, pilot = airborne(20.0, WPNAV_SPEED=500)
    pilot.go_to(80.0, 30.0, 20.0)
    accelerations = []
    farthest = 0.0
    for _ in range(3500):
        before = (vehicle.body.vn, vehicle.body.ve)
        pilot.step()
        assert math.hypot(vehicle.body.vn, vehicle.body.ve) < 5.5
        accelerations.append(math.dist(before, (vehicle.body.vn, vehicle.body.ve)) / 0.01)
        farthest = max(farthest, (vehicle.body.north * 80 + vehicle.body.east * 30) / math.hypot(80, 30))
        assert abs(vehicle.altitude_m - 20.0) < 1.0
        assert abs(vehicle.est.roll) < math.radians(31) and abs(vehicle.est.pitch) < math.radians(31)
    assert max(accelerations) < 1.6 * 2.5
    jerks = [abs(b - a) / 0.1 for a, b in itertools.pairwise(accelerations[::10])]
    assert max(jerks) < 4 * 5.0
    assert farthest < math.hypot(80, 30) + 1.0
    assert distance_m(vehicle, 80.0, 30.0) < 0.5


def test_position_is_held_in_wind_and_gusts():
    vehicle, pilot = airborne(15.0, SIM_WIND_SPD=8, SIM_WIND_DIR=270, SIM_WIND_TURB=2)
    pilot.fly_on(10.0)
    worst = 0.0
    for _ in range(3000):
        pilot.step()
        worst = max(worst, distance_m(vehicle, *vehicle.control.target))
    assert worst < 2.5
    assert abs(vehicle.est.roll) + abs(vehicle.est.pitch) > math.radians(3), "the vehicle must lean into the wind"


def test_arming_is_refused_with_reason_until_ready():
    vehicle, pilot = alone()
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_FAILED
    assert any(text.startswith("Arm: ") for text in pilot.texts)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    assert pilot.simulation.time_s >= 2.0
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.mode(mavlink.COPTER_MODE_RTL) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_FAILED
    assert pilot.texts[-1] == "Arm: RTL mode not armable"


def test_idle_vehicle_disarms_automatically():
    vehicle, pilot = alone()
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    assert 9.0 < pilot.wait(lambda: not vehicle.armed, 15.0) < 11.0


def test_takeoff_requires_guided_armed_and_landed():
    vehicle, pilot = alone()
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    takeoff = (mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5)
    assert pilot.command(*takeoff) == mavlink.MAV_RESULT_FAILED
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    assert pilot.command(*takeoff) == mavlink.MAV_RESULT_FAILED, "STABILIZE has no takeoff"
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    assert pilot.command(*takeoff[:-1], -3) == mavlink.MAV_RESULT_FAILED
    assert pilot.command(*takeoff) == mavlink.MAV_RESULT_ACCEPTED
    pilot.wait(lambda: not vehicle.landed, 10.0)
    assert vehicle.landed_state == mavlink.MAV_LANDED_STATE_TAKEOFF
    assert pilot.command(*takeoff) == mavlink.MAV_RESULT_FAILED
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0) == mavlink.MAV_RESULT_FAILED, (
        "disarming in the air requires the magic number 21196"
    )
    assert vehicle.armed
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21196) == mavlink.MAV_RESULT_ACCEPTED
    assert not vehicle.armed


def test_target_during_spool_up_cancels_takeoff():
    vehicle, pilot = alone()
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    pilot.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5)
    pilot.fly_on(0.5)
    pilot.go_to(10.0, 0.0, 10.0)
    pilot.fly_on(8.0)
    assert vehicle.landed


@pytest.mark.parametrize(
    ("command", "result"),
    [
        (31999, mavlink.MAV_RESULT_UNSUPPORTED),
        (mavlink.MAV_CMD_DO_REPOSITION, mavlink.MAV_RESULT_UNSUPPORTED),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.MAV_CMD_DO_FLIGHTTERMINATION, mavlink.MAV_RESULT_FAILED),
    ],
)
def test_command_returns_expected_result(command: int, result: int):
    _, pilot = alone()
    assert pilot.command(command) is result


def test_messages_for_other_systems_are_ignored():
    vehicle, pilot = alone()
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    pilot.send("COMMAND_LONG", {"target_system": 9, "target_component": 1, "command": 400, "param1": 1.0})
    pilot.fly_on(0.5)
    assert not vehicle.armed
    assert "COMMAND_ACK" not in pilot.last


@pytest.mark.parametrize("frame", [0, 3, 5, 6, 10, 11])
def test_global_target_is_flown_in_every_frame(frame: int):
    vehicle, pilot = airborne(10.0)
    place = START.offset(12.0, -9.0)
    altitude = 162.0 if frame in (0, 5) else 12.0
    _target(
        pilot,
        "SET_POSITION_TARGET_GLOBAL_INT",
        coordinate_frame=frame,
        type_mask=0xDF8,
        lat_int=place.lat_e7,
        lon_int=place.lon_e7,
        alt=altitude,
    )
    pilot.fly_on(15.0)
    assert distance_m(vehicle, 12.0, -9.0) < 0.7
    assert vehicle.altitude_m == pytest.approx(12.0, abs=0.5)


@pytest.mark.parametrize(("frame", "north", "east"), [(1, 6.0, 2.0), (7, 16.0, 2.0), (8, 8.0, 6.0), (9, 8.0, 6.0)])
def test_local_target_is_flown_in_every_frame(frame: int, north: float, east: float):
    vehicle, pilot = airborne(10.0)
    pilot.go_to(10.0, 0.0, 10.0)
    pilot.command(mavlink.MAV_CMD_CONDITION_YAW, 90, 90, 1, 0)
    pilot.fly_on(12.0)
    pilot.command(mavlink.MAV_CMD_CONDITION_YAW, 90, 90, 1, 0)
    pilot.fly_on(4.0)
    assert vehicle.est.yaw == pytest.approx(math.radians(90), abs=0.05)
    z = -10.0 if frame == 1 else 0.0
    _local(pilot, frame, 0xDF8, x=6.0, y=2.0, z=z)
    pilot.fly_on(12.0)
    assert distance_m(vehicle, north, east) < 0.8
    assert vehicle.altitude_m == pytest.approx(10.0, abs=0.5)


def test_velocity_target_expires_after_timeout():
    vehicle, pilot = airborne(20.0)
    for _ in range(30):
        _local(pilot, 1, 0xDC7, vx=3.0, vy=-1.0, vz=0.5)
        pilot.fly_on(0.2)
    assert vehicle.body.vn == pytest.approx(3.0, abs=0.3)
    assert vehicle.body.ve == pytest.approx(-1.0, abs=0.3)
    assert vehicle.body.vd == pytest.approx(0.5, abs=0.2)
    pilot.fly_on(2.5)
    assert vehicle.body.vn == pytest.approx(3.0, abs=0.3), "the target is still valid, because GUID_TIMEOUT is 3 s"
    pilot.fly_on(5.0)
    assert math.hypot(vehicle.body.vn, vehicle.body.ve) < 0.2


def test_yaw_targets_and_yaw_rates_are_followed():
    vehicle, pilot = airborne(10.0)
    _local(pilot, 1, 0x9F8, x=0.0, y=0.0, z=-10.0, yaw=2.0)
    pilot.fly_on(6.0)
    assert wrap_pi(vehicle.est.yaw - 2.0) == pytest.approx(0.0, abs=0.05)
    for _ in range(10):
        _local(pilot, 1, 0x5C7, vx=0.0, vy=0.0, vz=0.0, yaw_rate=0.5)
        pilot.fly_on(0.5)
    assert vehicle.body.r == pytest.approx(0.5, abs=0.1)


def test_heading_follows_course_and_region_of_interest():
    vehicle, pilot = airborne(10.0)
    pilot.go_to(0.0, 60.0, 10.0)
    pilot.fly_on(6.0)
    assert vehicle.est.yaw == pytest.approx(math.radians(90), abs=0.1)
    roi = START.offset(100.0, vehicle.body.east)
    values = {"frame": 3, "x": roi.lat_e7, "y": roi.lon_e7, "z": 0.0}
    assert pilot.command_int(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, values) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(10.0)
    bearing = math.atan2(vehicle.body.east * 0 + START.vector_to(roi)[1] - vehicle.body.east, 100.0)
    assert wrap_pi(vehicle.est.yaw - bearing) == pytest.approx(0.0, abs=0.1)


def test_reposition_changes_mode_only_with_flag():
    vehicle, pilot = airborne(10.0)
    assert pilot.mode(mavlink.COPTER_MODE_LOITER) == mavlink.MAV_RESULT_ACCEPTED
    place = START.offset(10.0, 5.0)
    values = {"frame": 6, "x": place.lat_e7, "y": place.lon_e7, "z": 15.0, "param1": -1.0, "param4": math.nan}
    assert pilot.command_int(mavlink.MAV_CMD_DO_REPOSITION, values) == mavlink.MAV_RESULT_DENIED
    assert pilot.command_int(mavlink.MAV_CMD_DO_REPOSITION, values | {"param2": 1.0}) == mavlink.MAV_RESULT_ACCEPTED
    assert vehicle.mode == mavlink.COPTER_MODE_GUIDED
    pilot.fly_on(15.0)
    assert distance_m(vehicle, 10.0, 5.0) < 0.7
    assert vehicle.altitude_m == pytest.approx(15.0, abs=0.4)


def test_changed_speed_is_kept_until_controller_changes():
    vehicle, pilot = airborne(10.0)
    assert pilot.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 2.0) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, -1.0) == mavlink.MAV_RESULT_FAILED
    pilot.go_to(40.0, 0.0, 10.0)
    pilot.fly_on(4.0)
    assert vehicle.body.vn > 5.0, "a started position controller uses the speed parameter"
    assert pilot.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 2.0) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(5.0)
    assert vehicle.body.vn == pytest.approx(2.0, abs=0.2)
    pilot.go_to(-60.0, 0.0, 10.0)
    pilot.fly_on(10.0)
    assert vehicle.body.vn == pytest.approx(-2.0, abs=0.2), "the next position target keeps the speed"
    _local(pilot, 1, 0xDC7, vx=0.0, vy=0.0, vz=0.0)
    pilot.fly_on(3.0)
    pilot.go_to(-60.0, 0.0, 10.0)
    pilot.fly_on(4.0)
    assert vehicle.body.vn < -5.0, "an intermediate velocity target resets the speed"


def _at_speed(speed_mps: float, **parameters: float) -> tuple[VehicleState, Pilot]:
    """Return a vehicle that has flown north for some seconds with a velocity target repeated at 4 Hz."""
    vehicle, pilot = airborne(10.0, **parameters)
    for _ in range(32):
        _local(pilot, 1, 0xDC7, vx=speed_mps, vy=0.0, vz=0.0)
        pilot.fly_on(0.25)
    assert vehicle.est.vn == pytest.approx(speed_mps, abs=0.3)
    return vehicle, pilot


def _until_slow(vehicle: VehicleState, pilot: Pilot, slow_mps: float = 0.5) -> float:
    return pilot.wait(lambda: math.hypot(vehicle.est.vn, vehicle.est.ve) < slow_mps, 10.0)


@pytest.mark.parametrize(("speed_mps", "real_m", "real_s"), [(6.4, 10.6, 3.75), (6.8, 12.2, 3.9)])
def test_brake_stopping_distance_matches_real_vehicle(speed_mps: float, real_m: float, real_s: float):
    vehicle, pilot = _at_speed(speed_mps)
    at = vehicle.est.north
    assert pilot.mode(mavlink.COPTER_MODE_BRAKE) == mavlink.MAV_RESULT_ACCEPTED
    assert _until_slow(vehicle, pilot) == pytest.approx(real_s, rel=0.15)
    pilot.fly_on(3.0)
    assert vehicle.est.north - at == pytest.approx(real_m, rel=0.15)


def test_zero_velocity_stopping_distance_matches_real_vehicle():
    vehicle, pilot = _at_speed(9.5)
    at = vehicle.est.north
    _local(pilot, 1, 0xDC7, vx=0.0, vy=0.0, vz=0.0)
    assert _until_slow(vehicle, pilot) == pytest.approx(4.2, rel=0.1)
    pilot.fly_on(1.0)
    assert vehicle.est.north - at == pytest.approx(20.2, rel=0.1), "19.6 and 20.7 m in two flights of the real vehicle"


@pytest.mark.parametrize(("timeout_s", "real_s"), [(3.0, 5.0), (1.0, 3.1)])
def test_velocity_timeout_matches_real_vehicle(timeout_s: float, real_s: float):
    vehicle, pilot = _at_speed(3.0, GUID_TIMEOUT=timeout_s)
    assert 0.25 + _until_slow(vehicle, pilot, 0.1) == pytest.approx(real_s, abs=0.4)


@pytest.mark.parametrize("mode", [mavlink.COPTER_MODE_LOITER, mavlink.COPTER_MODE_GUIDED])
def test_stopping_distance_matches_ardupilot_formula(mode: int):
    vehicle, pilot = _at_speed(8.0)
    at = vehicle.body.north
    speed = vehicle.body.vn
    if mode == mavlink.COPTER_MODE_GUIDED:
        _local(pilot, 1, 0xFFF)
    else:
        assert pilot.mode(mode) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(10.0)
    assert abs(vehicle.body.vn) < 0.2
    assert vehicle.body.north - at < stopping_distance_m(speed, 2.5, 1.0) + 2.0
    assert vehicle.altitude_m == pytest.approx(10.0, abs=0.5)


def test_land_disarms_after_touchdown():
    vehicle, pilot = airborne(8.0)
    assert pilot.command(mavlink.MAV_CMD_NAV_LAND) == mavlink.MAV_RESULT_ACCEPTED
    took = pilot.wait(lambda: not vehicle.armed, 60.0)
    assert 14.0 < took < 25.0
    assert vehicle.body.on_ground
    assert vehicle.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
    assert vehicle.body.impact_mps < 0.8


def test_unknown_modes_are_refused():
    vehicle, pilot = alone()
    assert pilot.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 99) == mavlink.MAV_RESULT_FAILED
    assert pilot.texts[-1] == "No such mode 99"
    assert pilot.command(mavlink.MAV_CMD_DO_SET_MODE, 0, 4) == mavlink.MAV_RESULT_DENIED
    assert vehicle.mode == mavlink.COPTER_MODE_STABILIZE


def test_mode_requirements_are_checked_only_while_armed():
    vehicle, pilot = alone()
    assert pilot.mode(mavlink.COPTER_MODE_AUTO) == mavlink.MAV_RESULT_ACCEPTED, "disarmed, every mode can be selected"
    assert pilot.mode(mavlink.COPTER_MODE_GUIDED) == mavlink.MAV_RESULT_ACCEPTED
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    assert pilot.mode(mavlink.COPTER_MODE_AUTO) == mavlink.MAV_RESULT_FAILED, "the vehicle has no mission"
    assert pilot.texts[-1] == "Mode change to AUTO failed: init failed"
    assert pilot.command(mavlink.MAV_CMD_MISSION_START) == mavlink.MAV_RESULT_FAILED
    assert vehicle.mode == mavlink.COPTER_MODE_GUIDED


def test_nan_targets_are_ignored():
    vehicle, pilot = airborne(10.0)
    _local(pilot, 1, 0xDF8, x=math.nan, y=0.0, z=-10.0)
    _local(pilot, 1, 0xDC7, vx=math.inf, vy=0.0, vz=0.0)
    pilot.fly_on(5.0)
    assert distance_m(vehicle, 0.0, 0.0) < 0.5


def test_sqrt_controller_is_monotonic_and_bounded():
    values = [sqrt_controller(error / 100.0, 1.0, 2.5, 0.01) for error in range(-5000, 5001)]
    assert all(b >= a for a, b in itertools.pairwise(values))
    assert values[5000] == 0.0
    assert max(values) <= math.sqrt(2 * 2.5 * 50.0)


def _fly_pattern(seed: int) -> bytes:
    from dataclasses import replace

    from fractus_vehicle.simulation import Simulation
    from vehicle_pilot import Pilot
    from vehicle_world import CONFIG

    class Log:
        data = b""

        def write(self, data: bytes) -> int:
            self.data += data
            return len(data)

    parameters = {"SIM_WIND_SPD": 4.0, "SIM_WIND_TURB": 2.0}
    simulation = Simulation([replace(CONFIG, seed=seed, parameters=parameters)])
    log = Log()
    simulation.crafts[0].record(log)  # type: ignore[arg-type]
    pilot = Pilot(simulation, simulation.crafts[0])
    pilot.take_off(10.0)
    pilot.go_to(15.0, -5.0, 12.0)
    pilot.fly_on(10.0)
    return log.data


def test_same_seed_produces_same_log():
    first = _fly_pattern(7)
    assert len(first) > 50_000
    assert first == _fly_pattern(7)
    assert first != _fly_pattern(8)


def test_estimate_has_small_error():
    vehicle, pilot = airborne(10.0)
    pilot.fly_on(30.0)
    error = math.dist((vehicle.est.north, vehicle.est.east), (vehicle.body.north, vehicle.body.east))
    assert 0.0 < error < 0.5


def test_battery_without_capacity_keeps_its_voltage():
    vehicle, pilot = airborne(10.0)
    pilot.fly_on(60.0)
    assert vehicle.battery.voltage_v == pytest.approx(12.6)
    assert vehicle.battery.percent < 100


def test_battery_voltage_drops_with_charge_and_load():
    vehicle, pilot = airborne(10.0, SIM_BATT_CAP_AH=3.3)
    before = vehicle.battery.percent
    resting = vehicle.battery.full_v
    pilot.fly_on(60.0)
    assert vehicle.battery.percent < before
    assert vehicle.battery.voltage_v < resting - 0.2
    assert isinstance(vehicle, VehicleState)
    remaining_mah = vehicle.battery.capacity_mah - vehicle.battery.used_mah
    endurance_min = remaining_mah / (vehicle.battery.used_mah / pilot.simulation.time_s) / 60.0
    assert 8.0 < endurance_min < 25.0
