"""Mission protocol of the gateway, and the lists that it stores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fractus_services.gateway.missions import MissionLists
from fractus_services.gateway.session import Call
from fractus_services.gateway.translate import CHECK_MISSION, FLY_MISSION
from fractus_services.gateway.virtual_vehicle import VirtualVehicle
from gateway_session_world import World
from pymavlink.dialects.v20 import ardupilotmega as mavlink

AUTO = mavlink.COPTER_MODE_AUTO
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
TO = {"target_system": 1, "target_component": 1}


def _upload(world: World, *commands: int, old: bool = False, **changes: Any) -> list[Call]:
    """Upload a mission of items with these commands behind item 0."""
    calls = world.send("MISSION_COUNT", count=len(commands) + 1, **TO)
    scale = 1.0 if old else 1e7
    for number, command in enumerate((16, *commands)):
        place: dict[str, Any] = {"x": 39.361 * scale, "y": 22.951 * scale, "z": 12.0}
        if not old:
            place |= {"x": round(place["x"]), "y": round(place["y"])}
        values = {**TO, "seq": number, "frame": 3, "command": command, **place, **changes}
        calls += world.send("MISSION_ITEM" if old else "MISSION_ITEM_INT", **values)
    return calls


def _acks(world: World) -> list[int]:
    return [m.integer("type") for m in world.sent() if m.name == "MISSION_ACK"]


def _stored(world: World, *commands: int) -> None:
    """Upload a mission that is accepted."""
    (call,) = _upload(world, *commands)
    world.session.finish(call, ACCEPTED, "", world.now)
    assert _acks(world) == [mavlink.MAV_MISSION_ACCEPTED]


@pytest.mark.parametrize("old", [False, True])
def test_complete_mission_is_acknowledged_after_its_judgement(old: bool) -> None:
    world = World()
    (call,) = _upload(world, 16, 20, old=old)
    assert call.request.method == CHECK_MISSION
    assert [item.command for item in call.request.message] == [16, 16, 20]
    sent = world.sent()
    assert [m.integer("seq") for m in sent if m.name == "MISSION_REQUEST"] == [0, 1, 2]
    assert "MISSION_ACK" not in [m.name for m in sent]
    world.session.finish(call, ACCEPTED, "", world.now)
    assert _acks(world) == [mavlink.MAV_MISSION_ACCEPTED]
    assert [item.command for item in world.missions.mission.items] == [16, 16, 20]


def test_item_that_is_repeated_during_the_judgement_is_ignored() -> None:
    world = World()
    (call,) = _upload(world, 16)
    world.sent()
    assert world.send("MISSION_ITEM_INT", seq=1, frame=3, command=16, z=12.0, **TO) == []
    world.now += 30.0
    assert _acks(world) == []
    world.session.finish(call, ACCEPTED, "", world.now)
    assert _acks(world) == [mavlink.MAV_MISSION_ACCEPTED]


def test_refused_mission_leaves_the_former_one_and_is_audited() -> None:
    world = World()
    _stored(world, 16)
    (call,) = _upload(world, 16, 16, 16)
    world.session.finish(call, mavlink.MAV_RESULT_DENIED, "item 2: outside the corridor", world.now)
    sent = world.sent()
    assert [m.integer("type") for m in sent if m.name == "MISSION_ACK"] == [mavlink.MAV_MISSION_DENIED]
    assert "Mission: item 2: outside" in "".join(m.text("text") for m in sent if m.name == "STATUSTEXT")
    assert len(world.missions.mission.items) == 2
    assert [refusal.name for refusal in world.session.take_refusals()] == ["Mission"]


def test_verdict_on_a_replaced_upload_has_no_effect() -> None:
    world = World()
    (first,) = _upload(world, 16)
    (second,) = _upload(world, 16, 16)
    world.sent()
    world.session.finish(first, ACCEPTED, "", world.now)
    assert _acks(world) == []
    assert world.missions.mission.items == []
    world.session.finish(second, ACCEPTED, "", world.now)
    assert _acks(world) == [mavlink.MAV_MISSION_ACCEPTED]
    assert len(world.missions.mission.items) == 3


def test_item_that_is_not_available_ends_the_upload_with_a_sentence() -> None:
    world = World()
    assert _upload(world, 16, mavlink.MAV_CMD_DO_SET_SERVO) == []
    sent = world.sent()
    assert [m.integer("type") for m in sent if m.name == "MISSION_ACK"] == [mavlink.MAV_MISSION_UNSUPPORTED]
    assert "Mission: item 2: DO_SET_SERVO is not available" in "".join(
        m.text("text") for m in sent if m.name == "STATUSTEXT"
    )
    assert [refusal.name for refusal in world.session.take_refusals()] == ["MISSION_ITEM_INT"]


def test_item_with_a_number_that_is_none_is_refused() -> None:
    world = World()
    assert _upload(world, 20, param1=float("nan")) == []
    assert _acks(world)[-1] == mavlink.MAV_MISSION_INVALID_PARAM1


def test_item_above_terrain_is_refused() -> None:
    world = World()
    assert _upload(world, 16, frame=mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT) == []
    assert _acks(world) == [mavlink.MAV_MISSION_UNSUPPORTED_FRAME]


def test_stored_mission_is_read_with_home_as_item_0() -> None:
    world = World()
    _stored(world, 16, 20)
    world.send("MISSION_REQUEST_LIST", **TO)
    (count,) = [m for m in world.sent() if m.name == "MISSION_COUNT"]
    assert count.integer("count") == 3
    for number in range(3):
        world.send("MISSION_REQUEST_INT", seq=number, **TO)
    items = [m for m in world.sent() if m.name == "MISSION_ITEM_INT"]
    assert [m.integer("command") for m in items] == [16, 16, 20]
    assert items[0].integer("x") == 393_600_000
    world.send("MISSION_REQUEST", seq=1, **TO)
    (item,) = [m for m in world.sent() if m.name == "MISSION_ITEM"]
    assert item.real("x") == pytest.approx(39.361, abs=1e-5)


@pytest.mark.parametrize(("name", "values"), [("MISSION_CLEAR_ALL", {}), ("MISSION_COUNT", {"count": 0})])
def test_mission_is_cleared_unless_it_is_flown(name: str, values: dict[str, Any]) -> None:
    world = World()
    _stored(world, 16)
    world.vehicle.flying_mode = AUTO
    world.send(name, **values, **TO)
    assert _acks(world) == [mavlink.MAV_MISSION_ERROR]
    assert len(world.missions.mission.items) == 2
    world.vehicle.flying_mode = mavlink.COPTER_MODE_GUIDED
    world.send(name, **values, **TO)
    assert _acks(world) == [mavlink.MAV_MISSION_ACCEPTED]
    assert world.missions.mission.items == []


def test_empty_mission_replaces_an_upload_that_waits_for_its_verdict() -> None:
    world = World()
    _stored(world, 16)
    (call,) = _upload(world, 16, 16)
    world.sent()
    world.send("MISSION_COUNT", count=0, **TO)
    assert _acks(world) == [mavlink.MAV_MISSION_OPERATION_CANCELLED, mavlink.MAV_MISSION_ACCEPTED]
    world.session.finish(call, ACCEPTED, "", world.now)
    assert _acks(world) == []
    assert world.missions.mission.items == []


def test_lists_of_unknown_type_are_unsupported() -> None:
    world = World()
    world.send("MISSION_CLEAR_ALL", mission_type=255, **TO)
    assert _acks(world) == [mavlink.MAV_MISSION_UNSUPPORTED]


def test_upload_without_items_times_out() -> None:
    world = World()
    world.send("MISSION_COUNT", count=3, **TO)
    world.sent()
    world.now += 9.0
    assert _acks(world) == [mavlink.MAV_MISSION_OPERATION_CANCELLED]


def test_upload_ends_with_its_connection() -> None:
    world = World()
    world.send("MISSION_COUNT", count=3, **TO)
    world.session.close()
    assert world.missions.transfers.uploads == {}


@pytest.mark.parametrize(("command", "params"), [(300, ()), (176, (1, AUTO)), (193, (1,))])
def test_mission_is_started_by_command_or_mode(command: int, params: tuple[float, ...]) -> None:
    world = World()
    _stored(world, 16)
    (call,) = world.command(command, *params)
    assert call.request.method == FLY_MISSION
    assert call.request.message is None


def test_auto_without_a_mission_fails() -> None:
    world = World()
    assert world.command(176, 1, AUTO) == []
    assert world.results() == [(176, mavlink.MAV_RESULT_FAILED)]
    assert world.command(193, 1) == []
    assert world.results() == [(193, mavlink.MAV_RESULT_DENIED)]


def test_auto_without_control_is_rejected_for_now_and_requests_control() -> None:
    world = World(granted=False)
    _stored(world, 16)
    assert world.command(300) == []
    assert world.results() == [(300, mavlink.MAV_RESULT_TEMPORARILY_REJECTED)]
    assert world.session.reopen


def test_part_of_a_mission_cannot_be_started() -> None:
    world = World()
    _stored(world, 16)
    assert world.command(300, 1, 2) == []
    assert world.results() == [(300, mavlink.MAV_RESULT_DENIED)]


def test_pause_in_auto_keeps_the_mode() -> None:
    world = World()
    _stored(world, 16)
    world.vehicle.flying_mode = AUTO
    (call,) = world.command(193, 0)
    assert (call.request.method, call.request.mode) == ("Hover", AUTO)


def test_current_item_is_set_on_the_ground() -> None:
    world = World()
    _stored(world, 16, 178, 16)
    assert world.command(224, 2) == []
    sent = world.sent()
    assert [m.integer("result") for m in sent if m.name == "COMMAND_ACK"] == [ACCEPTED]
    assert [m.integer("seq") for m in sent if m.name == "MISSION_CURRENT"] == [2]
    assert world.missions.mission.current == 3
    assert world.command(224, 7) == []
    assert world.results() == [(224, mavlink.MAV_RESULT_DENIED)]
    assert world.send("MISSION_SET_CURRENT", seq=1, **TO) == []
    assert world.missions.mission.current == 1


def test_new_mission_begins_at_its_first_item() -> None:
    world = World()
    _stored(world, 16, 16, 16)
    world.command(224, 3)
    world.sent()
    _stored(world, 16, 16)
    assert world.missions.mission.current == 0
    world.vehicle.flying_mode = AUTO  # paused
    world.missions.mission.current = 2
    _stored(world, 16, 16)
    assert world.missions.mission.current == 2
    _stored(world, 16)
    assert world.missions.mission.current == 0


def test_current_item_is_set_in_auto_by_a_call() -> None:
    world = World()
    _stored(world, 16, 16)
    world.vehicle.flying_mode = AUTO
    (call,) = world.send("MISSION_SET_CURRENT", seq=2, **TO)
    assert (call.request.method, call.request.message) == (FLY_MISSION, 2)
    world.session.finish(call, ACCEPTED, "", world.now)
    assert [m.integer("seq") for m in world.sent() if m.name == "MISSION_CURRENT"] == [2]


@pytest.mark.parametrize("mode", [AUTO, mavlink.COPTER_MODE_RTL, mavlink.COPTER_MODE_LAND])
def test_targets_are_refused_unless_the_mode_is_guided(mode: int) -> None:
    world = World()
    world.vehicle.flying_mode = mode
    target = {"coordinate_frame": 6, "type_mask": 0b110111111000, "lat_int": 393_600_000, "lon_int": 229_500_000}
    assert world.send("SET_POSITION_TARGET_GLOBAL_INT", alt=10.0, **target, **TO) == []
    assert world.send("MISSION_ITEM_INT", current=2, command=16, frame=3, x=1, y=1, z=10.0, **TO) == []
    assert world.command(22, 0, 0, 0, 0, 0, 0, 10) == []
    assert world.results() == [(22, mavlink.MAV_RESULT_DENIED)]


def test_reposition_in_auto_needs_the_flag_that_changes_the_mode() -> None:
    world = World()
    world.vehicle.flying_mode = AUTO
    values = {"command": 192, "frame": 3, "x": 393_600_000, "y": 229_500_000, "z": 10.0, "param1": -1.0}
    assert world.send("COMMAND_INT", **values, **TO) == []
    (call,) = world.send("COMMAND_INT", param2=1.0, **values, **TO)
    assert call.request.method == "Goto"


def test_auto_is_not_armable() -> None:
    world = World()
    world.vehicle.flying_mode = AUTO
    assert world.command(400, 1) == []
    assert world.results() == [(400, mavlink.MAV_RESULT_FAILED)]


def test_mission_mode_ends_when_the_vehicle_has_landed() -> None:
    world = World()
    world.vehicle.flying_mode = AUTO
    world.report("HEARTBEAT", base_mode=0, custom_mode=mavlink.COPTER_MODE_GUIDED, autopilot=3, type=2)
    assert world.vehicle.mode == mavlink.COPTER_MODE_GUIDED
    world.vehicle.flying_mode = AUTO  # requested on the ground
    world.report("HEARTBEAT", base_mode=0, custom_mode=mavlink.COPTER_MODE_GUIDED, autopilot=3, type=2)
    assert world.vehicle.mode == AUTO


def _fence(world: World, count: int = 3, radius: float | None = None) -> list[int]:
    corners = [(0, 0), (1_000_000, 0), (0, 1_000_000)]
    rows = [(5001, count, x, y) for x, y in corners] if radius is None else [(5003, radius, 0, 0)]
    world.send("MISSION_COUNT", count=len(rows), mission_type=1, **TO)
    for number, (command, param1, x, y) in enumerate(rows):
        values = {"command": command, "param1": param1, "x": 393_000_000 + x, "y": 229_000_000 + y}
        world.send("MISSION_ITEM_INT", seq=number, mission_type=1, **values, **TO)
    return _acks(world)


def test_fence_applies_after_it_was_enabled() -> None:
    world = World()
    assert world.command(207, 1) == []
    assert world.results() == [(207, mavlink.MAV_RESULT_FAILED)]
    assert _fence(world) == [mavlink.MAV_MISSION_ACCEPTED]
    assert world.missions.fence_problem(10.0, 10.0) == ""
    world.command(207, 1)
    assert world.results() == [(207, ACCEPTED)]
    assert world.missions.fence_problem(39.32, 22.92) == ""
    assert "outside the fence" in world.missions.fence_problem(39.38, 22.98)
    world.send("MISSION_COUNT", count=0, mission_type=1, **TO)
    assert world.missions.fence_problem(10.0, 10.0) == ""


@pytest.mark.parametrize(("count", "radius"), [(2, None), (5, None), (3, 0.0), (3, -5.0), (3, float("nan"))])
def test_malformed_fence_is_refused(count: int, radius: float | None) -> None:
    world = World()
    assert _fence(world, count, radius) == [mavlink.MAV_MISSION_ERROR]
    assert world.missions.fence_problem(10.0, 10.0) == ""


def test_lists_survive_a_restart_of_the_gateway(tmp_path: Path) -> None:
    file = tmp_path / "missions" / "default.app.json"
    world = World(file=file)
    _stored(world, 16, 20)
    assert _fence(world) == [mavlink.MAV_MISSION_ACCEPTED]
    world.command(207, 1)
    restored = MissionLists(VirtualVehicle(), file)
    assert restored.mission.items == world.missions.mission.items
    assert "outside the fence" in restored.fence_problem(39.38, 22.98)


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"lists": {"0": [[1,2,3,4,5,6,7,8,9,10,11]], "1": [], "2": []}}', '{"lists": 5}']
)
def test_damaged_file_is_ignored(tmp_path: Path, content: str) -> None:
    file = tmp_path / "lists.json"
    file.write_text(content)
    assert MissionLists(VirtualVehicle(), file).mission.items == []
