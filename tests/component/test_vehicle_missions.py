"""Missions, rally points and their transfer."""

from __future__ import annotations

import itertools
import math

import pytest
from fractus_vehicle.profile import Profile
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.state import VehicleState
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot
from vehicle_world import START, airborne, alone, distance_m, upload

HOME = {"command": 16, "frame": 0, "x": START.lat_e7, "y": START.lon_e7, "z": 150.0}


def _waypoint(north_m: float, east_m: float, altitude_m: float, **more: float) -> dict[str, float]:
    place = START.offset(north_m, east_m)
    return {"command": 16, "frame": 3, "x": place.lat_e7, "y": place.lon_e7, "z": altitude_m} | more


def _download(pilot: Pilot, kind: int = 0) -> list[dict[str, float]]:
    target = {"target_system": 1, "target_component": 1, "mission_type": kind}
    pilot.send("MISSION_REQUEST_LIST", target)
    items = []
    for seq in range(pilot.expect("MISSION_COUNT").integer("count")):
        pilot.send("MISSION_REQUEST_INT", target | {"seq": seq})
        message = pilot.expect("MISSION_ITEM_INT")
        assert message.integer("seq") == seq
        items.append({name: message.real(name) for name in ("command", "frame", "param1", "x", "y", "z")})
    return items


MISSION = [
    HOME,
    {"command": 22, "frame": 3, "z": 10.0},
    _waypoint(20.0, 0.0, 10.0),
    {"command": 178, "param1": 1.0, "param2": 4.0},
    _waypoint(20.0, 20.0, 15.0, param1=2.0),
    {"command": 177, "param1": 2.0, "param2": 1.0},
    {"command": 20},
]


def test_mission_with_jump_and_return_is_flown():
    vehicle, pilot = alone()
    assert upload(pilot, 0, MISSION) == mavlink.MAV_MISSION_ACCEPTED
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.command(mavlink.MAV_CMD_MISSION_START) == mavlink.MAV_RESULT_ACCEPTED
    reached: list[int] = []
    fastest_after_change = 0.0
    for _ in range(20_000):
        messages = pilot.step()
        reached += [message.integer("seq") for message in messages if message.name == "MISSION_ITEM_REACHED"]
        if 3 in reached[-1:] and vehicle.mode == mavlink.COPTER_MODE_AUTO:
            fastest_after_change = max(fastest_after_change, abs(vehicle.body.ve))
        if not vehicle.armed:
            break
    assert reached == [1, 3, 4, 3, 4, 6], "if two items end in one step, only the later one is reported"
    assert vehicle.mission.state(vehicle.mode) == 5
    assert fastest_after_change < 4.4
    assert not vehicle.armed
    assert distance_m(vehicle, 0.0, 0.0) < 1.0


def test_mission_download_returns_uploaded_items_after_home():
    vehicle, pilot = airborne(5.0)
    assert upload(pilot, 0, MISSION) == mavlink.MAV_MISSION_ACCEPTED
    items = _download(pilot)
    assert [item["command"] for item in items] == [item["command"] for item in MISSION]
    assert items[2]["x"] == MISSION[2]["x"]
    assert vehicle.home is not None
    assert items[0]["x"] == vehicle.home.lat_e7
    assert vehicle.params["MIS_TOTAL"] == len(MISSION)


def test_partial_upload_replaces_part_of_mission():
    _, pilot = alone()
    upload(pilot, 0, MISSION)
    new = _waypoint(33.0, 0.0, 12.0)
    target = {"target_system": 1, "target_component": 1}
    pilot.send("MISSION_WRITE_PARTIAL_LIST", target | {"start_index": 2, "end_index": 2})
    pilot.expect("MISSION_REQUEST")
    pilot.send("MISSION_ITEM_INT", target | {"seq": 2} | new)
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ACCEPTED
    items = _download(pilot)
    assert len(items) == len(MISSION)
    assert items[2]["z"] == 12.0
    pilot.send("MISSION_WRITE_PARTIAL_LIST", target | {"start_index": 3, "end_index": 99})
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ERROR


def test_mission_item_with_float_coordinates_is_accepted():
    vehicle, pilot = alone()
    target = {"target_system": 1, "target_component": 1}
    pilot.send("MISSION_COUNT", target | {"count": 2})
    for seq in (0, 1):
        pilot.expect("MISSION_REQUEST")
        values = {"seq": seq, "command": 16, "frame": 3, "x": 48.2001, "y": 16.3702, "z": 10.0}
        pilot.send("MISSION_ITEM", target | values)
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ACCEPTED
    assert vehicle.mission.items[1].x == pytest.approx(482_001_000, abs=50)
    pilot.send("MISSION_REQUEST", target | {"seq": 1})
    assert pilot.expect("MISSION_ITEM").real("x") == pytest.approx(48.2001, abs=1e-5)


def test_stalled_upload_is_repeated_then_cancelled():
    vehicle, pilot = alone()
    upload(pilot, 0, MISSION)
    pilot.send("MISSION_COUNT", {"target_system": 1, "target_component": 1, "count": 3})
    pilot.expect("MISSION_REQUEST")
    pilot.expect("MISSION_REQUEST", 2.0)
    pilot.expect("MISSION_ACK", 12.0)
    assert pilot.last["MISSION_ACK"].integer("type") != mavlink.MAV_MISSION_ACCEPTED
    assert len(vehicle.mission.items) == 3, "the mission was cut to the new length when the upload began"


FIVE = [HOME, *(_waypoint(1.0, 0.0, 11.0 + at) for at in range(4))]
RALLY = [{"command": 5100, "frame": 3, "x": START.lat_e7 + at, "y": START.lon_e7, "z": 10.0 + at} for at in range(5)]
CIRCLES = [{"command": 5003, "x": START.lat_e7, "y": START.lon_e7, "param1": 50.0 + at} for at in range(5)]


@pytest.mark.parametrize(("kind", "old", "arrived"), [(0, FIVE, 2), (2, RALLY, 2), (1, CIRCLES, 0)])
def test_failed_upload_leaves_old_items_behind_the_new_ones(kind: int, old: list[dict[str, float]], arrived: int):
    """A fence is replaced as a whole, so that a failed upload changes nothing."""
    _, pilot = alone()
    assert upload(pilot, kind, old) == mavlink.MAV_MISSION_ACCEPTED
    before = _download(pilot, kind)
    new = [item | {"x": START.lat_e7 + 500} for item in old]
    assert upload(pilot, kind, [*new[:2], {"command": 4000, "frame": 3}, *new[3:]]) != mavlink.MAV_MISSION_ACCEPTED
    after = _download(pilot, kind)
    assert after[arrived:] == before[arrived:]
    assert [item["x"] for item in after[1:arrived]] == [START.lat_e7 + 500] * max(arrived - 1, 0)


@pytest.mark.parametrize(
    ("item", "result"),
    [
        ({"command": 4000, "frame": 3}, mavlink.MAV_MISSION_UNSUPPORTED),
        ({"command": 16, "frame": 1, "x": 5, "y": 5}, mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        ({"command": 16, "frame": 3, "x": 950_000_000, "y": 5}, mavlink.MAV_MISSION_INVALID_PARAM5_X),
        ({"command": 16, "frame": 3, "x": 5, "y": 1_850_000_000}, mavlink.MAV_MISSION_INVALID_PARAM6_Y),
        ({"command": 16, "frame": 3, "x": 5, "y": 5, "z": math.nan}, mavlink.MAV_MISSION_INVALID_PARAM7),
        ({"command": 16, "frame": 3, "x": 5, "y": 5, "param1": math.nan}, mavlink.MAV_MISSION_INVALID_PARAM1),
        ({"command": 16, "frame": 3, "x": 5, "y": 5, "param4": math.inf}, mavlink.MAV_MISSION_INVALID_PARAM4),
        ({"command": 19, "frame": 3, "x": 5, "y": 5, "param4": math.nan}, mavlink.MAV_MISSION_INVALID_PARAM4),
        ({"command": 177, "param1": 2, "param2": 1}, mavlink.MAV_MISSION_ERROR),
    ],
)
def test_invalid_item_aborts_upload(item: dict[str, float], result: int):
    vehicle, pilot = alone()
    assert upload(pilot, 0, [HOME, item]) == result
    assert len(vehicle.mission.items) == 1, "the items received before are kept"


def test_waypoint_heading_may_be_nan():
    _, pilot = alone()
    assert upload(pilot, 0, [HOME, _waypoint(5.0, 0.0, 10.0, param4=math.nan)]) == mavlink.MAV_MISSION_ACCEPTED


def test_partial_upload_may_append_one_item():
    vehicle, pilot = alone()
    upload(pilot, 0, MISSION)
    end = len(MISSION)
    target = {"target_system": 1, "target_component": 1}
    pilot.send("MISSION_WRITE_PARTIAL_LIST", target | {"start_index": end, "end_index": end})
    assert pilot.expect("MISSION_REQUEST").integer("seq") == end
    pilot.send("MISSION_ITEM_INT", target | {"seq": end} | _waypoint(1.0, 2.0, 3.0))
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ACCEPTED
    assert [item.z for item in vehicle.mission.items[end - 1 :]] == [0.0, 3.0]


def test_list_is_neither_read_nor_cleared_during_upload():
    vehicle, pilot = alone()
    upload(pilot, 0, MISSION)
    target = {"target_system": 1, "target_component": 1}
    pilot.send("MISSION_COUNT", target | {"count": 3})
    for name, more, result in (
        ("MISSION_REQUEST_LIST", {}, mavlink.MAV_MISSION_DENIED),
        ("MISSION_REQUEST_INT", {"seq": 1}, mavlink.MAV_MISSION_DENIED),
        ("MISSION_CLEAR_ALL", {}, mavlink.MAV_MISSION_ERROR),
    ):
        pilot.send(name, target | more)
        assert pilot.expect("MISSION_ACK").integer("type") == result
    assert len(vehicle.mission.items) == 3, "the items that the upload has not replaced yet"


def test_jump_tag_selects_tagged_item():
    vehicle, pilot = alone()
    tag = {"command": 600, "param1": 7.0}
    jump = {"command": 601, "param1": 7.0, "param2": 1.0}
    missing_jump = {"command": 601, "param1": 8.0, "param2": -1.0}
    points = [_waypoint(north, 0.0, 10.0) for north in (1.0, 2.0, 3.0)]
    assert (
        upload(pilot, 0, [HOME, points[0], tag, points[1], jump, missing_jump, points[2]])
        == mavlink.MAV_MISSION_ACCEPTED
    )
    mission = vehicle.mission
    at = 0
    order = []
    while (following := mission.next_after(at)) is not None:
        at = following
        order.append(at)
    assert order == [1, 2, 3, 2, 3]  # a jump to a missing tag ends the mission
    assert pilot.command(mavlink.MAV_CMD_DO_JUMP_TAG, 7.0) == mavlink.MAV_RESULT_ACCEPTED
    assert mission.current == 3, "the current item is the first navigation item after the tag"
    assert pilot.command(mavlink.MAV_CMD_DO_JUMP_TAG, 9.0) == mavlink.MAV_RESULT_FAILED


@pytest.mark.parametrize(("times", "following"), [(-1.0, None), (1.0, 4)])
def test_jump_loop_without_waypoint_terminates(times, following):
    vehicle, pilot = alone()
    tag = {"command": 600, "param1": 1.0}
    jump = {"command": 601, "param1": 1.0, "param2": times}
    points = [_waypoint(north, 0.0, 10.0) for north in (1.0, 2.0)]
    assert upload(pilot, 0, [HOME, points[0], tag, jump, points[1]]) == mavlink.MAV_MISSION_ACCEPTED
    assert vehicle.mission.peek_after(1) == following
    assert vehicle.mission.peek_after(1) == following, "peeking does not change the repetition counter"


def test_upload_of_too_many_items_is_refused():
    _, pilot = alone()
    pilot.send("MISSION_COUNT", {"target_system": 1, "target_component": 1, "count": 5000})
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_NO_SPACE


def test_second_uploader_is_denied_during_upload():
    _, pilot = alone()
    other = Pilot(pilot.simulation, pilot.craft, sysid=200)
    pilot.send("MISSION_COUNT", {"target_system": 1, "target_component": 1, "count": 2})
    other.send("MISSION_COUNT", {"target_system": 1, "target_component": 1, "count": 2})
    assert other.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_DENIED


def test_rtl_returns_to_nearest_rally_point():
    vehicle, pilot = airborne(10.0)
    rally = START.offset(60.0, 10.0)
    item = {"command": 5100, "frame": 3, "x": rally.lat_e7, "y": rally.lon_e7, "z": 10.0}
    assert upload(pilot, 2, [item]) == mavlink.MAV_MISSION_ACCEPTED
    pilot.go_to(50.0, 0.0, 10.0)
    pilot.fly_on(15.0)
    pilot.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert distance_m(vehicle, 60.0, 10.0) < 1.0


def test_mission_pause_continue_and_set_current():
    vehicle, pilot = airborne(10.0)
    upload(pilot, 0, [HOME, _waypoint(60.0, 0.0, 10.0), _waypoint(60.0, 30.0, 10.0)])
    assert pilot.mode(mavlink.COPTER_MODE_AUTO) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(4.0)
    assert pilot.command(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 0) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(6.0)
    paused_at = vehicle.body.north
    assert 5.0 < paused_at < 50.0
    assert abs(vehicle.body.vn) < 0.2
    assert pilot.command(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 1) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(4.0)
    assert vehicle.body.north > paused_at + 3.0
    assert pilot.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 2) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.last["MISSION_CURRENT"].integer("seq") == 2
    pilot.wait(lambda: vehicle.mission.state(vehicle.mode) == 5, 60.0)
    pilot.fly_on(3.0)
    assert vehicle.mode == mavlink.COPTER_MODE_AUTO, "the vehicle holds its position at the end of the mission"
    assert distance_m(vehicle, 60.0, 30.0) < 3.0


def test_mission_land_item_lands_and_loiter_time_waits():
    vehicle, pilot = airborne(8.0)
    place = START.offset(15.0, 0.0)
    items = [
        HOME,
        _waypoint(15.0, 0.0, 8.0, command=19, param1=5.0),
        {"command": 21, "frame": 3, "x": place.lat_e7, "y": place.lon_e7},
    ]
    upload(pilot, 0, items)
    pilot.mode(mavlink.COPTER_MODE_AUTO)
    took = pilot.wait(lambda: not vehicle.armed, 90.0)
    assert 24.0 < took < 45.0
    assert distance_m(vehicle, 15.0, 0.0) < 1.0


def _fly_mission(
    items: list[dict[str, float]], **parameters: float
) -> tuple[VehicleState, Pilot, list[tuple[float, ...]]]:
    """Fly a mission to its end and return the flown path with speeds."""
    vehicle, pilot = airborne(10.0, **parameters)
    assert upload(pilot, 0, [HOME, *items]) == mavlink.MAV_MISSION_ACCEPTED
    assert pilot.mode(mavlink.COPTER_MODE_AUTO) == mavlink.MAV_RESULT_ACCEPTED
    track = []
    for _ in range(12_000):
        pilot.step()
        body = vehicle.body
        track.append((body.north, body.east, -body.down, math.hypot(body.vn, body.ve), pilot.simulation.time_s))
        if vehicle.mission.state(vehicle.mode) == 5:
            return vehicle, pilot, track
    raise AssertionError(pilot.texts[-5:])


def test_mission_legs_are_straight_lines():
    _, _, track = _fly_mission([_waypoint(60.0, 0.0, 30.0), _waypoint(60.0, 80.0, 12.0)])
    for north, east, altitude, *_ in track:
        if north < 55.0:
            assert altitude == pytest.approx(10.0 + 20.0 * max(north, 0.0) / 60.0, abs=1.5)
        elif 5.0 < east < 75.0:
            assert altitude == pytest.approx(30.0 - 18.0 * east / 80.0, abs=1.5)


def test_spline_passes_its_points_without_stopping():
    points = ((40.0, 0.0), (70.0, 40.0), (40.0, 80.0), (0.0, 80.0))
    items = [_waypoint(north, east, 10.0, command=82) for north, east in points]
    _, pilot, track = _fly_mission(items)
    passed = [min(math.dist(at[:2], point) for at in track) for point in points]
    assert max(passed) < 2.0
    middle = [at[3] for at in track if 20.0 < at[1] < 75.0]
    assert min(middle) > 1.5, "the vehicle slows down in the bends but does not stop"
    assert max(at[0] for at in track) > 68.0
    straight = max(abs(at[0] - 40.0 - 30.0 * at[1] / 40.0) for at in track if 5.0 < at[1] < 35.0)
    assert straight > 2.0, "the path is a curve"
    assert "Mission: 2 SplineWP" in pilot.texts


def test_return_after_sharp_spline_starts_at_its_end():
    items = [_waypoint(25.0, 0.0, 12.0), _waypoint(25.0, 25.0, 12.0), _waypoint(0.0, 25.0, 12.0, command=82)]
    vehicle, _, track = _fly_mission([*items, {"command": 20}])
    assert max(math.hypot(north, east) for north, east, *_ in track) < 40.0
    assert max(speed for _, _, _, speed, _ in track) < 11.0
    assert vehicle.landed


def test_spline_waypoint_with_delay_stops():
    items = [_waypoint(40.0, 0.0, 10.0, command=82, param1=4.0), _waypoint(40.0, 40.0, 14.0, command=82)]
    _, _, track = _fly_mission(items)
    near_waypoint = [at[3] for at in track if math.dist(at[:2], (40.0, 0.0)) < 2.0]
    assert len(near_waypoint) > 350
    assert min(near_waypoint) < 0.3
    assert track[-1][2] == pytest.approx(14.0, abs=2.1)


def test_mission_conditions_delay_commands_without_stopping_flight():
    items = [
        _waypoint(5.0, 0.0, 10.0),
        {"command": 112, "param1": 4.0},
        {"command": 178, "param1": 1.0, "param2": 3.0},
        {"command": 114, "param1": 10.0},
        {"command": 178, "param1": 1.0, "param2": 1.5},
        _waypoint(80.0, 0.0, 10.0),
    ]
    _, pilot, track = _fly_mission(items)
    begun = next(at[4] for at in track if at[0] > 6.0)
    assert max(at[3] for at in track if at[4] < begun + 3.0) > 4.5, "the vehicle flies during the delay"
    assert max(at[3] for at in track if 55.0 < at[0] < 68.0) < 3.4
    assert max(at[3] for at in track if 75.0 < at[0] < 77.0) < 2.2
    assert [text for text in pilot.texts if "ChangeSpeed" in text] == [
        "Mission: 3 ChangeSpeed",
        "Mission: 5 ChangeSpeed",
    ]


def test_write_partial_list_replaces_mission_items():
    vehicle, pilot = alone()
    upload(pilot, 0, MISSION)
    target = {"target_system": 1, "target_component": 1}
    pilot.send("MISSION_WRITE_PARTIAL_LIST", target | {"start_index": 2, "end_index": 3})
    for seq in (2, 3):
        assert pilot.expect("MISSION_REQUEST").integer("seq") == seq
        pilot.send("MISSION_ITEM_INT", target | {"seq": seq} | _waypoint(33.0, seq, 9.0))
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ACCEPTED
    assert len(vehicle.mission.items) == len(MISSION)
    assert [item.z for item in vehicle.mission.items[2:4]] == [9.0, 9.0]
    assert vehicle.mission.items[4].z == 15.0
    pilot.send("MISSION_WRITE_PARTIAL_LIST", target | {"start_index": 5, "end_index": 50})
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ERROR


@pytest.mark.parametrize(("near_home", "include", "north"), [(True, 1, 0.0), (True, 0, 60.0), (False, 1, 60.0)])
def test_home_is_a_rally_point_if_rally_incl_home_is_set(near_home: bool, include: int, north: float):
    vehicle, pilot = airborne(10.0, RALLY_INCL_HOME=include)
    rally = START.offset(60.0, 0.0)
    upload(pilot, 2, [{"command": 5100, "frame": 3, "x": rally.lat_e7, "y": rally.lon_e7, "z": 25.0}])
    pilot.go_to(20.0 if near_home else 45.0, 0.0, 10.0)
    pilot.fly_on(12.0)
    pilot.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    highest = 0.0
    while vehicle.armed:
        pilot.step()
        highest = max(highest, vehicle.altitude_m)
    assert distance_m(vehicle, north, 0.0) < 1.0
    if north:
        assert highest == pytest.approx(25.0, abs=0.6), "the vehicle holds the altitude of the rally point"


def test_rally_point_beyond_limit_is_ignored():
    vehicle, pilot = airborne(10.0, RALLY_LIMIT_KM=0.1, RALLY_INCL_HOME=0)
    rally = START.offset(400.0, 0.0)
    upload(pilot, 2, [{"command": 5100, "frame": 3, "x": rally.lat_e7, "y": rally.lon_e7, "z": 25.0}])
    pilot.go_to(10.0, 0.0, 10.0)
    pilot.fly_on(5.0)
    pilot.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert distance_m(vehicle, 0.0, 0.0) < 1.0


def test_mission_reports_items_in_order_of_real_vehicle():
    vehicle, pilot = alone()
    speed = {"command": 178, "param1": 1.0, "param2": 4.0}
    assert upload(pilot, 0, [HOME, MISSION[1], speed, _waypoint(10.0, 0.0, 10.0), {"command": 20}]) == 0
    assert pilot.texts[-1] == "Flight plan received"
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    before = len(pilot.texts)
    assert pilot.command(mavlink.MAV_CMD_MISSION_START) == mavlink.MAV_RESULT_ACCEPTED
    pilot.wait(lambda: not vehicle.armed, 120.0)
    mission_texts = [text for text in pilot.texts[before:] if text.startswith(("Mission", "Reached"))]
    start = ["Mission: 1 Takeoff", "Mission: 1 Takeoff"]
    assert mission_texts == [*start, "Mission: 2 ChangeSpeed", "Mission: 3 WP", "Reached command #3", "Mission: 4 RTL"]


def test_mission_legs_use_wpnav_jerk():
    """A leg of 25 m from rest to rest takes a real autopilot about 9 s because of the low jerk limit WPNAV_JERK."""
    profile = Profile(25.0, 10.0, 2.5, 1.0)
    assert profile.duration_s == pytest.approx(4.0 * 12.5 ** (1.0 / 3.0))
    assert profile.at(0.0) == pytest.approx((0.0, 0.0, 0.0))
    distance_m, speed, _ = profile.at(0.5 * profile.duration_s)
    assert distance_m == pytest.approx(12.5)
    assert speed == pytest.approx(profile.speed_mps)
    assert profile.at(profile.duration_s) == pytest.approx((25.0, 0.0, 0.0))
    long = Profile(300.0, 10.0, 2.5, 1.0)
    steps = [long.at(at * 0.01)[0] for at in range(int(100.0 * long.duration_s) + 2)]
    speeds = [(later - sooner) / 0.01 for sooner, later in itertools.pairwise(steps)]
    assert max(speeds) == pytest.approx(10.0, abs=0.01)
    assert steps[-1] == pytest.approx(300.0)
    assert max(abs(b - a) for a, b in itertools.pairwise(speeds)) < 2.6 * 0.01


SHORT = [HOME, {"command": 22, "frame": 3, "z": 6.0}, _waypoint(8.0, 0.0, 6.0), {"command": 20}]


def _start_mission(pilot: Pilot) -> int:
    """Arm in GUIDED and start the stored mission. Return the result of MISSION_START."""
    vehicle = pilot.craft.vehicle.state
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    return pilot.command(mavlink.MAV_CMD_MISSION_START)


def _current(pilot: Pilot) -> tuple[int, int]:
    pilot.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_MISSION_CURRENT)
    message = pilot.last["MISSION_CURRENT"]
    return message.integer("seq"), message.integer("mission_state")


@pytest.mark.parametrize("replaced", [False, True])
def test_completed_mission_is_flown_again_from_its_first_item(replaced: bool):
    vehicle, pilot = alone()
    upload(pilot, 0, SHORT)
    assert _start_mission(pilot) == mavlink.MAV_RESULT_ACCEPTED
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert _current(pilot) == (0, mavlink.MISSION_STATE_COMPLETE)
    if replaced:
        upload(pilot, 0, SHORT)
        assert _current(pilot) == (0, mavlink.MISSION_STATE_COMPLETE)
    before = len(pilot.texts)
    assert _start_mission(pilot) == mavlink.MAV_RESULT_ACCEPTED
    assert "Mission: 1 Takeoff" in pilot.texts[before:]
    pilot.wait(lambda: vehicle.altitude_m > 5.0, 20.0)
    assert _current(pilot)[1] == mavlink.MISSION_STATE_ACTIVE


def test_mission_that_was_left_in_flight_starts_at_its_first_item_after_landing():
    vehicle, pilot = alone()
    upload(pilot, 0, SHORT)
    _start_mission(pilot)
    pilot.wait(lambda: vehicle.mission.current == 2, 30.0)
    pilot.mode(mavlink.COPTER_MODE_LAND)
    pilot.wait(lambda: not vehicle.armed, 60.0)
    assert _current(pilot) == (0, mavlink.MISSION_STATE_NOT_STARTED)
    assert _start_mission(pilot) == mavlink.MAV_RESULT_ACCEPTED


def test_landing_item_at_the_end_rewinds_the_mission_without_completing_it():
    vehicle, pilot = alone()
    upload(pilot, 0, [*SHORT[:3], {"command": 21, "frame": 3}])
    _start_mission(pilot)
    before = len(pilot.texts)
    reached: list[int] = []
    while vehicle.armed:
        reached += [message.integer("seq") for message in pilot.step() if message.name == "MISSION_ITEM_REACHED"]
    pilot.fly_on(0.5)
    assert reached == [1, 2], "the landing item itself is not reported"
    assert pilot.texts[before:][-2:] == ["Disarming motors", "Mission: 1 Takeoff"]
    assert _current(pilot) == (1, mavlink.MISSION_STATE_ACTIVE)


def test_landing_item_before_a_takeoff_item_continues_the_mission():
    vehicle, pilot = alone()
    upload(pilot, 0, [*SHORT[:3], {"command": 21, "frame": 3}, {"command": 93, "param1": 2.0}, *SHORT[1:]])
    _start_mission(pilot)
    pilot.wait(lambda: vehicle.mission.current == 4 and vehicle.landed, 60.0)
    pilot.wait(lambda: vehicle.altitude_m > 5.0, 20.0)
    assert vehicle.armed
    assert "Disarming motors" not in pilot.texts


def test_running_mission_cannot_be_cleared():
    vehicle, pilot = alone()
    upload(pilot, 0, SHORT)
    pilot.wait(lambda: vehicle.origin is not None, 5.0)
    pilot.mode(mavlink.COPTER_MODE_AUTO)
    pilot.send("MISSION_CLEAR_ALL", {"target_system": 1, "target_component": 1})
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ERROR
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.send("MISSION_CLEAR_ALL", {"target_system": 1, "target_component": 1})
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ACCEPTED
    assert _current(pilot) == (0, mavlink.MISSION_STATE_NO_MISSION)


def test_commands_that_end_one_after_another_are_all_reported_as_reached():
    vehicle, pilot = airborne(10.0)
    speed = {"command": 178, "param1": 1.0, "param2": 4.0}
    upload(
        pilot,
        0,
        [HOME, _waypoint(5.0, 0.0, 10.0), {"command": 112, "param1": 1.0}, speed, speed, _waypoint(40.0, 0.0, 10.0)],
    )
    pilot.mode(mavlink.COPTER_MODE_AUTO)
    reached: list[int] = []
    while vehicle.mission.state(vehicle.mode) != mavlink.MISSION_STATE_COMPLETE:
        reached += [message.integer("seq") for message in pilot.step() if message.name == "MISSION_ITEM_REACHED"]
    assert reached == [1, 2, 3, 4, 5]


def test_last_reached_item_is_repeated_at_a_requested_interval():
    _, pilot = airborne(10.0)
    reached = mavlink.MAVLINK_MSG_ID_MISSION_ITEM_REACHED
    pilot.command(mavlink.MAV_CMD_REQUEST_MESSAGE, reached)
    assert pilot.last["MISSION_ITEM_REACHED"].integer("seq") == 65535, "no item has been reached"
    upload(pilot, 0, [HOME, _waypoint(5.0, 0.0, 10.0), _waypoint(60.0, 0.0, 10.0)])
    pilot.mode(mavlink.COPTER_MODE_AUTO)
    pilot.expect("MISSION_ITEM_REACHED", 20.0)
    pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, reached, 200_000)
    repeated = [m.integer("seq") for _ in range(200) for m in pilot.step() if m.name == "MISSION_ITEM_REACHED"]
    assert len(repeated) == pytest.approx(10, abs=1)
    assert set(repeated) == {1}


def test_jump_and_delay_are_reported_with_their_numbers():
    _, pilot, _ = _fly_mission(
        [
            _waypoint(5.0, 0.0, 10.0),
            {"command": 177, "param1": 1.0, "param2": 2.0},
            {"command": 93, "param1": 3.0},
        ]
    )
    assert [text for text in pilot.texts if "Jump" in text or "elay" in text] == [
        "Mission: 2 Jump 1/2",
        "Mission: 2 Jump 2/2",
        "Mission: 3 Delay",
        "Delaying 3 sec",
    ]
    assert [text for text in pilot.texts if text.startswith("Reached")] == ["Reached command #1"] * 3


def test_loiter_turns_flies_to_the_circle_before_it_counts_turns():
    begun = _fly_mission([_waypoint(5.0, 0.0, 10.0, command=18, param1=1.0, param3=5.0)])[2]
    far = _fly_mission([_waypoint(30.0, 0.0, 10.0, command=18, param1=1.0, param3=5.0)])[2]
    at_circle_s = begun[-1][4] - begun[0][4]
    from_afar_s = far[-1][4] - far[0][4]
    assert at_circle_s == pytest.approx(18.5, abs=1.0), "20 degrees per second, after one second of acceleration"
    assert from_afar_s - at_circle_s == pytest.approx(9.3, abs=1.0), "a leg of 25 m from rest to rest"
    assert max(math.dist(at[:2], (30.0, 0.0)) for at in far[-1000:]) < 6.5


def test_loiter_of_no_turns_ends_on_the_circle():
    vehicle, _, track = _fly_mission([_waypoint(30.0, 0.0, 10.0, command=18, param3=5.0)])
    assert track[-1][4] - track[0][4] < 12.0
    assert distance_m(vehicle, 25.0, 0.0) < 3.0


def test_mission_start_in_auto_restarts_a_completed_mission_on_the_ground():
    vehicle, pilot = alone()
    upload(pilot, 0, SHORT)
    _start_mission(pilot)
    pilot.wait(lambda: not vehicle.armed, 90.0)
    assert vehicle.mode == mavlink.COPTER_MODE_AUTO
    before = len(pilot.texts)
    assert pilot.command(mavlink.MAV_CMD_MISSION_START) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(0.1)
    assert pilot.texts[before:] == ["Mission: 1 Takeoff", "Mission: 1 Takeoff"]
    assert _current(pilot) == (1, mavlink.MISSION_STATE_ACTIVE)


@pytest.mark.parametrize("pause_s", [0.0, 0.5])
def test_completed_mission_does_not_start_by_itself_when_armed_in_auto(pause_s: float):
    vehicle, pilot = alone()
    upload(pilot, 0, SHORT)
    _start_mission(pilot)
    pilot.wait(lambda: not vehicle.armed, 90.0)
    pilot.fly_on(pause_s)
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, 2989.0) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(8.0)
    assert vehicle.armed
    assert vehicle.landed
    assert _current(pilot) == (0, mavlink.MISSION_STATE_COMPLETE)
