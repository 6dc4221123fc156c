"""Signs of a wrong position: the vehicle's position becomes unknown, and known again after a quiet time."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest
from fractus_core.geo import LocalFrame
from fractus_runtime.mavlink_codec import message
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.expected_position import EXPECTED_POSITION_FILE, ExpectedPositionFile
from fractus_services.mobility.mavlink.position_checks import QUIET_S
from fractus_services.mobility.mavlink.vehicle import Vehicle

READY = 831
GLITCHING = 33599
"""Flags of EKF_STATUS_REPORT of a real ArduCopter in flight, without and with a GPS glitch."""

FRAME = LocalFrame(39.36, 22.95)


class Flight:
    """Messages of a flying vehicle: positions at 20 Hz, estimator at 1 Hz, GPS at 2 Hz."""

    def __init__(self, *, armed: bool = True) -> None:
        self.vehicle = Vehicle(stack=ARDUCOPTER, armed=armed, landed_state=2, landed_at=0.0)
        self.tick = 0
        self.flags = READY
        self.variances: dict[str, float] = {}
        self.north_m = 0.0
        self.north_mps = 0.0
        self.amsl_m = 100.0
        self.gps_error_m = 0.0
        self.gps_accuracy_m = 0.5
        self.fixes = 0
        self.boot_s = 100.0
        self.send(2.0)

    @property
    def now(self) -> float:
        return self.tick / 20

    @property
    def known(self) -> bool:
        return self.vehicle.position_fresh(self.now)

    def position(self) -> None:
        lat, lon = FRAME.latlon(0.0, self.north_m)
        place = {"lat": round(lat * 1e7), "lon": round(lon * 1e7), "alt": round(self.amsl_m * 1e3)}
        clock = {"time_boot_ms": round((self.boot_s + self.now) * 1e3)}
        self.vehicle.take(message("GLOBAL_POSITION_INT", **place, **clock, vx=round(self.north_mps * 100)), self.now)

    def status(self) -> None:
        self.vehicle.take(message("EKF_STATUS_REPORT", flags=self.flags, **self.variances), self.now)

    def gps(self, name: str = "GPS_RAW_INT", *, repeated: bool = False, fix_type: int = 3) -> None:
        """Send a GPS position, of the same fix as the last one if `repeated` is True."""
        lat, lon = FRAME.latlon(0.0, self.north_m + self.gps_error_m)
        place = {"lat": round(lat * 1e7), "lon": round(lon * 1e7)}
        if not repeated:
            self.fixes += 1
        accuracy_mm = round(self.gps_accuracy_m * 1e3)
        fix = message(name, fix_type=fix_type, time_usec=self.fixes * 200_000, h_acc=accuracy_mm, **place)
        self.vehicle.take(fix, self.now)

    def restart_service(self, directory: Path) -> None:
        """Replace the service by one that knows only what the former one stored."""

        async def store() -> None:
            file = ExpectedPositionFile(directory / EXPECTED_POSITION_FILE)
            if not self.vehicle.position_checks.blind:
                file.keep(self.vehicle.position_checks.expected)
            if file._storing is not None:
                await file._storing

        asyncio.run(store())
        armed = self.vehicle.armed
        self.vehicle = Vehicle(stack=ARDUCOPTER, armed=armed, landed_state=2, landed_at=self.now)
        ExpectedPositionFile(directory / EXPECTED_POSITION_FILE).apply_to(self.vehicle.position_checks)

    def send(self, duration_s: float, *, lost: bool = False) -> None:
        """Fly on for a duration. If the messages are lost, none of them arrives."""
        for _ in range(round(duration_s * 20)):
            self.tick += 1
            self.north_m += self.north_mps / 20
            if lost:
                continue
            if self.tick % 20 == 1:
                self.status()
            if self.tick % 10 == 1:
                self.gps()
            self.position()


def test_position_is_unknown_while_autopilot_reports_gps_glitch_and_until_quiet_time_has_passed() -> None:
    flight = Flight()
    assert flight.known
    flight.flags = GLITCHING
    flight.status()
    assert not flight.known
    assert "GPS glitch" in flight.vehicle.position_problem
    flight.send(29.0)
    flight.flags = READY
    flight.status()
    flight.send(QUIET_S - 0.1)
    assert not flight.known
    flight.send(0.2)
    assert flight.known


@pytest.mark.parametrize("name", ["velocity", "pos_horiz", "pos_vert", "compass"])
@pytest.mark.parametrize("value", [0.8, 1.2, math.nan, math.inf])
def test_position_is_unknown_if_variance_reaches_failsafe_threshold(name: str, value: float) -> None:
    flight = Flight()
    flight.variances = {f"{name}_variance": 0.79}
    flight.status()
    assert flight.known
    flight.variances = {f"{name}_variance": value}
    flight.status()
    assert not flight.known
    assert "FS_EKF_THRESH" in flight.vehicle.position_problem


@pytest.mark.parametrize(
    ("threshold", "known"), [(0.5, False), (0.9, True), (0.0, True), (5.0, True), (math.nan, True)]
)
def test_variance_limit_is_threshold_of_vehicle_if_its_failsafe_is_on(threshold: float, known: bool) -> None:
    flight = Flight()
    flight.vehicle.take(message("PARAM_VALUE", param_id=b"FS_EKF_THRESH", param_value=threshold), flight.now)
    flight.variances = {"pos_horiz_variance": 0.7}
    flight.status()
    assert flight.known is known
    flight.variances = {"pos_horiz_variance": 1.0}
    flight.status()
    assert not flight.known


@pytest.mark.parametrize("speed_mps", [0.0, 8.0])
def test_position_is_unknown_at_first_sample_after_jump(speed_mps: float) -> None:
    flight = Flight()
    flight.north_mps = speed_mps
    flight.send(2.0)
    assert flight.known
    flight.north_m += 33.0
    flight.send(0.05)
    assert not flight.known
    assert "33 m" in flight.vehicle.position_problem


def test_position_stays_unknown_until_it_has_jumped_back() -> None:
    flight = Flight()
    flight.north_m += 33.0
    flight.send(30.0)
    assert not flight.known
    assert "33 m from the expected position" in flight.vehicle.position_problem
    flight.north_m -= 33.0
    flight.send(QUIET_S - 0.1)
    assert not flight.known
    flight.send(0.3)
    assert flight.known


def test_position_stays_unknown_if_it_jumped_while_link_was_lost_during_glitch() -> None:
    flight = Flight()
    flight.flags = GLITCHING
    flight.send(1.0)
    flight.north_m += 33.0
    flight.send(8.0, lost=True)
    flight.flags = READY
    flight.send(10.0)
    assert not flight.known


def test_position_stays_unknown_after_landing_at_place_to_which_it_jumped_until_vehicle_restarts() -> None:
    flight = Flight()
    flight.north_m += 33.0
    flight.send(10.0)
    flight.vehicle.armed = False
    flight.send(600.0)
    assert not flight.known
    assert "33 m from the expected position" in flight.vehicle.position_problem
    flight.boot_s = -flight.now
    flight.send(QUIET_S + 0.5)
    assert flight.known


def test_position_is_known_after_landing_if_it_returns_on_ground() -> None:
    flight = Flight()
    flight.north_m += 33.0
    flight.send(10.0)
    flight.vehicle.armed = False
    flight.send(10.0, lost=True)
    flight.north_m -= 33.0
    flight.send(QUIET_S + 0.5)
    assert flight.known


def test_position_stays_unknown_if_it_jumps_on_ground_during_glitch_that_began_in_flight() -> None:
    flight = Flight()
    flight.flags = GLITCHING
    flight.send(5.0)
    flight.vehicle.armed = False
    flight.send(5.0)
    flight.north_m += 33.0
    flight.flags = READY
    flight.send(10.0)
    assert not flight.known


@pytest.mark.parametrize("armed", [True, False])
def test_position_stays_unknown_after_restart_of_service_until_it_has_jumped_back(tmp_path: Path, armed: bool) -> None:
    flight = Flight()
    flight.north_m += 33.0
    flight.send(1.0)
    flight.vehicle.armed = armed
    flight.send(1.0)
    flight.restart_service(tmp_path)
    flight.send(4.0, lost=True)
    flight.send(60.0)
    assert not flight.known
    assert "33 m from the expected position" in flight.vehicle.position_problem
    flight.restart_service(tmp_path)
    flight.north_m -= 33.0
    flight.send(QUIET_S + 1.5)
    assert flight.known
    flight.restart_service(tmp_path)
    assert not (tmp_path / EXPECTED_POSITION_FILE).exists()


def test_position_that_jumps_during_restart_of_service_in_glitch_is_unknown(tmp_path: Path) -> None:
    flight = Flight()
    flight.flags = GLITCHING
    flight.send(2.0)
    flight.restart_service(tmp_path)
    flight.north_m += 33.0
    flight.flags = READY
    flight.send(4.0, lost=True)
    flight.send(QUIET_S + 5.0)
    assert not flight.known


def test_restart_of_vehicle_after_restart_of_service_makes_position_known(tmp_path: Path) -> None:
    flight = Flight()
    flight.north_m += 33.0
    flight.send(1.0)
    flight.vehicle.armed = False
    flight.restart_service(tmp_path)
    flight.boot_s = -flight.now
    flight.send(QUIET_S + 1.5)
    assert flight.known


def make_unreadable(path: Path, content: str) -> None:
    if content == "directory":
        path.mkdir()
    else:
        path.write_text(content)


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"position": {"boot_s": NaN}}', '{"position": {"lat": "here"}}', "directory"]
)
@pytest.mark.parametrize("armed", [True, False])
def test_position_stays_unknown_after_unreadable_record_until_vehicle_restarts(
    tmp_path: Path, content: str, armed: bool, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / EXPECTED_POSITION_FILE
    make_unreadable(path, content)
    flight = Flight(armed=armed)
    ExpectedPositionFile(path).apply_to(flight.vehicle.position_checks)
    assert "no position is trusted until the autopilot restarts" in caplog.text
    flight.send(1.0)
    flight.flags = GLITCHING
    flight.send(2.0)
    flight.flags = READY
    flight.send(60.0)
    assert not flight.known
    assert str(path) in flight.vehicle.position_problem
    assert path.exists()
    flight.vehicle.armed = False
    flight.boot_s = -flight.now
    flight.send(QUIET_S + 0.5)
    assert flight.known


def test_unreadable_record_is_removed_after_restart_of_vehicle(tmp_path: Path) -> None:
    path = tmp_path / EXPECTED_POSITION_FILE
    path.write_text("{")
    flight = Flight(armed=False)
    flight.restart_service(tmp_path)
    assert not flight.vehicle.position_checks.blind
    path.write_text("{")
    ExpectedPositionFile(path).apply_to(flight.vehicle.position_checks)
    flight.send(1.0)
    flight.boot_s = -flight.now
    flight.send(QUIET_S + 0.5)
    flight.restart_service(tmp_path)
    assert not path.exists()


@pytest.mark.parametrize(("silent_s", "known"), [(30.0, False), (200.0, True)])
def test_restart_of_vehicle_during_interruption_is_noticed_although_its_clock_reads_more(
    silent_s: float, known: bool
) -> None:
    flight = Flight()
    flight.boot_s = 10.0
    flight.send(0.1)
    flight.north_m += 33.0
    flight.send(1.0)
    flight.vehicle.armed = False
    flight.send(1.0)
    boot_s = flight.boot_s + flight.now
    flight.send(silent_s, lost=True)
    if known:
        flight.boot_s = boot_s + 20.0 - flight.now
    flight.send(QUIET_S + 1.5)
    assert flight.known is known


def test_expected_position_is_stored_once_while_vehicle_hovers(tmp_path: Path) -> None:
    async def work() -> None:
        file = ExpectedPositionFile(tmp_path / EXPECTED_POSITION_FILE)
        flight = Flight()
        flight.north_m += 33.0
        flight.send(0.5)
        file.keep(flight.vehicle.position_checks.expected)
        first = file._storing
        assert first is not None
        await first
        flight.send(1.0)
        file.keep(flight.vehicle.position_checks.expected)
        assert file._storing is first
        flight.north_mps = 3.0
        flight.send(1.0)
        file.keep(flight.vehicle.position_checks.expected)
        assert file._storing is not first
        assert file._storing is not None
        await file._storing

    asyncio.run(work())


@pytest.mark.parametrize("lost_s", [1.5, 3.0, 8.0])
def test_position_is_unknown_after_interruption_until_estimator_reports(lost_s: float) -> None:
    flight = Flight()
    flight.send(lost_s, lost=True)
    for _ in range(10):
        flight.tick += 1
        flight.gps()
        flight.position()
        assert not flight.known
    flight.status()
    flight.position()
    flight.tick += 1
    flight.position()
    assert flight.known


def test_report_without_position_does_not_hide_glitch() -> None:
    flight = Flight()
    flight.flags = GLITCHING & ~READY
    flight.status()
    flight.flags = READY
    flight.status()
    flight.send(QUIET_S - 0.1)
    assert not flight.known


def test_report_without_position_does_not_end_glitch() -> None:
    flight = Flight()
    flight.flags = GLITCHING
    flight.status()
    flight.flags = 167
    flight.send(10.0)
    flight.flags = READY
    flight.status()
    flight.send(QUIET_S - 0.1)
    assert not flight.known
    flight.send(1.0)
    assert flight.known


def test_flight_during_interruption_is_no_lasting_displacement() -> None:
    flight = Flight()
    flight.flags = GLITCHING
    flight.send(1.0)
    flight.north_m += 40.0  # It accelerated, flew and stopped again.
    flight.send(12.0, lost=True)
    flight.flags = READY
    flight.send(QUIET_S + 1.5)
    assert flight.known


def test_glitch_reported_first_after_long_interruption_is_no_displacement() -> None:
    flight = Flight()
    flight.north_m += 300.0
    flight.send(60.0, lost=True)
    flight.flags = GLITCHING
    flight.status()
    flight.send(5.0)
    flight.flags = READY
    flight.send(QUIET_S + 1.5)
    assert flight.known


@pytest.mark.parametrize(("pace", "known"), [(1.0, False), (4.0, True)])
def test_quiet_time_is_measured_on_clock_of_vehicle(pace: float, known: bool) -> None:
    flight = Flight()
    flight.vehicle.position_checks.pace = pace
    flight.flags = GLITCHING
    flight.status()
    flight.flags = READY
    flight.status()
    flight.send(QUIET_S / 4 + 0.2)
    assert flight.known is known


def test_altitude_jump_makes_position_unknown() -> None:
    flight = Flight()
    flight.amsl_m += 10.0
    flight.send(0.05)
    assert not flight.known
    assert "altitude is 10 m from the expected altitude" in flight.vehicle.position_problem


@pytest.mark.parametrize("lost_s", [0.05, 0.5, 1.0, 10.0])
@pytest.mark.parametrize("speed_mps", [0.0, 8.0, 20.0])
def test_fast_flight_with_lost_messages_is_no_jump(lost_s: float, speed_mps: float) -> None:
    flight = Flight()
    flight.north_mps = speed_mps
    flight.send(1.0)
    flight.send(lost_s, lost=True)
    flight.send(0.1)
    assert flight.known


def test_acceleration_during_lost_messages_is_no_jump() -> None:
    flight = Flight()
    flight.north_m += 0.5 * 2.5 * 3.0**2
    flight.send(3.0, lost=True)
    flight.north_mps = 7.5
    flight.send(0.1)
    assert flight.known


def test_repeated_position_is_no_jump_and_does_not_hide_one() -> None:
    flight = Flight()
    for _ in range(3):
        flight.position()
    assert flight.known
    flight.north_m += 33.0
    flight.position()
    flight.send(0.05)
    assert not flight.known


def test_restarted_clock_of_vehicle_is_no_jump() -> None:
    flight = Flight()
    flight.boot_s = -flight.now
    flight.north_m += 33.0
    flight.send(0.5)
    assert flight.known


def test_altitude_stays_unknown_until_it_has_jumped_back() -> None:
    flight = Flight()
    flight.amsl_m += 20.0
    flight.send(2 * QUIET_S)
    assert not flight.known
    assert "altitude" in flight.vehicle.position_problem
    flight.amsl_m -= 20.0
    flight.send(QUIET_S + 1.0)
    assert flight.known


def test_signs_that_recur_soon_belong_to_one_problem() -> None:
    flight = Flight()
    flight.flags = GLITCHING
    flight.send(1.0)
    began_s = flight.vehicle.position_problem_at
    for _ in range(3):
        flight.flags = READY
        flight.send(QUIET_S + 3.0)
        assert flight.known
        flight.flags = GLITCHING
        flight.send(2.0)
        assert flight.vehicle.position_problem
        assert flight.vehicle.position_problem_at == began_s
    flight.flags = READY
    flight.send(QUIET_S + 40.0)
    flight.flags = GLITCHING
    flight.send(2.0)
    assert flight.vehicle.position_problem_at > began_s


def test_correction_of_position_on_ground_is_no_jump() -> None:
    flight = Flight(armed=False)
    flight.north_m += 33.0
    flight.amsl_m += 20.0
    flight.send(1.0)
    assert flight.known


def test_small_correction_by_estimator_is_no_jump() -> None:
    flight = Flight()
    flight.north_m += 2.0
    flight.send(1.0)
    assert flight.known


def test_position_is_unknown_if_two_consecutive_gps_positions_disagree_with_estimate() -> None:
    flight = Flight()
    flight.gps_error_m = 12.0
    flight.gps()
    assert flight.known, "a single outlier is rejected by the estimator"
    flight.gps_error_m = 0.0
    flight.gps()
    flight.gps_error_m = 12.0
    flight.gps()
    assert flight.known
    flight.gps()
    assert not flight.known
    assert "12 m apart" in flight.vehicle.position_problem


def test_fix_that_is_reported_again_is_no_second_disagreement() -> None:
    flight = Flight()
    flight.gps_error_m = 12.0
    flight.gps()
    flight.gps(repeated=True)
    assert flight.known
    flight.gps()
    assert not flight.known


def test_receiver_that_reports_large_error_does_not_hide_disagreement() -> None:
    flight = Flight()
    flight.gps_error_m = 20.0
    flight.gps_accuracy_m = 9.0
    flight.gps()
    flight.gps()
    assert not flight.known


def test_receiver_that_reports_large_error_does_not_hide_jump() -> None:
    flight = Flight()
    flight.gps_accuracy_m = 9.0
    flight.gps()
    flight.north_m += 20.0
    flight.position()
    flight.send(0.05)
    assert not flight.known


@pytest.mark.parametrize("lag_s", [0.0, 0.25, 0.9])
def test_old_gps_position_of_fast_vehicle_agrees_with_estimate(lag_s: float) -> None:
    flight = Flight()
    flight.north_mps = 15.0
    flight.send(2.0)
    flight.gps_error_m = -15.0 * lag_s
    flight.send(5.0)
    assert flight.known


def test_arming_is_refused_while_position_is_not_trusted() -> None:
    flight = Flight(armed=False)
    vehicle = flight.vehicle
    vehicle.take(message("HOME_POSITION", latitude=393600000, longitude=229500000), flight.now)
    vehicle.ready = True
    vehicle.checks_at = flight.now
    assert vehicle.arming_refusal(flight.now) == ""
    flight.flags = GLITCHING
    flight.status()
    assert "GPS glitch" in vehicle.arming_refusal(flight.now)


def test_position_is_unknown_while_second_gps_disagrees_with_estimate() -> None:
    flight = Flight()
    flight.gps("GPS2_RAW")
    assert flight.known
    flight.gps_error_m = 12.0
    for _ in range(2):
        flight.gps("GPS2_RAW")
    flight.gps_error_m = 0.0
    flight.gps()
    assert not flight.known
    assert "GPS2_RAW and GLOBAL_POSITION_INT are 12 m apart" in flight.vehicle.position_problem
    flight.send(30.0)
    assert not flight.known, "the disagreement remains although the second receiver is silent"
    for _ in range(6):
        flight.gps("GPS2_RAW")
        flight.send(1.0)
    assert flight.known


def test_position_is_unknown_if_second_gps_is_silent_until_vehicle_restarts_without_it() -> None:
    flight = Flight()
    flight.gps("GPS2_RAW")
    flight.send(9.0)
    assert flight.known
    flight.send(3.0)
    assert not flight.known
    flight.gps("GPS2_RAW")
    flight.send(1.0)
    assert flight.known
    flight.send(12.0)
    assert not flight.known
    flight.boot_s = -flight.now
    flight.send(1.0)
    assert flight.known


def test_position_is_unknown_if_estimate_is_mean_of_two_receivers_that_disagree() -> None:
    flight = Flight()
    for _ in range(2):
        for name, error_m in (("GPS_RAW_INT", 6.0), ("GPS2_RAW", -6.0)):
            flight.gps_error_m = error_m
            flight.gps(name)
    assert not flight.known


def test_second_gps_without_fix_is_ignored() -> None:
    flight = Flight()
    flight.gps_error_m = 12.0
    for _ in range(3):
        flight.gps("GPS2_RAW", fix_type=1)
    assert flight.known
    for _ in range(2):
        flight.gps("GPS2_RAW")
    assert not flight.known
    flight.gps("GPS2_RAW", fix_type=1)
    flight.gps_error_m = 0.0
    flight.send(QUIET_S + 0.2)
    assert flight.known


def test_position_error_is_larger_one_of_two_receivers() -> None:
    flight = Flight()
    flight.gps_accuracy_m = 4.0
    flight.gps("GPS2_RAW")
    flight.gps_accuracy_m = 0.8
    flight.gps()
    assert flight.vehicle.position_error_m == 4.0
    flight.gps("GPS2_RAW", fix_type=0)
    flight.gps()
    assert flight.vehicle.position_error_m == 0.8


@pytest.mark.parametrize("text", ["EKF3 lane switch 1", "EKF primary changed:1"])
def test_position_is_unknown_for_quiet_time_after_switch_of_estimator(text: str) -> None:
    flight = Flight()
    flight.vehicle.take(message("STATUSTEXT", severity=2, text=text.encode()), flight.now)
    assert not flight.known
    assert "another estimator" in flight.vehicle.position_problem
    flight.send(QUIET_S - 0.1)
    assert not flight.known
    flight.send(0.2)
    assert flight.known


def test_position_that_jumped_by_switch_of_estimator_stays_unknown() -> None:
    flight = Flight()
    flight.vehicle.take(message("STATUSTEXT", severity=2, text=b"EKF3 lane switch 1"), flight.now)
    flight.north_m += 12.0
    flight.send(30.0)
    assert not flight.known
