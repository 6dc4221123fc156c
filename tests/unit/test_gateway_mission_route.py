"""Calls that fly the items of a mission, and the items that a mission may contain."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from fractus_core.geo import LocalFrame
from fractus_proto.v1 import types_pb2
from fractus_services.gateway.mission_route import MAX_STEPS, ItemRefused, Place, check_item, requests_of, route_of
from fractus_services.gateway.translate import Request, Untranslatable
from fractus_services.mavlink_server.mission_items import Item
from fractus_services.mavlink_server.stored_mission import Mission
from pymavlink.dialects.v20 import ardupilotmega as mavlink

HERE = Place(39.36, 22.95, 7.0)
HOME = Item(mavlink.MAV_CMD_NAV_WAYPOINT, frame=mavlink.MAV_FRAME_GLOBAL)


def _waypoint(lat: float, altitude_m: float = 10.0, **changes: int) -> Item:
    return Item(mavlink.MAV_CMD_NAV_WAYPOINT, x=round(lat * 1e7), y=229_500_000, z=altitude_m, **changes)


def _jump(number: int, times: int) -> Item:
    return Item(mavlink.MAV_CMD_DO_JUMP, param1=number, param2=times)


def _route(*items: Item, on_ground: bool = False) -> list[tuple[int, Request]]:
    mission = Mission()
    mission.store.items = [HOME, *items]
    return route_of(mission, 1, HERE, on_ground=on_ground)


def _requests(item: Item, at: Place) -> tuple[list[Request], Place]:
    """Return the calls of an item, and the place to which they lead."""
    mission = Mission()
    mission.store.items = [HOME, item]
    return requests_of(mission, 1, at)


def _place(request: Request) -> tuple[float, float, int]:
    target = request.message.target
    return round(target.latitude_deg, 6), target.altitude_m, target.altitude_reference


def test_waypoint_without_place_or_altitude_keeps_them() -> None:
    (request,), at = _requests(Item(mavlink.MAV_CMD_NAV_WAYPOINT, z=20.0), HERE)
    assert _place(request) == (39.36, 20.0, types_pb2.ALTITUDE_REFERENCE_HOME)
    (request,), _ = _requests(_waypoint(39.37, 0.0), at)
    assert _place(request) == (39.37, 20.0, types_pb2.ALTITUDE_REFERENCE_HOME)


def test_altitude_above_sea_level_is_passed_on() -> None:
    (request,), _ = _requests(_waypoint(39.37, 50.0, frame=mavlink.MAV_FRAME_GLOBAL), HERE)
    assert _place(request) == (39.37, 50.0, types_pb2.ALTITUDE_REFERENCE_AMSL)


def test_landing_with_a_place_flies_there_at_the_present_altitude() -> None:
    requests, _ = _requests(Item(mavlink.MAV_CMD_NAV_LAND, x=393_700_000, y=229_500_000), HERE)
    assert [request.method for request in requests] == ["Goto", "Land"]
    assert _place(requests[0]) == (39.37, 7.0, types_pb2.ALTITUDE_REFERENCE_HOME)


def test_route_ends_with_a_landing() -> None:
    route = _route(_waypoint(39.37), Item(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH), _waypoint(39.38))
    assert [request.method for _, request in route] == ["Goto", "ReturnToLaunch"]


def test_route_on_the_ground_begins_with_a_takeoff() -> None:
    route = _route(_waypoint(39.37, 12.0), on_ground=True)
    assert [request.method for _, request in route] == ["Takeoff", "Goto"]
    assert route[0][1].message.altitude_m == 12.0
    route = _route(Item(mavlink.MAV_CMD_NAV_TAKEOFF, z=9.0), _waypoint(39.37), on_ground=True)
    assert [request.method for _, request in route] == ["Takeoff", "Goto"]


@pytest.mark.parametrize("times", [-1, 2, 100])
def test_jump_is_judged_twice(times: int) -> None:
    route = _route(_waypoint(39.37), _waypoint(39.38), _jump(1, times), _waypoint(39.39))
    assert [number for number, _ in route] == [1, 2, 1, 2, 1, 2, 4]


def test_jump_without_repetition_is_not_judged() -> None:
    route = _route(_waypoint(39.37), _waypoint(39.38), _jump(1, 0), _waypoint(39.39))
    assert [number for number, _ in route] == [1, 2, 4]


def _circle(turns: float, radius_m: float = 0.0, **changes: Any) -> Item:
    values = {"x": 393_700_000, "y": 229_500_000, "z": 15.0, **changes}
    return Item(mavlink.MAV_CMD_NAV_LOITER_TURNS, param1=turns, param3=radius_m, **values)


def _corners(requests: list[Request]) -> list[tuple[float, float]]:
    """Return distance in metres and bearing in degrees from the centre of `_circle` to each target."""
    frame = LocalFrame(39.37, 22.95)
    points = [frame.xy(r.message.target.latitude_deg, r.message.target.longitude_deg) for r in requests]
    return [(math.hypot(*point), math.degrees(math.atan2(*point)) % 360.0) for point in points]


@pytest.mark.parametrize(("radius_m", "turn_deg"), [(30.0, 22.5), (-30.0, -22.5)])
def test_circle_is_flown_as_legs_between_its_points_from_the_nearest_one_on(radius_m: float, turn_deg: float) -> None:
    requests, at = _requests(_circle(1, radius_m), Place(39.36, 22.95, 7.0))
    corners = _corners(requests)
    assert [distance for distance, _ in corners] == pytest.approx([30.0] * 17)
    assert corners[0][1] == pytest.approx(180.0), "the drone is south of the centre"
    turns = [(second - first) % 360.0 for (_, first), (_, second) in pairwise(corners)]
    assert turns == pytest.approx([turn_deg % 360.0] * 16, abs=0.1)
    assert {request.message.target.altitude_m for request in requests} == {15.0}
    assert (at.lat, at.lon) == pytest.approx((requests[0].message.target.latitude_deg, 22.95))


@pytest.mark.parametrize(("turns", "legs"), [(0.0, 1), (0.5, 9), (1.0, 17), (3.0, 49)])
def test_circle_is_repeated_as_often_as_its_item_requires(turns: float, legs: int) -> None:
    requests, _ = _requests(_circle(turns), HERE)
    assert len(requests) == legs
    assert _corners(requests)[0][0] == pytest.approx(10.0)


def test_one_turn_of_a_circle_is_judged() -> None:
    assert len(_route(_circle(255, 20.0))) == 17
    assert len(_route(_circle(0.25, 20.0))) == 5


def test_route_with_too_many_circles_is_refused() -> None:
    assert len(_route(*[_circle(1)] * 58)) == 58 * 17
    with pytest.raises(Untranslatable, match=f"more than {MAX_STEPS} legs"):
        _route(*[_circle(1)] * 59)


def test_condition_yaw_is_the_heading_of_the_next_leg() -> None:
    yaw = Item(mavlink.MAV_CMD_CONDITION_YAW, param1=-90.0)
    first, second, third = (
        request.message for _, request in _route(_waypoint(39.37), yaw, _waypoint(39.38), _waypoint(39.39))
    )
    assert not first.HasField("yaw_deg")
    assert second.yaw_deg == 270.0
    assert not third.HasField("yaw_deg")


def test_condition_distance_divides_the_next_leg() -> None:
    near = Item(mavlink.MAV_CMD_CONDITION_DISTANCE, param1=50.0)
    camera = Item(mavlink.MAV_CMD_DO_MOUNT_CONTROL, param1=-90.0, z=2.0)
    route = _route(_waypoint(39.37, 10.0), near, camera, _waypoint(39.371, 20.0))
    assert [request.method for _, request in route] == ["Goto", "Goto", "PointGimbal", "Goto"]
    target = route[1][1].message.target
    east, north = LocalFrame(39.371, 22.95).xy(target.latitude_deg, target.longitude_deg)
    assert (east, north) == pytest.approx((0.0, -50.0), abs=0.1)
    assert target.altitude_m == pytest.approx(20.0 - 10.0 * 50.0 / 111.0, abs=0.1)


@pytest.mark.parametrize(
    "items",
    [
        [Item(mavlink.MAV_CMD_CONDITION_DISTANCE, param1=500.0), _waypoint(39.371)],
        [Item(mavlink.MAV_CMD_CONDITION_DISTANCE, param1=5.0), Item(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)],
        [Item(mavlink.MAV_CMD_CONDITION_DISTANCE, param1=5.0)],
    ],
)
def test_condition_distance_without_a_distant_waypoint_has_no_effect(items: list[Item]) -> None:
    route = _route(_waypoint(39.37), *items)
    assert len(route) == len(items)


def test_route_on_the_ground_takes_off_before_the_leg_of_a_condition_distance() -> None:
    near = Item(mavlink.MAV_CMD_CONDITION_DISTANCE, param1=5.0)
    route = _route(near, _waypoint(39.37), on_ground=True)
    assert [request.method for _, request in route] == ["Takeoff", "Goto", "Goto"]


def test_route_with_too_many_steps_is_refused() -> None:
    nested = [*[_waypoint(39.37) for _ in range(300)], _jump(1, 9), _jump(1, 9)]
    with pytest.raises(Untranslatable, match=f"more than {MAX_STEPS} steps"):
        _route(*nested)


def test_route_with_too_many_jumps_between_its_items_is_refused() -> None:
    exhausted = [Item(mavlink.MAV_CMD_DO_JUMP_TAG, param1=1, param2=0)] * 90
    pauses = [Item(mavlink.MAV_CMD_NAV_DELAY), *exhausted] * 6
    tag = Item(mavlink.MAV_CMD_JUMP_TAG, param1=1)
    assert [number for number, _ in _route(*pauses, tag, _waypoint(39.37))] == [548]
    with pytest.raises(Untranslatable, match=f"more than {MAX_STEPS} steps"):
        _route(*pauses, _jump(1, 2), tag, _waypoint(39.37))


def test_tags_are_read_once_for_each_list() -> None:
    class CountedItems(list[Item]):
        reads = 0

        def __iter__(self) -> Iterator[Item]:
            self.reads += 1
            return super().__iter__()

    mission = Mission()
    items = CountedItems([HOME, *[Item(mavlink.MAV_CMD_DO_JUMP_TAG, param1=1, param2=0)] * 90])
    items += [Item(mavlink.MAV_CMD_JUMP_TAG, param1=1), Item(mavlink.MAV_CMD_JUMP_TAG, param1=1)]
    mission.store.items = items
    assert mission.next_after(0) == 91
    assert mission.find_tag(1) == 91, "the first of two items with the same tag"
    assert items.reads == 1
    mission.store.items = [HOME, Item(mavlink.MAV_CMD_JUMP_TAG, param1=1)]
    assert mission.find_tag(1) == 1


def test_speed_and_camera_items_become_calls() -> None:
    route = _route(
        Item(mavlink.MAV_CMD_DO_CHANGE_SPEED, param1=1.0, param2=3.0),
        Item(mavlink.MAV_CMD_DO_CHANGE_SPEED, param1=1.0, param2=-1.0),
        Item(mavlink.MAV_CMD_DO_MOUNT_CONTROL, param1=-90.0, z=2.0),
    )
    assert [request.method for _, request in route] == ["SetSpeed", "PointGimbal"]
    assert route[0][1].message.speed_mps == 3.0
    assert route[1][1].message.pitch_deg == -90.0


@pytest.mark.parametrize(
    ("item", "result"),
    [
        (Item(mavlink.MAV_CMD_DO_SET_SERVO), mavlink.MAV_MISSION_UNSUPPORTED),
        (Item(mavlink.MAV_CMD_DO_SET_HOME), mavlink.MAV_MISSION_UNSUPPORTED),
        (Item(mavlink.MAV_CMD_NAV_GUIDED_ENABLE), mavlink.MAV_MISSION_UNSUPPORTED),
        (Item(mavlink.MAV_CMD_DO_PARACHUTE), mavlink.MAV_MISSION_UNSUPPORTED),
        (_waypoint(39.37, frame=mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT), mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        (
            Item(mavlink.MAV_CMD_NAV_TAKEOFF, frame=mavlink.MAV_FRAME_GLOBAL, z=50.0),
            mavlink.MAV_MISSION_UNSUPPORTED_FRAME,
        ),
        (Item(mavlink.MAV_CMD_DO_CHANGE_SPEED, param1=2.0, param2=3.0), mavlink.MAV_MISSION_INVALID_PARAM1),
        (Item(mavlink.MAV_CMD_CONDITION_YAW, param1=10.0, param4=1.0), mavlink.MAV_MISSION_INVALID_PARAM4),
        (_circle(1, frame=mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT), mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        (Item(mavlink.MAV_CMD_DO_SET_ROI_LOCATION), mavlink.MAV_MISSION_UNSUPPORTED),
        (Item(mavlink.MAV_CMD_IMAGE_START_CAPTURE), mavlink.MAV_MISSION_UNSUPPORTED),
        (Item(mavlink.MAV_CMD_DO_MOUNT_CONTROL, z=0.0), mavlink.MAV_MISSION_INVALID_PARAM7),
    ],
)
def test_item_that_is_not_available_is_refused(item: Item, result: int) -> None:
    with pytest.raises(ItemRefused) as refused:
        check_item(item)
    assert refused.value.result == result
