"""Faults of GPS, compass, barometer and EKF lane: replay of recorded reactions, and injected faults of each sensor."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from fractus_runtime.mavlink_codec import message_id
from fractus_vehicle.state import FULL_START_S, VehicleState
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import CONFIG, START, airborne, alone

RECORD = Path(__file__).parents[1] / "golden" / "vehicle" / "arducopter-4.6.2-position-faults.tsv"
GLITCH_DEG = 0.0003
METRES_PER_DEG = 111_319.0
STEP_S = 0.1
RECORDED_S = {"start": 50.0, "glitch_33_m_for_10_s": 35.0, "gps_lost_for_3_s": 12.0, "gps_lost": 10.0}


@dataclass(frozen=True)
class Row:
    """One recorded value."""

    fault: str
    quantity: str
    time_s: float
    tolerance_s: float
    value: float
    tolerance: float


def rows() -> list[Row]:
    lines = [line.split("\t") for line in RECORD.read_text(encoding="ascii").splitlines() if not line.startswith("#")]
    return [Row(fault, quantity, *map(float, numbers)) for fault, quantity, *numbers in lines]


def request(pilot: Pilot, *names: str) -> None:
    for name in names:
        pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id(name), 100_000)


def quantities(vehicle: VehicleState, pilot: Pilot) -> dict[str, float]:
    """Return the current values of all recorded quantities."""
    truth_n, _, _ = START.vector_to(vehicle.true_place)
    values = {"mode": float(vehicle.mode)}
    if "EKF_STATUS_REPORT" in pilot.last:
        values["ekf_flags"] = pilot.last["EKF_STATUS_REPORT"].integer("flags")
    if vehicle.armed:
        gps = pilot.last["GPS_RAW_INT"]
        values["gps_accuracy_mm"] = gps.integer("h_acc")
        values["gps_offset_m"] = (gps.integer("lat") - START.lat_e7) * 1e-7 * METRES_PER_DEG - truth_n
        reported = pilot.last["GLOBAL_POSITION_INT"]
        values["position_offset_m"] = (reported.integer("lat") - START.lat_e7) * 1e-7 * METRES_PER_DEG - truth_n
    return values


def start(fault: str) -> tuple[VehicleState, Pilot, dict[float, tuple[str, float]]]:
    """Return a vehicle with its pilot, and the parameters that the fault sets at given times."""
    if fault == "start":
        vehicle, pilot = alone(config=replace(CONFIG, ready_after_s=FULL_START_S))
        request(pilot, "EKF_STATUS_REPORT")
        return vehicle, pilot, {}
    vehicle, pilot = airborne(15.0)
    request(pilot, "EKF_STATUS_REPORT", "GPS_RAW_INT", "GLOBAL_POSITION_INT")
    pilot.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 6, -1)
    pilot.go_to(0.0, 300.0, 15.0)
    pilot.fly_on(4.0)
    glitch = {0.0: ("SIM_GPS_GLITCH_X", GLITCH_DEG), 10.0: ("SIM_GPS_GLITCH_X", 0.0)}
    lost = {0.0: ("SIM_GPS_DISABLE", 1.0)}
    faults = {
        "glitch_33_m_for_10_s": glitch,
        "gps_lost_for_3_s": lost | {3.0: ("SIM_GPS_DISABLE", 0.0)},
        "gps_lost": lost,
    }
    return vehicle, pilot, faults[fault]


@pytest.mark.parametrize("fault", sorted({row.fault for row in rows()}))
def test_vehicle_reacts_to_fault_as_recorded(fault: str) -> None:
    vehicle, pilot, changes = start(fault)
    began_s = 0.0 if fault == "start" else vehicle.time_s
    series: list[tuple[float, dict[str, float]]] = []
    while vehicle.time_s - began_s < RECORDED_S[fault]:
        for at_s in [at_s for at_s in changes if at_s <= vehicle.time_s - began_s]:
            vehicle.params.assign(*changes.pop(at_s))
        pilot.fly_on(STEP_S)
        series.append((vehicle.time_s - began_s, quantities(vehicle, pilot)))
    for quantity, group in itertools.groupby((row for row in rows() if row.fault == fault), lambda row: row.quantity):
        expected = list(group)
        for row, following in itertools.zip_longest(expected, expected[1:]):
            if math.isnan(row.value):
                continue
            until_s = following.time_s - following.tolerance_s if following is not None else RECORDED_S[fault]
            kept = [values for at_s, values in series if row.time_s + row.tolerance_s + STEP_S <= at_s < until_s]
            assert kept
            wrong = [values[quantity] for values in kept if abs(values[quantity] - row.value) > row.tolerance]
            assert not wrong, f"{quantity} must be {row.value} from {row.time_s} s to {until_s} s"


def changed(vehicle: VehicleState, pilot: Pilot, condition: Callable[[], bool], timeout_s: float = 20.0) -> float:
    """Return the seconds until a condition holds."""
    began_s = vehicle.time_s
    pilot.wait(condition, timeout_s)
    return vehicle.time_s - began_s


def variance(pilot: Pilot, name: str) -> float:
    return pilot.expect("EKF_STATUS_REPORT").real(f"{name}_variance")


def test_second_gps_is_reported_only_if_vehicle_has_one() -> None:
    _, pilot = airborne(10.0)
    request(pilot, "GPS_RAW_INT", "GPS2_RAW")
    pilot.fly_on(1.0)
    assert "GPS2_RAW" not in pilot.last
    pilot.parameter("SIM_GPS2_DISABLE", 0)
    pilot.parameter("GPS2_TYPE", 1)
    pilot.parameter("SIM_GPS2_GLTCH_X", GLITCH_DEG)
    pilot.parameter("SIM_GPS2_ACC", 1.2)
    pilot.fly_on(1.0)
    first = pilot.expect("GPS_RAW_INT")
    second = pilot.expect("GPS2_RAW")
    assert second.integer("lat") - first.integer("lat") == pytest.approx(3000, abs=60)
    assert second.integer("h_acc") == 1200


TWO = {"SIM_GPS2_DISABLE": 0, "GPS2_TYPE": 1}


@pytest.mark.parametrize(
    ("switch", "primary", "share"),
    [(0, 0, 0.0), (0, 1, 1.0), (1, 0, 0.0), (2, 0, 0.5), (4, 0, 0.0), (4, 1, 1.0)],
)
def test_estimate_follows_receivers_that_are_selected(switch: int, primary: int, share: float) -> None:
    vehicle, pilot = airborne(10.0, **TWO, GPS_AUTO_SWITCH=switch, GPS_PRIMARY=primary)
    pilot.parameter("SIM_GPS2_GLTCH_X", 4.0 / METRES_PER_DEG)
    pilot.fly_on(10.0)
    assert vehicle.est.north - vehicle.body.north == pytest.approx(4.0 * share, abs=0.4)


@pytest.mark.parametrize(("switch", "switches"), [(0, False), (1, True), (2, True), (4, True)])
def test_second_gps_replaces_lost_first_one(switch: int, switches: bool) -> None:
    vehicle, pilot = airborne(10.0, **TWO, GPS_AUTO_SWITCH=switch)
    pilot.parameter("SIM_GPS_DISABLE", 1)
    pilot.fly_on(12.0)
    assert vehicle.position_ok is switches


def test_receiver_with_two_more_satellites_is_used() -> None:
    vehicle, pilot = airborne(10.0, **TWO, SIM_GPS2_GLTCH_X=4.0 / METRES_PER_DEG)
    pilot.parameter("SIM_GPS2_NUMSATS", 12)
    pilot.fly_on(10.0)
    assert vehicle.est.north - vehicle.body.north == pytest.approx(4.0, abs=0.4)


def send_gps_input(pilot: Pilot, north_m: float) -> None:
    place = START.offset(north_m, 0.0, -10.0)
    values = {"fix_type": 3, "lat": place.lat_e7, "lon": place.lon_e7, "alt": place.alt_m, "satellites_visible": 10}
    pilot.send("GPS_INPUT", values | {"horiz_accuracy": 0.4})


@pytest.mark.parametrize(("kind", "followed"), [(1, False), (14, True)])
def test_gps_input_of_another_station_is_used_only_by_receiver_of_that_type(kind: int, followed: bool) -> None:
    vehicle, pilot = airborne(10.0)
    request(pilot, "GPS_RAW_INT")
    vehicle.params.assign("GPS1_TYPE", kind)
    for _ in range(50):
        send_gps_input(pilot, 4.0)
        pilot.fly_on(0.2)
    assert (abs(pilot.expect("GPS_RAW_INT").integer("lat") - START.offset(4.0, 0.0).lat_e7) < 5) is followed
    assert (vehicle.est.north - vehicle.body.north > 1.0) is followed


def test_gps_of_input_type_is_lost_when_inputs_end() -> None:
    vehicle, pilot = airborne(10.0)
    vehicle.params.assign("GPS1_TYPE", 14)
    send_gps_input(pilot, 0.0)
    pilot.fly_on(1.0)
    assert vehicle.gps.fix_type == 3
    pilot.fly_on(5.0)
    assert vehicle.gps.fix_type < 3


def test_large_barometer_error_is_rejected_for_ten_seconds_and_then_accepted() -> None:
    vehicle, pilot = airborne(20.0)
    request(pilot, "EKF_STATUS_REPORT")
    pilot.parameter("SIM_BARO_GLITCH", 20.0)
    pilot.fly_on(0.5)
    assert variance(pilot, "pos_vert") > 1.0
    assert -vehicle.est.down == pytest.approx(20.0, abs=1.0)
    assert changed(vehicle, pilot, lambda: -vehicle.est.down > 35.0) == pytest.approx(9.5, abs=0.5)
    assert -vehicle.body.down == pytest.approx(20.0, abs=1.5)
    pilot.fly_on(0.5)
    assert variance(pilot, "pos_vert") < 0.1
    pilot.fly_on(20.0)
    assert -vehicle.body.down < 5.0, "the autopilot returns to its altitude on the wrong estimate"


@pytest.mark.parametrize(("name", "value"), [("SIM_BARO_GLITCH", 6.0), ("SIM_BARO_DRIFT", 0.2)])
def test_small_barometer_error_is_followed_without_large_variance(name: str, value: float) -> None:
    vehicle, pilot = airborne(20.0)
    request(pilot, "EKF_STATUS_REPORT")
    pilot.parameter(name, value)
    pilot.fly_on(30.0)
    assert variance(pilot, "pos_vert") < 0.7
    assert -vehicle.body.down == pytest.approx(14.0, abs=1.5)


def test_disabled_barometer_is_replaced() -> None:
    vehicle, pilot = airborne(20.0)
    pilot.parameter("SIM_BARO_GLITCH", 6.0)
    pilot.parameter("SIM_BARO_DISABLE", 1.0)
    pilot.fly_on(20.0)
    assert -vehicle.body.down == pytest.approx(20.0, abs=1.0)


def test_wrong_compass_raises_variance_until_next_one_is_used() -> None:
    vehicle, pilot = airborne(10.0)
    request(pilot, "EKF_STATUS_REPORT")
    pilot.parameter("SIM_MAG1_OFS_X", 400.0)
    pilot.fly_on(2.0)
    assert variance(pilot, "compass") > 1.0
    waited_s = changed(vehicle, pilot, lambda: "EKF3 IMU0 switching to compass 1" in pilot.texts)
    assert waited_s == pytest.approx(8.0, abs=1.0)
    pilot.fly_on(5.0)
    assert variance(pilot, "compass") < 0.1
    assert vehicle.mode == mavlink.COPTER_MODE_GUIDED


def test_failed_compass_is_replaced_at_once() -> None:
    _, pilot = airborne(10.0)
    request(pilot, "EKF_STATUS_REPORT")
    pilot.parameter("SIM_MAG1_FAIL", 1)
    pilot.fly_on(0.5)
    assert "EKF3 IMU0 switching to compass 1" in pilot.texts
    assert variance(pilot, "compass") < 0.1
    pilot.parameter("SIM_MAG2_FAIL", 1)
    pilot.fly_on(0.5)
    assert "EKF3 IMU0 switching to compass 2" in pilot.texts


@pytest.mark.parametrize("name", ["SIM_ACC_FAIL_MSK", "SIM_GYR_FAIL_MSK"])
def test_failed_imu_switches_lane(name: str) -> None:
    _, pilot = airborne(10.0)
    pilot.parameter(name, 1)
    pilot.fly_on(0.5)
    assert [text for text in pilot.texts if "lane" in text or "primary" in text] == [
        "EKF3 lane switch 1",
        "EKF primary changed:1",
    ]
    pilot.parameter(name, 3)
    pilot.fly_on(1.0)
    assert pilot.texts.count("EKF3 lane switch 0") == 0, "no lane is left"
