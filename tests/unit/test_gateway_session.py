"""Protocol state of one connection of the gateway: frames in, calls and frames out."""

from __future__ import annotations

import math
from typing import Any

import pytest
from fractus_proto.v1 import types_pb2
from fractus_runtime.mavlink_codec import Endpoint, Parser, message_id
from fractus_services.gateway.session import Call, Session
from gateway_session_world import ARMED, HOME, World
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED


def _local(**values: Any) -> dict[str, Any]:
    return {"type_mask": 0b110111111000, "coordinate_frame": mavlink.MAV_FRAME_LOCAL_NED, **values}


def test_global_target_becomes_goto_with_altitude_above_home() -> None:
    (call,) = World().send(
        "SET_POSITION_TARGET_GLOBAL_INT", type_mask=0b110111111000, coordinate_frame=6,
        lat_int=393_610_000, lon_int=229_500_000, alt=12.0,
    )  # fmt: skip
    target = call.request.message.target
    assert call.request.method == "Goto"
    assert (target.latitude_deg, target.longitude_deg, target.altitude_m) == (39.361, 22.95, 12.0)
    assert target.altitude_reference == types_pb2.ALTITUDE_REFERENCE_HOME


def test_offset_in_the_body_frame_is_rotated_by_the_heading() -> None:
    (call,) = World().send(
        "SET_POSITION_TARGET_LOCAL_NED", **_local(coordinate_frame=mavlink.MAV_FRAME_BODY_OFFSET_NED, x=10.0, z=-5.0)
    )
    target = call.request.message.target
    assert target.latitude_deg == pytest.approx(HOME[0], abs=1e-6)
    assert (target.longitude_deg - HOME[1]) * 111_319 * math.cos(math.radians(HOME[0])) == pytest.approx(10.0, abs=0.1)
    assert target.altitude_m == pytest.approx(25.0)


def test_local_position_counts_from_the_origin_in_altitude_above_sea_level() -> None:
    (call,) = World().send("SET_POSITION_TARGET_LOCAL_NED", **_local(x=30.0, z=-12.0))
    target = call.request.message.target
    assert (target.latitude_deg - HOME[0]) * 111_319 == pytest.approx(30.0, rel=0.01)
    assert target.altitude_m == pytest.approx(22.0)


def test_velocity_in_the_body_frame_is_rotated_and_held() -> None:
    world = World()
    values = {"type_mask": 0b110111000111, "coordinate_frame": mavlink.MAV_FRAME_BODY_NED, "vx": 3.0}
    (call,) = world.send("SET_POSITION_TARGET_LOCAL_NED", **values)
    velocity = call.request.message.velocity
    assert (velocity.north_mps, velocity.east_mps) == (pytest.approx(0.0, abs=1e-6), pytest.approx(3.0))
    assert call.request.message.hold_s == 1.5
    world.now += 0.2
    (again,) = world.send("SET_POSITION_TARGET_LOCAL_NED", **values)
    assert again.request.message.hold_s == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"type_mask": 0b110111111100}, "neither a complete position nor a complete velocity"),
        ({"type_mask": 0b110111011111}, "neither a complete position nor a complete velocity"),
        ({"type_mask": 0b110000111111}, "neither a complete position nor a complete velocity"),
        ({"coordinate_frame": 20}, "is not supported"),
        ({"x": math.nan}, "not a number"),
        ({"z": math.inf}, "not a number"),
        ({"x": 1e30}, "km away"),
        ({"type_mask": 0b010111111000, "yaw_rate": 0.5}, "yaw rate"),
        ({"type_mask": 0b100111111000, "yaw": math.nan}, "yaw is not a number"),
    ],
)
def test_unsupported_target_is_refused_with_reason(values: dict[str, Any], reason: str) -> None:
    world = World()
    assert world.send("SET_POSITION_TARGET_LOCAL_NED", **_local(**values)) == []
    assert reason in world.texts()


def test_target_above_terrain_is_refused() -> None:
    world = World()
    assert world.send("SET_POSITION_TARGET_GLOBAL_INT", type_mask=0b110111111000, coordinate_frame=11) == []
    assert "GLOBAL_TERRAIN_ALT_INT is not supported" in world.texts()


def test_offset_is_refused_when_the_position_is_old() -> None:
    world = World()
    world.now += 2.0
    assert world.send("SET_POSITION_TARGET_LOCAL_NED", **_local(coordinate_frame=7, x=10.0)) == []
    assert "position is not known" in world.texts()


def test_guided_mission_item_becomes_goto_and_is_acknowledged() -> None:
    world = World()
    (call,) = world.send("MISSION_ITEM", command=16, current=2, frame=3, x=39.361, y=22.95, z=15.0)
    assert call.request.method == "Goto"
    assert call.request.message.target.latitude_deg == pytest.approx(39.361, abs=1e-5)
    world.session.finish(call, mavlink.MAV_RESULT_DENIED, "inside zone pool", world.now)
    replies = world.sent()
    assert [m.integer("type") for m in replies if m.name == "MISSION_ACK"] == [mavlink.MAV_MISSION_DENIED]
    assert any("inside zone pool" in m.text("text") for m in replies if m.name == "STATUSTEXT")


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (mavlink.MAV_CMD_IMAGE_START_CAPTURE, "use the camera service"),
        (mavlink.MAV_CMD_IMAGE_STOP_CAPTURE, "use the camera service"),
        (mavlink.MAV_CMD_DO_DIGICAM_CONTROL, "use the camera service"),
        (mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION, "use the camera service"),
        (mavlink.MAV_CMD_DO_SET_ROI_LOCATION, "DO_GIMBAL_MANAGER_PITCHYAW"),
        (mavlink.MAV_CMD_DO_SET_ROI_NONE, "DO_GIMBAL_MANAGER_PITCHYAW"),
        (mavlink.MAV_CMD_NAV_LOITER_TURNS, "mission items only"),
        (mavlink.MAV_CMD_CONDITION_DELAY, "mission items only"),
    ],
)
def test_command_without_support_is_answered_with_its_replacement(command: int, reason: str) -> None:
    world = World()
    assert world.command(command) == []
    sent = world.sent()
    (ack,) = [message for message in sent if message.name == "COMMAND_ACK"]
    assert ack.integer("result") == mavlink.MAV_RESULT_UNSUPPORTED
    assert reason in "".join(message.text("text") for message in sent if message.name == "STATUSTEXT")
    assert world.session.take_refusals()


@pytest.mark.parametrize("magic", [21196.0, 2989.0])
def test_forced_arming_is_denied_and_reported(magic: float) -> None:
    world = World()
    assert world.command(400, 1, magic) == []
    assert world.results() == [(400, mavlink.MAV_RESULT_DENIED)]
    assert [refusal.name for refusal in world.session.take_refusals()] == ["COMPONENT_ARM_DISARM"]


def test_arming_is_reported_as_in_progress_until_its_result() -> None:
    world = World()
    (call,) = world.command(400, 1)
    assert world.results() == [(400, mavlink.MAV_RESULT_IN_PROGRESS)]
    world.now += 1.1
    assert world.results() == [(400, mavlink.MAV_RESULT_IN_PROGRESS)]
    world.session.finish(call, ACCEPTED, "", world.now)
    assert world.results() == [(400, ACCEPTED)]


def test_repeated_command_is_one_call_while_it_is_in_progress() -> None:
    world = World()
    (call,) = world.command(22, 0, 0, 0, 0, 0, 0, 10)
    assert world.command(22, 0, 0, 0, 0, 0, 0, 10) == []
    world.session.finish(call, ACCEPTED, "", world.now)
    assert world.results() == [(22, mavlink.MAV_RESULT_IN_PROGRESS), (22, ACCEPTED)]
    assert len(world.command(22, 0, 0, 0, 0, 0, 0, 10)) == 1


@pytest.mark.parametrize("name", ["SET_MODE", "COMMAND_LONG"])
def test_repeated_mode_is_one_call_while_it_is_in_progress_and_another_mode_is_a_new_call(name: str) -> None:
    world = World()

    def select(mode: int) -> list[Call]:
        if name == "SET_MODE":
            return world.send(name, target_system=1, base_mode=1, custom_mode=mode)
        return world.command(176, 1, mode)

    assert len(select(mavlink.COPTER_MODE_RTL)) == 1
    assert select(mavlink.COPTER_MODE_RTL) == []
    (land,) = select(mavlink.COPTER_MODE_LAND)
    assert land.request.method == "Land"
    assert [result for _, result in world.results()] == [mavlink.MAV_RESULT_IN_PROGRESS]


def test_mode_guided_is_temporarily_rejected_without_control_and_requests_control() -> None:
    world = World(granted=False)
    assert world.command(176, 1, mavlink.COPTER_MODE_GUIDED) == []
    assert world.results() == [(176, mavlink.MAV_RESULT_TEMPORARILY_REJECTED)]
    assert world.session.reopen


def test_heartbeat_never_shows_guided_without_control() -> None:
    world = World(granted=False)
    world.now += 1.0
    (heartbeat,) = [m for m in world.sent() if m.name == "HEARTBEAT"]
    assert heartbeat.integer("custom_mode") == mavlink.COPTER_MODE_BRAKE
    assert heartbeat.integer("base_mode") & ARMED


@pytest.mark.parametrize(
    ("mode", "method"), [(6, "ReturnToLaunch"), (21, "ReturnToLaunch"), (9, "Land"), (17, "Hover"), (5, "Hover")]
)
def test_mode_becomes_a_call(mode: int, method: str) -> None:
    (call,) = World().send("SET_MODE", target_system=1, base_mode=1, custom_mode=mode)
    assert call.request.method == method


@pytest.mark.parametrize("mode", [0, 1, 2, 7, 20, 99])
def test_mode_without_judgement_is_denied(mode: int) -> None:
    world = World()
    assert world.command(176, 1, mode) == []
    assert world.results() == [(176, mavlink.MAV_RESULT_DENIED)]


def test_correction_is_accepted_with_a_text() -> None:
    world = World()
    (call,) = world.command(22, 0, 0, 0, 0, 0, 0, 50)
    world.session.finish(call, ACCEPTED, "NAV_TAKEOFF corrected: at most 15 m", world.now)
    replies = world.sent()
    assert [m.integer("result") for m in replies if m.name == "COMMAND_ACK"] == [ACCEPTED]
    assert any("corrected: at most 15 m" in m.text("text") for m in replies if m.name == "STATUSTEXT")


def test_long_text_is_sent_in_chunks_with_an_id() -> None:
    world = World()
    sentence = "the leg crosses zone pool of policy low between 40 m and 60 m north of home, which is forbidden today"
    world.session.send_text(4, sentence, world.now)
    chunks = [m for m in world.sent() if m.name == "STATUSTEXT"]
    assert "".join(m.text("text") for m in chunks) == sentence
    assert [m.integer("chunk_seq") for m in chunks] == [0, 1, 2]
    assert len({m.integer("id") for m in chunks}) == 1
    assert chunks[0].integer("id") != 0


def test_refused_message_is_reported_once_in_five_seconds() -> None:
    world = World()
    for _ in range(50):
        world.send("RC_CHANNELS_OVERRIDE", target_system=1, target_component=1)
    assert world.texts().count("RC_CHANNELS_OVERRIDE") == 1
    world.now += 5.1
    world.send("RC_CHANNELS_OVERRIDE", target_system=1, target_component=1)
    assert world.texts().count("RC_CHANNELS_OVERRIDE") == 1


def test_unknown_commands_are_reported_once_in_five_seconds() -> None:
    world = World()
    for number in range(50_000, 50_400):
        world.command(number)
    assert [refusal.name for refusal in world.session.take_refusals()] == ["50000"]


def test_parameter_list_is_dense_and_waits_for_the_vehicle() -> None:
    world = World()
    world.parameters.loaded = False
    world.send("PARAM_REQUEST_LIST", target_system=1)
    assert not [m for m in world.sent() if m.name == "PARAM_VALUE"]
    world.parameters.loaded = True
    values = [m for m in world.sent() if m.name == "PARAM_VALUE"]
    assert [m.integer("param_index") for m in values] == [0, 1, 2]
    assert {m.integer("param_count") for m in values} == {3}


def test_write_of_a_failsafe_parameter_is_refused_with_its_value() -> None:
    world = World()
    assert world.send("PARAM_SET", target_system=1, param_id=b"FS_GCS_ENABLE", param_value=0.0) == []
    replies = world.sent()
    assert [m.real("param_value") for m in replies if m.name == "PARAM_VALUE"] == [1.0]
    assert any("FS_GCS_ENABLE may not be written" in m.text("text") for m in replies if m.name == "STATUSTEXT")


def test_write_of_the_speed_is_reported_at_once_and_becomes_a_call() -> None:
    world = World()
    (call,) = world.send("PARAM_SET", target_system=1, param_id=b"WPNAV_SPEED", param_value=800.0)
    assert call.request.message.speed_mps == 8.0
    assert [m.real("param_value") for m in world.sent() if m.name == "PARAM_VALUE"] == [800.0]


def test_write_of_the_return_altitude_is_kept_for_return_flights() -> None:
    world = World()
    assert world.send("PARAM_SET", target_system=1, param_id=b"RTL_ALT", param_value=1200.0) == []
    assert [m.real("param_value") for m in world.sent() if m.name == "PARAM_VALUE"] == [1200.0]
    assert world.parameters.return_altitude_m == 12.0
    world.parameters.replace({"WPNAV_SPEED": 1000.0, "RTL_ALT": 1500.0})
    assert world.parameters.values["RTL_ALT"] == 1200.0


@pytest.mark.parametrize("value", [-1.0, 100_001.0, math.inf, math.nan])
def test_write_of_an_invalid_return_altitude_is_refused(value: float) -> None:
    world = World()
    assert world.send("PARAM_SET", target_system=1, param_id=b"RTL_ALT", param_value=value) == []
    assert [m.real("param_value") for m in world.sent() if m.name == "PARAM_VALUE"] == [1500.0]
    assert world.parameters.return_altitude_m is None


def test_refused_speed_is_replaced_by_the_former_value() -> None:
    world = World()
    (call,) = world.send("PARAM_SET", target_system=1, param_id=b"WPNAV_SPEED", param_value=9000.0)
    world.sent()
    world.session.finish(call, mavlink.MAV_RESULT_DENIED, "above the limit", world.now)
    assert [m.real("param_value") for m in world.sent() if m.name == "PARAM_VALUE"] == [1000.0]


def test_requested_stream_contains_only_new_messages_of_the_vehicle() -> None:
    world = World()
    world.command(511, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 100_000)
    names = [m.name for m in world.sent()]
    assert names.count("GLOBAL_POSITION_INT") == 1
    world.now += 0.1
    assert "GLOBAL_POSITION_INT" not in [m.name for m in world.sent()]
    world.report("GLOBAL_POSITION_INT", lat=1)
    world.now += 0.1
    assert "GLOBAL_POSITION_INT" in [m.name for m in world.sent()]


def test_streams_are_separate_for_each_session() -> None:
    world = World()
    other = Session(world.vehicle, world.parameters, world.missions)
    world.command(511, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 100_000)
    other.step(world.now)
    assert {m.name for m in Parser().feed(other.take())} == {"HEARTBEAT"}


def test_withheld_message_cannot_be_requested() -> None:
    world = World()
    world.command(512, mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW)
    world.command(511, mavlink.MAVLINK_MSG_ID_RC_CHANNELS, 100_000)
    assert world.results() == [(512, mavlink.MAV_RESULT_FAILED), (511, mavlink.MAV_RESULT_DENIED)]


def test_no_heartbeats_are_sent_while_the_vehicle_is_silent() -> None:
    world = World()
    world.now += 10.0
    assert "HEARTBEAT" not in [m.name for m in world.sent()]


def test_application_with_heartbeats_is_silent_after_five_seconds() -> None:
    world = World()
    world.send("ATTITUDE")
    assert not world.session.silent(world.now + 100.0)
    world.send("HEARTBEAT", type=6, autopilot=8)
    assert not world.session.silent(world.now + 4.9)
    assert world.session.silent(world.now + 5.1)


def _first_bytes(frames: bytes) -> set[int]:
    return {message.frame[0] for message in Parser().feed(frames)}


def test_program_receives_mavlink_1_until_it_sends_mavlink_2() -> None:
    world = World()
    world.session.send_text(mavlink.MAV_SEVERITY_INFO, "before the first frame", world.now)
    assert _first_bytes(world.session.take()) == {mavlink.PROTOCOL_MARKER_V2}
    world.program.mavlink1 = True
    world.send("HEARTBEAT", type=6)
    world.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HOME_POSITION)
    assert _first_bytes(world.session.take()) == {mavlink.PROTOCOL_MARKER_V1}
    world.program.mavlink1 = False
    world.send("PING")
    assert _first_bytes(world.session.take()) == {mavlink.PROTOCOL_MARKER_V2}


def test_message_that_mavlink_1_does_not_define_is_not_sent_to_its_programs() -> None:
    world = World()
    world.report("GIMBAL_DEVICE_ATTITUDE_STATUS")
    world.program.mavlink1 = True
    for name in ("GIMBAL_DEVICE_ATTITUDE_STATUS", "HOME_POSITION"):
        world.command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id(name))
    assert [message.name for message in world.sent()] == ["COMMAND_ACK", "HOME_POSITION", "COMMAND_ACK"]


def test_message_for_another_component_is_ignored() -> None:
    world = World()
    assert world.send("COMMAND_LONG", command=400, param1=1.0, target_system=1, target_component=100) == []
    assert world.send("COMMAND_LONG", command=400, param1=1.0, target_system=2, target_component=1) == []
    assert world.results() == []


def test_file_transfer_is_answered_with_a_nak() -> None:
    world = World()
    world.send("FILE_TRANSFER_PROTOCOL", target_system=1, payload=(7, 0, 3, 4))
    (nak,) = [m for m in world.sent() if m.name == "FILE_TRANSFER_PROTOCOL"]
    assert nak.array("payload")[:6] == (8, 0, 3, 129, 1, 4)


def test_flood_is_delayed() -> None:
    world = World()
    frames = b"".join(world.program.encode("HEARTBEAT", {}) for _ in range(500))
    world.session.receive(frames, world.now)
    assert world.session.delay_s(world.now) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("garbage", [b"\xfe", b"\xfd", b"\0"])
def test_garbage_is_delayed(garbage: bytes) -> None:
    world = World()
    world.session.receive(garbage * 50_000, world.now)
    assert world.session.delay_s(world.now) >= 0.5


def test_each_message_is_counted_with_its_verdict() -> None:
    world = World()
    world.send("HEARTBEAT", type=6, autopilot=8)
    world.send("PARAM_REQUEST_LIST", target_system=1)
    world.send("SERIAL_CONTROL")
    world.command(mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 1)
    world.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, 21196)
    assert world.verdicts == ["consume", "respond", "refuse", "refuse", "refuse"]
    for result, text, verdict in (
        (ACCEPTED, "", "allow"),
        (ACCEPTED, "at most 15 m", "correct"),
        (mavlink.MAV_RESULT_DENIED, "inside zone pool", "deny"),
    ):
        (call,) = world.command(mavlink.MAV_CMD_NAV_LAND)
        world.session.finish(call, result, text, world.now)
        assert world.verdicts[-1] == verdict
    assert len(world.verdicts) == 8


@pytest.mark.parametrize(
    "values",
    [
        {"x": math.nan, "y": HOME[1]},
        {"x": HOME[0], "y": math.inf},
        {"x": 1e30, "y": HOME[1]},
        {"x": HOME[0], "y": HOME[1], "frame": mavlink.MAV_FRAME_MISSION},
    ],
)
def test_guided_item_without_usable_place_is_refused(values: dict[str, Any]) -> None:
    world = World()
    item = {"current": 2, "command": mavlink.MAV_CMD_NAV_WAYPOINT, "frame": 3, "z": 20.0, "target_system": 1}
    assert world.send("MISSION_ITEM", **item | values) == []
    (ack,) = (m for m in world.sent() if m.name == "MISSION_ACK")
    assert ack.integer("type") == mavlink.MAV_MISSION_DENIED


# Hostile input

_KINDS = sorted(mavlink.mavlink_map.values(), key=lambda kind: kind.id)
_COMMANDS = sorted(mavlink.enums["MAV_CMD"])
_FLOATS = st.sampled_from([0.0, 1.0, -1.0, 1e30, math.nan, math.inf, -math.inf, 21196.0, 4.0]) | st.floats(width=32)


@st.composite
def _frames(draw: st.DrawFn) -> bytes:
    """Return random bytes, a command with random parameters, or a message with random content and a correct checksum."""
    choice = draw(st.integers(0, 9))
    if choice == 0:
        return draw(st.binary(max_size=60))
    source = (draw(st.integers(0, 255)), draw(st.integers(0, 255)))
    if choice < 5:
        values = {f"param{number}": draw(_FLOATS) for number in range(1, 8)}
        command = draw(st.sampled_from(_COMMANDS) | st.integers(0, 0xFFFF))
        return Endpoint(*source).encode("COMMAND_LONG", {**values, "command": command})
    kind = draw(st.sampled_from(_KINDS))
    size = kind.unpacker.size
    message = kind.__new__(kind)
    mavlink.MAVLink_message.__init__(message, kind.id, kind.msgname)
    protocol = mavlink.MAVLink(None, srcSystem=source[0], srcComponent=source[1])
    return bytes(message._pack(protocol, kind.crc_extra, draw(st.binary(min_size=size, max_size=size))))


@given(st.lists(_frames(), max_size=20))
def test_session_survives_any_frames_with_bounded_state(frames: list[bytes]) -> None:
    world = World()
    for frame in frames:
        for call in world.session.receive(frame, world.now):
            assert call.request.method != "Arm" or call.name == "COMPONENT_ARM_DISARM"
            world.session.finish(call, ACCEPTED, "text", world.now)
        world.now += 0.01
        world.sent()
    assert not world.session._in_progress
    assert len(world.session.take_refusals()) <= len(frames)


@given(st.binary(max_size=200))
def test_valid_frame_behind_noise_is_found(noise: bytes) -> None:
    world = World()
    frames = noise + world.program.encode("COMMAND_LONG", {"command": 20, "target_system": 1}) * 2
    calls = world.session.receive(frames + bytes(300), world.now)
    assert any(call.request.method == "ReturnToLaunch" for call in calls)
