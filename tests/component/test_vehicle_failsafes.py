"""Failsafes of the autopilot: each fault leads to the mode and STATUSTEXT of a real ArduCopter."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fractus_vehicle.simulation import Simulation
from fractus_vehicle.state import VehicleState
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import CONFIG, START, airborne, alone, distance_m, upload


def _square(command: int, half_m: float, north_m: float = 0.0) -> list[dict[str, float]]:
    corners = [(-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m)]
    places = [START.offset(north_m + north, east) for north, east in corners]
    return [{"command": command, "param1": 4.0, "frame": 0, "x": p.lat_e7, "y": p.lon_e7} for p in places]


def test_gcs_failsafe_returns_home_when_heartbeats_stop():
    vehicle, pilot = airborne(10.0, FS_GCS_ENABLE=1)
    pilot.go_to(30.0, 0.0, 10.0)
    pilot.fly_on(5.0)
    pilot.heartbeats = False
    elapsed_s = pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_RTL, 10.0)
    assert 3.9 < elapsed_s <= 5.2
    assert pilot.texts[-1] == "GCS Failsafe"
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert distance_m(vehicle, 0.0, 0.0) < 1.0


def test_gcs_failsafe_monitors_only_sysid_mygcs():
    vehicle, pilot = airborne(10.0, FS_GCS_ENABLE=1, SYSID_MYGCS=255)
    other = Pilot(pilot.simulation, pilot.craft, sysid=42)
    pilot.heartbeats = False
    other.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_RTL, 10.0)
    assert "GCS Failsafe" in other.texts
    pilot.heartbeats = True
    pilot.fly_on(2.0)
    assert "GCS Failsafe Cleared" in pilot.texts
    assert vehicle.mode == mavlink.COPTER_MODE_RTL, "the mode stays RTL after the failsafe is cleared"


def test_gcs_failsafe_timeout_follows_parameter():
    vehicle, pilot = airborne(10.0, FS_GCS_ENABLE=5)
    assert pilot.parameter("FS_GCS_TIMEOUT", 2.0) == 2.0
    pilot.heartbeats = False
    assert pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_LAND, 10.0) < 2.3


def test_disabled_gcs_failsafe_does_not_act():
    vehicle, pilot = airborne(10.0)
    pilot.heartbeats = False
    pilot.fly_on(20.0)
    assert vehicle.mode == mavlink.COPTER_MODE_GUIDED


def test_battery_failsafe_acts_on_low_and_critical_charge():
    vehicle, pilot = airborne(
        10.0, BATT_LOW_VOLT=11.5, BATT_CRT_VOLT=10.8, BATT_LOW_TIMER=3, BATT_FS_LOW_ACT=2, BATT_FS_CRT_ACT=1
    )
    pilot.go_to(60.0, 0.0, 10.0)
    pilot.fly_on(8.0)
    pilot.parameter("SIM_BATT_VOLTAGE", 11.4)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_RTL, 10.0)
    assert any(text.startswith("Battery 1 is low 11.") for text in pilot.texts)
    assert pilot.texts[-1] == "Battery Failsafe"
    pilot.parameter("SIM_BATT_VOLTAGE", 10.7)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_LAND, 10.0)
    assert any(text.startswith("Battery 1 is critical 10.") for text in pilot.texts)
    pilot.wait(lambda: not vehicle.armed, 60.0)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_FAILED


def test_gps_loss_lands_vehicle():
    vehicle, pilot = airborne(15.0)
    pilot.parameter("SIM_GPS_DISABLE", 1)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_LAND, 15.0)
    assert "EKF Failsafe: changed to LAND Mode" in pilot.texts
    assert pilot.mode(mavlink.COPTER_MODE_GUIDED) == mavlink.MAV_RESULT_FAILED
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert vehicle.body.on_ground


def test_short_gps_loss_causes_no_failsafe():
    vehicle, pilot = airborne(15.0)
    pilot.parameter("SIM_GPS_DISABLE", 1)
    pilot.fly_on(3.0)
    pilot.parameter("SIM_GPS_DISABLE", 0)
    pilot.fly_on(10.0)
    assert vehicle.mode == mavlink.COPTER_MODE_GUIDED
    assert distance_m(vehicle, 0.0, 0.0) < 2.0


def test_fence_breach_returns_vehicle():
    vehicle, pilot = airborne(10.0)
    assert upload(pilot, 1, _square(mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, 20.0)) == 0
    assert pilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1) == mavlink.MAV_RESULT_ACCEPTED
    for _ in range(200):
        pilot.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            {"target_system": 1, "target_component": 1, "coordinate_frame": 1, "type_mask": 0xDC7, "vx": 9.0},
        )
        pilot.fly_on(0.1)
        if vehicle.mode == mavlink.COPTER_MODE_RTL:
            break
    assert vehicle.mode == mavlink.COPTER_MODE_RTL
    assert vehicle.body.north > 20.0, "the vehicle reacts only after it has crossed the fence"
    assert "Polygon fence breached" in pilot.texts
    assert vehicle.fence.breach_type == 3
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert distance_m(vehicle, 0.0, 0.0) < 1.0


def test_target_outside_fence_is_silently_dropped():
    vehicle, pilot = airborne(10.0)
    upload(pilot, 1, _square(mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, 20.0))
    pilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1)
    pilot.fly_on(1.0)
    texts = list(pilot.texts)
    pilot.last.clear()
    pilot.go_to(60.0, 0.0, 10.0)
    pilot.fly_on(5.0)
    assert distance_m(vehicle, 0.0, 0.0) < 0.7
    assert (pilot.texts, pilot.last.keys() - {"HEARTBEAT"}) == (texts, set())
    place = START.offset(60.0, 0.0)
    values = {"frame": 6, "x": place.lat_e7, "y": place.lon_e7, "z": 10.0}
    assert pilot.command_int(mavlink.MAV_CMD_DO_REPOSITION, values) == mavlink.MAV_RESULT_FAILED
    pilot.go_to(10.0, 0.0, 10.0)
    pilot.fly_on(8.0)
    assert distance_m(vehicle, 10.0, 0.0) < 0.7


def test_fence_enable_switches_whole_fence_or_minimum_altitude():
    vehicle, pilot = alone(FENCE_TYPE=12, FENCE_ENABLE=1)
    assert vehicle.fence.outside(0.0, 0.0, -20.0)
    assert pilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 2) == mavlink.MAV_RESULT_ACCEPTED
    assert vehicle.fence.enabled
    assert not vehicle.fence.outside(0.0, 0.0, -20.0)
    assert pilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 0) == mavlink.MAV_RESULT_ACCEPTED
    assert not vehicle.fence.enabled
    pilot.parameter("FENCE_TYPE", 4)
    assert pilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1) == mavlink.MAV_RESULT_FAILED, (
        "the vehicle has no fence polygon"
    )
    upload(pilot, 1, _square(mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, 20.0))
    assert pilot.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1) == mavlink.MAV_RESULT_ACCEPTED
    assert vehicle.fence.enabled


@pytest.mark.parametrize(
    ("item", "inside", "outside"),
    [
        ({"command": 5003, "param1": 15.0}, (10.0, 0.0), (16.0, 0.0)),
        ({"command": 5004, "param1": 5.0, "north": 30.0}, (20.0, 0.0), (30.0, 1.0)),
    ],
)
def test_fence_circle_contains_only_allowed_points(
    item: dict[str, float], inside: tuple[float, float], outside: tuple[float, float]
):
    vehicle, pilot = alone(FENCE_ENABLE=1)
    place = START.offset(item.pop("north", 0.0), 0.0)
    assert upload(pilot, 1, [item | {"frame": 0, "x": place.lat_e7, "y": place.lon_e7}]) == 0
    assert not vehicle.fence.outside(*inside, 10.0)
    assert vehicle.fence.outside(*outside, 10.0)


def test_altitude_fence_and_home_circle_are_breached_outside():
    vehicle, pilot = airborne(20.0, FENCE_ALT_MAX=30, FENCE_RADIUS=50, FENCE_ENABLE=1, FENCE_ACTION=4)
    pilot.go_to(0.0, 0.0, 35.0)
    pilot.go_to(55.0, 0.0, 20.0)
    pilot.fly_on(4.0)
    assert distance_m(vehicle, 0.0, 0.0) < 0.7
    assert vehicle.altitude_m == pytest.approx(20.0, abs=0.5)
    for _ in range(60):
        pilot.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            {"target_system": 1, "target_component": 1, "coordinate_frame": 1, "type_mask": 0xDC7, "vz": -2.0},
        )
        pilot.fly_on(0.2)
    assert vehicle.mode == mavlink.COPTER_MODE_BRAKE
    assert "Max Alt fence breached" in pilot.texts


@pytest.mark.parametrize(
    "items",
    [
        [{"command": 5001, "param1": 4.0}] * 3,
        [{"command": 5001, "param1": 2.0}] * 2,
        [{"command": 5003, "param1": -1.0}],
        [{"command": 16, "param1": 0.0}],
    ],
)
def test_invalid_fence_upload_is_refused_and_keeps_old_fence(items: list[dict[str, float]]):
    vehicle, pilot = alone()
    upload(pilot, 1, _square(mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, 20.0))
    shapes = vehicle.fence.shapes
    assert upload(pilot, 1, [{"frame": 0, "x": START.lat_e7, "y": START.lon_e7} | item for item in items]) != 0
    assert vehicle.fence.shapes == shapes
    assert len(vehicle.fence_items.items) == 4


def test_motor_failure_crashes_vehicle():
    vehicle, pilot = airborne(15.0)
    pilot.parameter("SIM_ENGINE_MUL", 0.0)
    pilot.parameter("SIM_ENGINE_FAIL", 1)
    pilot.wait(lambda: vehicle.body.on_ground, 30.0)
    assert _crashed(vehicle, pilot)


def _crashed(vehicle: VehicleState, pilot: Pilot) -> bool:
    pilot.wait(lambda: not vehicle.armed, 10.0)
    return any(text.startswith("Crash: Disarming") for text in pilot.texts)


def test_low_battery_prevents_arming_and_failsafe_latches_until_reboot():
    vehicle, pilot = airborne(10.0, BATT_LOW_TIMER=1, BATT_FS_LOW_ACT=1)
    pilot.parameter("SIM_BATT_VOLTAGE", 10.3)
    pilot.wait(lambda: not vehicle.armed, 60.0)
    assert "Battery 1 is low 10.30V used" in " ".join(pilot.texts)
    before = len(pilot.texts)
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_FAILED
    assert pilot.texts[before:] == ["Arm: Battery 1 low voltage failsafe", "Arm: Battery failsafe"]
    pilot.parameter("SIM_BATT_VOLTAGE", 12.6)
    pilot.fly_on(1.0)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_FAILED
    assert pilot.texts[-1] == "Arm: Battery failsafe"


def test_mode_change_during_breach_suspends_fence_and_end_of_breach_is_reported():
    vehicle, pilot = airborne(10.0, FENCE_RADIUS=30, FENCE_TYPE=2, AVOID_ENABLE=0, FENCE_ENABLE=1)
    while vehicle.mode == mavlink.COPTER_MODE_GUIDED:
        pilot.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            {"target_system": 1, "target_component": 1, "coordinate_frame": 1, "type_mask": 0xDC7, "vx": 6.0},
        )
        pilot.fly_on(0.2)
    assert pilot.texts[-2:] == ["Circle fence breached", "Manual recovery started"]
    pilot.mode(mavlink.COPTER_MODE_LOITER)
    assert pilot.texts[-1] == "Manual recovery started"
    pilot.mode(mavlink.COPTER_MODE_RTL)
    pilot.wait(lambda: "Fence breach cleared" in pilot.texts, 30.0)
    assert pilot.texts.count("Circle fence breached") == 1


def test_velocity_is_limited_before_fence():
    vehicle, pilot = airborne(10.0, FENCE_RADIUS=30, FENCE_TYPE=2, FENCE_ENABLE=1)
    for _ in range(75):
        pilot.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            {"target_system": 1, "target_component": 1, "coordinate_frame": 1, "type_mask": 0xDC7, "vx": 3.0},
        )
        pilot.fly_on(0.2)
    assert vehicle.mode == mavlink.COPTER_MODE_GUIDED
    assert 26.0 < vehicle.est.north < 30.0
    assert vehicle.fence.limiting


@pytest.mark.parametrize(
    ("limits", "level"),
    [
        ({}, None),
        ({"BATT_LOW_MAH": 300.0}, "low"),
        ({"BATT_CRT_MAH": 300.0}, "critical"),
    ],
)
def test_battery_capacity_failsafe_acts_only_on_a_set_limit(limits: dict[str, float], level: str | None):
    """A limit of 0 disables the check, also when more charge was used than BATT_CAPACITY."""
    vehicle, pilot = airborne(5.0, BATT_CAPACITY=1000, BATT_FS_CRT_ACT=1, BATT_FS_LOW_ACT=1, **limits)
    vehicle.battery.used_mah = 800.0
    pilot.fly_on(0.5)
    if level is None:
        vehicle.battery.used_mah = 1100.0
        pilot.fly_on(0.5)
        assert vehicle.mode == mavlink.COPTER_MODE_GUIDED
        assert not vehicle.failsafes.battery
    else:
        assert vehicle.mode == mavlink.COPTER_MODE_LAND
        assert any(text.startswith(f"Battery 1 is {level}") for text in pilot.texts)


def test_battery_charges_at_depot_until_full_and_ends_failsafe():
    vehicle, pilot = alone(config=replace(CONFIG, charge_percent_per_min=60.0), BATT_LOW_MAH=900.0)
    pilot.fly_on(3.0)
    vehicle.battery.used_mah = 0.8 * vehicle.battery.capacity_mah
    vehicle.failsafes.battery = True
    pilot.fly_on(10.0)
    assert vehicle.battery.percent == 30
    assert not vehicle.failsafes.battery
    pilot.fly_on(80.0)
    assert vehicle.battery.used_mah == 0.0


def test_battery_does_not_charge_away_from_depot_in_the_air_or_without_charger():
    def used_after(north_m: float, rate: float, *, airborne: bool) -> float:
        vehicle, pilot = alone(config=replace(CONFIG, charge_percent_per_min=rate, depot=START.offset(north_m, 0.0)))
        if airborne:
            pilot.take_off(10.0)
        vehicle.battery.used_mah = 1000.0
        pilot.fly_on(10.0)
        return vehicle.battery.used_mah

    assert used_after(15.0, 60.0, airborne=False) < 1000.0
    assert used_after(25.0, 60.0, airborne=False) == 1000.0
    assert used_after(0.0, 0.0, airborne=False) == 1000.0
    assert used_after(0.0, 60.0, airborne=True) > 1000.0


def test_battery_reset_ends_battery_failsafe():
    vehicle, pilot = alone(BATT_LOW_MAH=1000.0)
    pilot.fly_on(3.0)
    vehicle.battery.used_mah = vehicle.battery.capacity_mah
    vehicle.failsafes.battery = vehicle.failsafes.battery_critical = True
    assert pilot.command(mavlink.MAV_CMD_BATTERY_RESET, 1, 10) == mavlink.MAV_RESULT_ACCEPTED
    assert vehicle.failsafes.battery
    assert pilot.command(mavlink.MAV_CMD_BATTERY_RESET, 0xFFFF, 100) == mavlink.MAV_RESULT_ACCEPTED
    assert not vehicle.failsafes.battery
    assert not vehicle.failsafes.battery_critical


def test_depot_stays_at_the_start_after_a_reboot_elsewhere():
    simulation = Simulation([replace(CONFIG, charge_percent_per_min=60.0)])
    craft = simulation.crafts[0]
    pilot = Pilot(simulation, craft)
    craft.vehicle.state.body.north = 100.0
    pilot.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1)
    pilot.fly_on(1.0)
    craft.vehicle.state.battery.used_mah = 1000.0
    pilot.fly_on(10.0)
    assert craft.vehicle.state.start != START
    assert craft.vehicle.state.battery.used_mah == 1000.0
