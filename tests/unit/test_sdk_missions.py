"""Missions of the SDK: orbits and QGroundControl plans."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any, cast

import fractus
import pytest
from fractus_core.geo import LocalFrame

IMPORTED = Path(__file__).parents[1] / "imported"


@pytest.mark.parametrize("turns", [1.0, -0.5, 2.0])
def test_orbit_keeps_radius_and_faces_centre(turns: float) -> None:
    frame = LocalFrame(39.36, 22.95)
    waypoints = fractus.orbit(fractus.Position(39.36, 22.95, 25.0), 80.0, turns=turns, points=12)
    assert len(waypoints) == abs(turns) * 12 + 1
    for waypoint in waypoints:
        east, north = frame.xy(waypoint.position.lat, waypoint.position.lon)
        assert math.hypot(east, north) == pytest.approx(80.0, rel=0.01)
        assert waypoint.yaw_deg is not None
        to_middle = math.degrees(math.atan2(-east, -north))
        assert math.cos(math.radians(waypoint.yaw_deg - to_middle)) > 0.999
        assert waypoint.position.alt == 25.0
    second = frame.xy(waypoints[1].position.lat, waypoints[1].position.lon)
    assert math.copysign(1.0, second[0]) == math.copysign(1.0, turns), "a clockwise orbit begins to the east"


@pytest.mark.parametrize(("radius_m", "points"), [(0.0, 16), (math.nan, 16), (30.0, 2)])
def test_orbit_with_invalid_radius_or_points_is_refused(radius_m: float, points: int) -> None:
    with pytest.raises(fractus.InvalidRequest, match="radius above 0"):
        fractus.orbit(fractus.Position(0.0, 0.0), radius_m, points=points)


def item(command: int, *params: float | None, frame: int = 3) -> dict[str, Any]:
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": list(params)}


def plan(tmp_path: Path, *items: dict[str, Any]) -> Path:
    path = tmp_path / "survey.plan"
    path.write_text(json.dumps({"fileType": "Plan", "mission": {"items": list(items)}}))
    return path


def test_plan_waypoints_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    survey = {
        "type": "ComplexItem",
        "complexItemType": "survey",
        "TransectStyleComplexItem": {
            "Items": [item(16, 0, 0, 0, None, 39.3, 22.3, 40), item(206, 10, 0, 1, 0, 0, 0, 0)]
        },
    }
    path = plan(
        tmp_path,
        item(22, 15, 0, 0, None, 39.0, 22.0, 30),
        item(16, 0, 0, 0, None, 39.1, 22.1, 30),
        item(178, 1, 7.5, -1, 0, 0, 0, 0, frame=2),
        item(16, 4, 2, 0, 90, 39.2, 22.2, 230, frame=0),
        survey,
        item(20, 0, 0, 0, 0, 0, 0, 0, frame=2),
    )
    with caplog.at_level(logging.WARNING):
        first, second, third = fractus.read_plan(path)
    assert first == fractus.Waypoint(fractus.Position(39.1, 22.1, 30.0))
    amsl = fractus.Position(39.2, 22.2, 230.0, fractus.AltitudeReference.AMSL)
    assert second == fractus.Waypoint(amsl, yaw_deg=90, speed_mps=7.5, acceptance_radius_m=2.0, stay_s=4.0)
    assert (third.position.alt, third.speed_mps) == (40.0, 7.5)
    assert "item 5 (survey), part 2 command=MAV_CMD_DO_SET_CAM_TRIGG_DIST" in caplog.text


@pytest.mark.parametrize(
    ("items", "why"),
    [
        ([item(18, 1, 0, 5, 0, 39.1, 22.1, 30)], r"item 1 \(MAV_CMD_NAV_LOITER_TURNS\) cannot be flown; remove it"),
        ([item(16, 0, 0, 0, None, 39.1, 22.1, 30), item(777, *[0] * 7)], r"item 2 \(MAV_CMD 777\) cannot be flown"),
        ([item(16, 0, 0, 0, None, 39.1, 22.1, 30, frame=1)], r"item 1 \(MAV_CMD_NAV_WAYPOINT\) has the unsupported frame 1"),
        ([item(16, 0, 0, 0, None, None, 22.1, 30)], "has no complete position"),
        ([item(16, 0, 0, 0, None, 139.1, 22.1, 30)], "which is not a place on Earth"),
        ([item(16, 0, 0, 5, None, 39.1, 22.1, 30)], "passes its position at 5.0 m"),
        ([item(16, -1, 0, 0, None, 39.1, 22.1, 30)], "has a negative stay"),
        ([item(16, 0, 0, 0, math.nan, 39.1, 22.1, 30)], "has the param 4 nan, which must be a number or null"),
        ([item(16, 0, 0, 0, 0)], "is of an old version of QGroundControl"),
        ([item(16, 0, 0)], "must have a list of 7 params"),
        ([item(178, 1, 5, -1, 1, 0, 0, 0)], r"item 1 \(MAV_CMD_DO_CHANGE_SPEED\) has an unknown speed type"),
        (
            [item(16, 0, 0, 0, None, 39.1, 22.1, 30), item(21, *[0] * 7), item(16, 0, 0, 0, None, 39.2, 22.1, 30)],
            r"item 2 \(MAV_CMD_NAV_LAND\) comes before a waypoint",
        ),
        (
            [item(16, 0, 0, 0, None, 39.1, 22.1, 30), item(22, *[0] * 7), item(16, 0, 0, 0, None, 39.2, 22.1, 30)],
            r"item 2 \(MAV_CMD_NAV_TAKEOFF\) comes after a waypoint",
        ),
        ([{"type": "SimpleItem"}], "item 1 has no MAV_CMD"),
        ([5], "item 1 must be an object"),
        ([item(22, *[0] * 7)], "the plan contains no waypoint"),
    ],
)  # fmt: skip
def test_unsupported_plan_is_refused_with_reason(tmp_path: Path, items: list[Any], why: str) -> None:
    with pytest.raises(fractus.InvalidRequest, match=why):
        fractus.read_plan(plan(tmp_path, *items))
    with pytest.raises(fractus.InvalidRequest, match="No such file"):
        fractus.read_plan(tmp_path / "none.plan")


@pytest.mark.parametrize("content", ["", "QGC WPL 110", "[]", "{}", '{"mission": {"items": 5}}', "[" * 100_000])
def test_other_file_is_refused_as_plan(tmp_path: Path, content: str) -> None:
    path = tmp_path / "other.plan"
    path.write_text(content)
    with pytest.raises(fractus.InvalidRequest, match=r"other\.plan: not a QGroundControl plan"):
        fractus.read_plan(path)


def saved(name: str) -> Path:
    """Return a plan as a ground control station saved it."""
    return IMPORTED / f"plan-{name}.plan"


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("condition", "item 3 .MAV_CMD_CONDITION_DELAY. cannot be flown; remove it"),
        ("delay", "item 3 .MAV_CMD_NAV_DELAY. cannot be flown; remove it"),
        ("jump", "item 4 .MAV_CMD_DO_JUMP. cannot be flown; remove it"),
        ("structure-scan", "item 2 .StructureScan. contains no waypoints and cannot be flown"),
        ("terrain-null", r"item 3 .MAV_CMD_NAV_WAYPOINT. has no altitude above mean sea level \(AltitudeMode 3\); save the plan"),
        ("v1", "is of an old version of QGroundControl; open the plan with a current version and save it again"),
    ],
)  # fmt: skip
def test_saved_plan_that_cannot_be_flown_is_refused_by_item_and_command(name: str, why: str) -> None:
    with pytest.raises(fractus.InvalidRequest, match=why):
        fractus.read_plan(saved(name))


def test_climb_and_descent_speeds_of_a_plan_are_no_ground_speeds(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert [w.speed_mps for w in fractus.read_plan(saved("climb-speed"))] == [None, None, 8.0, 8.0]
    assert caplog.text.count("command=MAV_CMD_DO_CHANGE_SPEED speed_type=") == 2


def test_default_speed_of_a_plan_ends_an_earlier_speed(tmp_path: Path) -> None:
    waypoint = item(16, 0, 0, 0, None, 39.1, 22.1, 30)
    speeds = [item(178, 1, speed, -1, 0, 0, 0, 0) for speed in (7.5, -1, -2)]
    path = plan(tmp_path, *(part for speed in speeds for part in (speed, waypoint)))
    assert [w.speed_mps for w in fractus.read_plan(path)] == [7.5, 7.5, None]


def test_saved_plans_are_read_with_their_altitude_references(caplog: pytest.LogCaptureFixture) -> None:
    references = [w.position.reference for w in fractus.read_plan(saved("terrain-frames"))]
    assert references == [
        fractus.AltitudeReference.HOME,
        fractus.AltitudeReference.AMSL,
        fractus.AltitudeReference.TERRAIN,
    ]
    with caplog.at_level(logging.WARNING):
        assert len(fractus.read_plan(saved("roi"))) == 3
    assert "item 3 command=MAV_CMD_DO_SET_ROI_LOCATION" in caplog.text


def test_fence_of_a_plan_is_omitted_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = plan(tmp_path, item(16, 0, 0, 0, None, 39.1, 22.1, 30))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"geoFence": {"circles": [{}], "version": 2}}))
    with caplog.at_level(logging.WARNING):
        assert len(fractus.read_plan(path)) == 1
    assert "part=geoFence" in caplog.text


class Remembered:
    """Fake control that stores the number of reached waypoints."""

    begun = None
    waypoints_reached = 0

    async def report(self, waypoints: int) -> None:
        self.waypoints_reached = waypoints


async def test_second_mission_at_control_point_is_refused() -> None:
    control = cast(fractus.Control, Remembered())
    flown = list[fractus.Position]()
    first, second, third = (fractus.Position(lat, 22.0) for lat in (39.0, 39.1, 39.2))

    async def goto(waypoint: fractus.Waypoint) -> None:
        flown.append(waypoint.position)

    def mission(*places: fractus.Position) -> fractus.Mission:
        return fractus.Mission(lambda to, _: cast(Any, goto(to)), control, places)

    whole = mission(first, second)
    await whole
    await whole
    for other in (mission(third), mission(first, second, third), mission(first, second)):
        with pytest.raises(fractus.InvalidRequest, match="one mission, and another one has started"):
            await other
    assert flown == [first, second]
