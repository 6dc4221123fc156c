"""SmartRTL: recording, simplification and following of the path."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from depth import examples
from fractus_vehicle.breadcrumbs import Breadcrumbs, Point, distance_to_segment, segment_gap
from fractus_vehicle.state import VehicleState
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import airborne, alone, distance_m


def _crumbs(points: list[Point], limit: int = 500) -> Breadcrumbs:
    crumbs = Breadcrumbs({"SRTL_POINTS": limit}, lambda _severity, _text: None)
    crumbs.active = True
    for point in points:
        crumbs.add(point)
    return crumbs


def _tidy(crumbs: Breadcrumbs) -> list[Point]:
    for _ in crumbs.simplify_fully():
        pass
    return crumbs.path


def _line(start: Point, end: Point, step_m: float = 2.5) -> list[Point]:
    count = math.ceil(math.dist(start, end) / step_m)
    return [
        (
            start[0] + (end[0] - start[0]) * at / count,
            start[1] + (end[1] - start[1]) * at / count,
            start[2] + (end[2] - start[2]) * at / count,
        )
        for at in range(1, count + 1)
    ]


def test_smart_rtl_points_are_spaced_and_limited():
    crumbs = _crumbs([(0.0, 0.5 * at, 0.0) for at in range(40)], limit=8)
    assert len(crumbs.path) == 8
    gaps = [math.dist(a, b) for a, b in zip(crumbs.path, crumbs.path[1:], strict=False)]
    assert min(gaps) >= 2.0
    assert not crumbs.add((0.0, 100.0, 0.0))
    assert crumbs.add(crumbs.path[-1]), "adding a point at the end of a full path does not fail"


def test_simplification_keeps_corners_of_path():
    corners: list[Point] = [(0.0, 0.0, 0.0), (0.0, 0.0, -10.0), (60.0, 0.0, -10.0), (60.0, 40.0, -14.0)]
    points = [corners[0]]
    for a, b in itertools.pairwise(corners):
        points += _line(a, b)
    path = _tidy(_crumbs(points))
    assert len(path) == 4
    assert all(math.dist(a, b) < 1.0 for a, b in zip(path, corners, strict=True))


def test_loop_in_path_is_cut():
    circle: list[Point] = [(20.0 * math.sin(at / 10.0), 20.0 - 20.0 * math.cos(at / 10.0), -10.0) for at in range(63)]
    points = [
        (0.0, 0.0, 0.0),
        *_line((0.0, 0.0, 0.0), (0.0, 0.0, -10.0)),
        *_line((0.0, 0.0, -10.0), (-30.0, 0.0, -10.0)),
    ]
    points += [*_line((-30.0, 0.0, -10.0), (0.0, 0.0, -10.0)), *circle, *_line((0.0, 0.0, -10.0), (0.0, -40.0, -10.0))]
    path = _tidy(_crumbs(points))
    assert path[0] == (0.0, 0.0, 0.0)
    assert all(point[1] < 1.0 and abs(point[0]) < 2.0 for point in path), "circle and detour were removed"


@pytest.mark.parametrize("seed", range(examples(5, 2)))
def test_simplified_path_stays_within_accuracy_of_flown_path(seed: int):
    rng = random.Random(seed)
    position = (0.0, 0.0, 0.0)
    heading = 0.0
    points = [(0.0, 0.0, 0.0)]
    for _ in range(350):
        heading += rng.gauss(0.0, 0.5)
        position = (
            position[0] + 2.1 * math.cos(heading),
            position[1] + 2.1 * math.sin(heading),
            position[2] - rng.uniform(-0.4, 0.45),
        )
        points.append(position)
    crumbs = _crumbs(points)
    path = _tidy(crumbs)
    assert path[0] == points[0] and path[-1] == points[-1]
    assert len(path) < len(points) / 2
    segments = list(itertools.pairwise(points))
    for a, b in itertools.pairwise(path):
        for probe in [a, *_line(a, b, 0.5)]:
            assert min(distance_to_segment(probe, *segment) for segment in segments) <= 2.0


def test_segment_gap_matches_sampling():
    rng = random.Random(4)
    for _ in range(200):
        a, b, c, d = (tuple(rng.uniform(-5.0, 5.0) for _ in range(3)) for _ in range(4))
        gap_m, joint = segment_gap(a, b, c, d)  # type: ignore[arg-type]
        sampled = min(
            distance_to_segment(point, c, d)  # type: ignore[arg-type]
            for point in [a, *_line(a, b, 0.02)]  # type: ignore[arg-type]
        )
        assert gap_m == pytest.approx(sampled, abs=0.02)
        assert distance_to_segment(joint, a, b) == pytest.approx(gap_m / 2.0, abs=1e-6)  # type: ignore[arg-type]
    assert segment_gap((0, 0, 0), (4, 0, 0), (1, 1, 0), (3, 1, 0))[0] == pytest.approx(1.0), (
        "the distance of parallel segments is constant"
    )


def _detour(**parameters: float) -> tuple[VehicleState, Pilot, list[Point]]:
    """Fly north, then east. The recorded path then differs from the direct way home."""
    vehicle, pilot = airborne(10.0, **parameters)
    flown: list[Point] = []
    for north, east, altitude in ((60.0, 0.0, 10.0), (60.0, 60.0, 14.0)):
        pilot.go_to(north, east, altitude)
        for _ in range(1800):
            pilot.step()
            flown.append((vehicle.body.north, vehicle.body.east, vehicle.body.down))
            if distance_m(vehicle, north, east) < 0.5 and abs(vehicle.altitude_m - altitude) < 0.3:
                break
    return vehicle, pilot, flown


def _farthest_from_flown(vehicle: VehicleState, pilot: Pilot, flown: list[Point]) -> float:
    """Fly until disarmed and return the greatest distance from the outbound path."""
    path = [(0.0, 0.0, 0.0), *flown[::20], flown[-1]]
    worst = 0.0
    for at in range(20_000):
        pilot.step()
        if not vehicle.armed:
            return worst
        if at % 10 == 0:
            position = (vehicle.body.north, vehicle.body.east, vehicle.body.down)
            worst = max(worst, min(distance_to_segment(position, a, b) for a, b in itertools.pairwise(path)))
    raise AssertionError("not landed")


def test_smart_rtl_returns_along_path_and_lands_at_start():
    vehicle, pilot, flown = _detour()
    assert vehicle.breadcrumbs.active
    assert pilot.mode(mavlink.COPTER_MODE_SMART_RTL) == mavlink.MAV_RESULT_ACCEPTED
    assert _farthest_from_flown(vehicle, pilot, flown) < 2.5
    assert distance_m(vehicle, 0.0, 0.0) < 1.0
    assert vehicle.mode == mavlink.COPTER_MODE_SMART_RTL
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_FAILED
    assert pilot.texts[-1] == "Arm: SMARTRTL mode not armable"


def test_smart_rtl_pauses_two_metres_above_start():
    vehicle, pilot, _ = _detour()
    pilot.mode(mavlink.COPTER_MODE_SMART_RTL)
    pilot.wait(lambda: pilot.craft.vehicle.modes.flight.landing, 120.0)
    assert vehicle.altitude_m == pytest.approx(2.0, abs=2.1)
    assert distance_m(vehicle, 0.0, 0.0) < 2.5


def test_smart_rtl_holds_final_altitude_instead_of_landing():
    vehicle, pilot, _ = _detour(RTL_ALT_FINAL=400)
    pilot.mode(mavlink.COPTER_MODE_SMART_RTL)
    pilot.fly_on(90.0)
    assert vehicle.armed
    assert vehicle.altitude_m == pytest.approx(4.0, abs=0.5)
    assert distance_m(vehicle, 0.0, 0.0) < 2.5


@pytest.mark.parametrize("setting", [3, 4])
def test_gcs_failsafe_can_return_by_smart_rtl(setting: int):
    vehicle, pilot, flown = _detour(FS_GCS_ENABLE=setting)
    pilot.heartbeats = False
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_SMART_RTL, 7.0)
    assert pilot.texts[-1] == "GCS Failsafe"
    assert _farthest_from_flown(vehicle, pilot, flown) < 2.5


@pytest.mark.parametrize(
    ("parameter", "setting", "mode", "text"),
    [
        ("FS_GCS_ENABLE", 3, mavlink.COPTER_MODE_RTL, "SmartRTL Unavailable, Trying RTL Mode"),
        ("FS_GCS_ENABLE", 4, mavlink.COPTER_MODE_LAND, "SmartRTL Unavailable, Using Land Mode"),
        ("FS_THR_ENABLE", 4, mavlink.COPTER_MODE_RTL, "SmartRTL Unavailable, Trying RTL Mode"),
        ("FS_THR_ENABLE", 5, mavlink.COPTER_MODE_LAND, "SmartRTL Unavailable, Using Land Mode"),
        ("BATT_FS_LOW_ACT", 3, mavlink.COPTER_MODE_RTL, "SmartRTL Unavailable, Trying RTL Mode"),
        ("BATT_FS_LOW_ACT", 4, mavlink.COPTER_MODE_LAND, "SmartRTL Unavailable, Using Land Mode"),
    ],
)
def test_failsafe_falls_back_and_reports_if_smart_rtl_is_unavailable(
    parameter: str, setting: int, mode: int, text: str
):
    vehicle, pilot = airborne(10.0, SRTL_POINTS=0, BATT_LOW_VOLT=11.5, **{parameter: setting})
    assert pilot.mode(mavlink.COPTER_MODE_SMART_RTL) == mavlink.MAV_RESULT_FAILED
    assert pilot.texts[-1] == "Mode change to SMARTRTL failed: init failed"
    _provoke(parameter, pilot)
    pilot.wait(lambda: vehicle.mode is mode, 25.0)
    assert text in pilot.texts


def _provoke(parameter: str, pilot: Pilot) -> None:
    if parameter == "FS_GCS_ENABLE":
        pilot.heartbeats = False
    elif parameter == "FS_THR_ENABLE":
        pilot.parameter("SIM_RC_FAIL", 1)
    else:
        pilot.parameter("SIM_BATT_VOLTAGE", 10.4)


@pytest.mark.parametrize(
    ("parameter", "setting"), [("FS_THR_ENABLE", 4), ("BATT_FS_LOW_ACT", 3), ("BATT_FS_LOW_ACT", 4)]
)
def test_other_failsafes_can_use_smart_rtl(parameter: str, setting: int):
    vehicle, pilot = airborne(10.0, BATT_LOW_VOLT=11.5, **{parameter: setting})
    pilot.go_to(20.0, 0.0, 10.0)
    pilot.fly_on(5.0)
    _provoke(parameter, pilot)
    pilot.wait(lambda: vehicle.mode == mavlink.COPTER_MODE_SMART_RTL, 25.0)
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert distance_m(vehicle, 0.0, 0.0) < 1.0


def test_smart_rtl_is_deactivated_when_path_is_full():
    vehicle, pilot = airborne(10.0, SRTL_POINTS=20)
    rng = random.Random(3)
    for at in range(14):
        pilot.go_to(8.0 * (at + 1), rng.uniform(8.0, 20.0) * (-1) ** at, 10.0)
        pilot.fly_on(6.0)
    assert "SmartRTL Low on space!" in pilot.texts
    pilot.wait(lambda: "SmartRTL deactivated: buffer full" in pilot.texts, 60.0)
    assert pilot.mode(mavlink.COPTER_MODE_SMART_RTL) == mavlink.MAV_RESULT_FAILED
    assert vehicle.mode == mavlink.COPTER_MODE_GUIDED


def test_smart_rtl_is_deactivated_after_long_position_loss():
    vehicle, pilot = airborne(10.0, FS_EKF_ACTION=0)
    pilot.parameter("SIM_GPS_DISABLE", 1)
    pilot.wait(lambda: "SmartRTL deactivated: bad position" in pilot.texts, 30.0)
    pilot.parameter("SIM_GPS_DISABLE", 0)
    pilot.fly_on(3.0)
    assert not vehicle.breadcrumbs.active
    assert pilot.mode(mavlink.COPTER_MODE_SMART_RTL) == mavlink.MAV_RESULT_FAILED


def test_leaving_smart_rtl_midway_keeps_path():
    vehicle, pilot, _ = _detour()
    pilot.mode(mavlink.COPTER_MODE_SMART_RTL)
    pilot.fly_on(8.0)
    assert pilot.mode(mavlink.COPTER_MODE_LOITER) == mavlink.MAV_RESULT_ACCEPTED
    nearest = min(math.dist(point[:2], (60.0, 0.0)) for point in vehicle.breadcrumbs.path)
    assert nearest < 3.0, "the vehicle passes the corner again"
    pilot.fly_on(4.0)
    pilot.mode(mavlink.COPTER_MODE_SMART_RTL)
    pilot.wait(lambda: not vehicle.armed, 120.0)
    assert distance_m(vehicle, 0.0, 0.0) < 1.0


def test_arming_starts_a_new_smart_rtl_path():
    vehicle, pilot, _ = _detour()
    pilot.command(mavlink.MAV_CMD_NAV_LAND)
    pilot.wait(lambda: not vehicle.armed, 90.0)
    pilot.take_off(8.0)
    assert distance_m(vehicle, *vehicle.breadcrumbs.path[0][:2]) < 1.5
    pilot.mode(mavlink.COPTER_MODE_SMART_RTL)
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert distance_m(vehicle, 60.0, 60.0) < 2.0


def test_smart_rtl_is_refused_without_position():
    vehicle, pilot = alone()
    assert pilot.mode(mavlink.COPTER_MODE_SMART_RTL) == mavlink.MAV_RESULT_FAILED
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    pilot.fly_on(0.5)
    assert pilot.mode(mavlink.COPTER_MODE_SMART_RTL) == mavlink.MAV_RESULT_ACCEPTED
