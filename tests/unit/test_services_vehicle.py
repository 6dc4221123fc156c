"""Vehicle state from telemetry: airborne or landed, readiness, position and recorded path."""

from __future__ import annotations

import pytest
from fractus_runtime.mavlink_codec import Message, message
from fractus_services.mobility.autopilot import StatusText
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.vehicle import Vehicle
from pymavlink.dialects.v20 import ardupilotmega as mavlink


@pytest.mark.parametrize(
    ("landed_state", "landed_at", "altitude_m", "flies"),
    [(2, 10.0, 0.0, True), (1, 10.0, 0.2, False), (1, 10.0, 3.0, True), (1, 5.0, 1.0, True), (1, 5.0, 0.1, False),
     (3, 5.0, 0.1, True), (0, float("-inf"), 1.0, True)],
)  # fmt: skip
def test_vehicle_counts_as_airborne_if_landed_state_is_uncertain(
    landed_state: int, landed_at: float, altitude_m: float, flies: bool
) -> None:
    vehicle = Vehicle(
        stack=ARDUCOPTER, armed=True, heartbeat_at=10.0, position_at=10.0, landed_state=landed_state, landed_at=landed_at,
        altitude_m=altitude_m,
    )  # fmt: skip
    assert vehicle.in_air is flies
    vehicle.armed = False
    assert not vehicle.in_air


def test_armed_vehicle_without_position_counts_as_airborne() -> None:
    assert Vehicle(stack=ARDUCOPTER, armed=True, heartbeat_at=10.0).in_air


@pytest.mark.parametrize(("vx", "forward_mps2"), [((100, 12), 2.4), ((600, -10), -2.0), ((300, 0), 0.0)])
def test_forward_acceleration_is_derived_from_velocities(vx: tuple[int, int], forward_mps2: float) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER, located=True, gps_at=0.0, estimated=True, estimated_at=0.0)
    assert vehicle.forward_mps2 is None
    for i in range(12):
        position = message("GLOBAL_POSITION_INT", time_boot_ms=i * 50, lat=1, lon=1, vx=vx[0] + i * vx[1])
        vehicle.take(position, i * 0.05)
    assert vehicle.forward_mps2 == pytest.approx(forward_mps2, abs=0.01)
    assert len(vehicle.velocity_history) < 10, "old velocities are removed"


@pytest.mark.parametrize(
    ("unplaced_s", "with_text", "path_lost"),
    [(11, True, False), (14, True, True), (11, False, False), (14, False, True)],
)
def test_smart_rtl_path_is_lost_with_position_even_without_statustext(
    unplaced_s: int, with_text: bool, path_lost: bool
) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER, armed=True, positioned_at=0.0)
    for at in range(1, unplaced_s):
        if with_text:
            vehicle.take(message("EKF_STATUS_REPORT", flags=BOOTED), float(at))
    vehicle.take(message("EKF_STATUS_REPORT", flags=POSITIONED), float(unplaced_s))
    assert vehicle.path_lost is path_lost
    for at in (20.0, 21.0):
        vehicle.take(message("HEARTBEAT"), at)
    assert not vehicle.path_lost, "the next flight records a new path"


def test_landed_vehicle_without_position_keeps_smart_rtl_path() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    for at in range(40):
        vehicle.take(message("EKF_STATUS_REPORT", flags=BOOTED), float(at))
    vehicle.take(message("EKF_STATUS_REPORT", flags=POSITIONED), 41.0)
    vehicle.armed = True
    vehicle.take(message("EKF_STATUS_REPORT", flags=POSITIONED), 42.0)
    assert not vehicle.path_lost


@pytest.mark.parametrize("silent", ["EKF_STATUS_REPORT", "GPS_RAW_INT"])
def test_position_becomes_unknown_when_its_quality_is_no_longer_reported(silent: str) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    for tenth in range(300):
        now = tenth / 10
        for received in (message("EKF_STATUS_REPORT", flags=POSITIONED), message("GPS_RAW_INT", fix_type=3, h_acc=800)):
            if now < 10.0 or received.name != silent:
                vehicle.take(received, now)
        vehicle.take(message("GLOBAL_POSITION_INT", lat=393600000, lon=229500000), now)
        if not 19.5 < now < 21.0:
            assert vehicle.position_fresh(now) is (now < 20.0)
    vehicle.take(message("EKF_STATUS_REPORT", flags=POSITIONED), 30.0)
    vehicle.take(message("GPS_RAW_INT", fix_type=3, h_acc=800), 30.0)
    vehicle.take(message("GLOBAL_POSITION_INT", lat=393600000, lon=229500000), 30.0)
    assert vehicle.position_fresh(30.0)


HEALTHY = {"onboard_control_sensors_present": 1 << 28, "onboard_control_sensors_health": 1 << 28}
BOOTED = 167
POSITIONED = 831
"""EKF_STATUS_REPORT flags of a real ArduCopter, 22 s (BOOTED) and 41 s (POSITIONED) after its start."""


def test_readiness_depends_on_requirements_of_the_arming_mode() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    assert "SYS_STATUS" in vehicle.arming_refusal(30.0)
    vehicle.take(message("SYS_STATUS"), 30.0)
    vehicle.ready = False
    vehicle.take(message("STATUSTEXT", severity=2, text=b"PreArm: AHRS: waiting for home"), 30.0)
    assert vehicle.arming_refusal(30.0) == "PreArm: AHRS: waiting for home"
    vehicle.take(message("SYS_STATUS"), 71.0)
    vehicle.ready = False
    assert vehicle.arming_refusal(71.0) == "its pre-arm checks fail", "the text is too old"
    vehicle.take(message("SYS_STATUS", **HEALTHY), 31.0)
    assert "EKF_STATUS_REPORT" in vehicle.arming_refusal(31.0), "a vehicle without EKF_STATUS_REPORT is not ready"
    vehicle.take(message("EKF_STATUS_REPORT", flags=BOOTED), 31.0)
    vehicle.take(message("HOME_POSITION", latitude=393600000, longitude=229500000), 31.0)
    assert "position estimate is not accurate" in vehicle.arming_refusal(31.0), (
        "SYS_STATUS reports passed checks, because STABILIZE needs no position"
    )
    for flags in (POSITIONED & ~16, POSITIONED & ~512):
        vehicle.take(message("EKF_STATUS_REPORT", flags=flags), 32.0)
        assert vehicle.arming_refusal(32.0)
    vehicle.take(message("EKF_STATUS_REPORT", flags=POSITIONED), 33.0)
    assert vehicle.arming_refusal(33.0) == ""
    vehicle.home = None
    assert "home" in vehicle.arming_refusal(33.0)


@pytest.mark.parametrize("silent", ["SYS_STATUS", "EKF_STATUS_REPORT"])
def test_stale_reports_make_vehicle_not_ready(silent: str) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    vehicle.take(message("HOME_POSITION", latitude=393600000, longitude=229500000), 31.0)
    for now in (31.0, 39.0):
        for received in (message("SYS_STATUS", **HEALTHY), message("EKF_STATUS_REPORT", flags=POSITIONED)):
            if now == 31.0 or received.name != silent:
                vehicle.take(received, now)
        assert (silent in vehicle.arming_refusal(now)) is (now > 31.0)


def test_home_of_zeros_is_unknown() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    vehicle.take(message("HOME_POSITION"), 1.0)
    assert vehicle.home is None


def test_vehicle_reports_satellites_wind_and_statustexts() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    vehicle.take(message("GPS_RAW_INT", fix_type=3, satellites_visible=14), 1.0)
    assert vehicle.satellites == 14
    vehicle.take(message("GPS_RAW_INT", fix_type=3, satellites_visible=255), 2.0)
    assert vehicle.satellites == 0, "the value 255 means unknown"
    vehicle.take(message("WIND", direction=-90.0, speed=6.0), 3.0)
    assert (vehicle.wind_from_deg, vehicle.wind_mps, vehicle.wind_at) == (270.0, 6.0, 3.0)
    vehicle.take(message("WIND", direction=float("nan"), speed=6.0), 4.0)
    assert vehicle.wind_at == 3.0
    for number in range(60):
        vehicle.take(message("STATUSTEXT", severity=4, text=f"text {number}".encode()), 5.0)
    assert len(vehicle.status_texts) == 50
    assert vehicle.status_texts[-1] == StatusText(60, 5.0, 4, "text 59")


@pytest.mark.parametrize(("flags", "path_lost"), [(POSITIONED, False), (BOOTED, True)])
def test_smart_rtl_path_survives_service_restart_if_position_is_known(flags: int, path_lost: bool) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    vehicle.take(message("HEARTBEAT", base_mode=mavlink.MAV_MODE_FLAG_SAFETY_ARMED), 100.0)
    vehicle.take(message("EKF_STATUS_REPORT", flags=flags), 100.5)
    vehicle.take(message("EKF_STATUS_REPORT", flags=POSITIONED), 101.5)
    assert vehicle.path_lost is path_lost
    vehicle.take(message("EKF_STATUS_REPORT", flags=POSITIONED), 115.0)
    assert vehicle.path_lost, "after a long silence, the path counts as lost"


def heartbeat(*, armed: bool, mode: int = mavlink.COPTER_MODE_GUIDED) -> Message:
    flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    return message(
        "HEARTBEAT", type=mavlink.MAV_TYPE_QUADROTOR, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, base_mode=flags, custom_mode=mode,
    )  # fmt: skip


@pytest.mark.parametrize("gap_s", [1.0, 8.0])
@pytest.mark.parametrize(
    ("landed_state", "altitude_m", "mode", "in_air"),
    [
        pytest.param(mavlink.MAV_LANDED_STATE_IN_AIR, 20.0, mavlink.COPTER_MODE_STABILIZE, True, id="restart"),
        pytest.param(mavlink.MAV_LANDED_STATE_ON_GROUND, 0.1, mavlink.COPTER_MODE_GUIDED, False, id="landed"),
        pytest.param(mavlink.MAV_LANDED_STATE_LANDING, 5.0, mavlink.COPTER_MODE_LAND, False, id="landed-on-a-hill"),
        pytest.param(
            mavlink.MAV_LANDED_STATE_IN_AIR, 20.0, mavlink.COPTER_MODE_RTL, False, id="returned-while-link-was-cut"
        ),
    ],
)
def test_vehicle_whose_motors_stop_in_flight_has_not_landed(
    landed_state: int, altitude_m: float, mode: int, in_air: bool, gap_s: float
) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    vehicle.take(heartbeat(armed=True), 10.0)
    assert not vehicle.stopped_in_air
    vehicle.altitude_m = altitude_m
    vehicle.landed_state = landed_state
    for i in range(2):
        vehicle.take(heartbeat(armed=False, mode=mode), 10.0 + gap_s + i)
    assert not vehicle.armed
    assert vehicle.stopped_in_air == in_air
    vehicle.take(heartbeat(armed=True), 30.0)
    assert not vehicle.stopped_in_air
