"""Responses of the simulated vehicle to values and sequences that the recorded script does not contain."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from fractus_vehicle.home import set_home
from fractus_vehicle.readiness import arming_refusals
from fractus_vehicle.shaping import wrap_pi
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_world import START, airborne, alone, distance_m, upload

TARGET = {"target_system": 1, "target_component": 1}
HOME = {"command": 16, "frame": 0}
TAKEOFF = {"command": 22, "frame": 3, "z": 10.0}


def _waypoint(north: float, **more: float) -> dict[str, float]:
    place = START.offset(north, 0.0)
    return {"command": 16, "frame": 3, "x": place.lat_e7, "y": place.lon_e7, "z": 10.0} | more


@pytest.mark.parametrize(
    ("command", "params", "result"),
    [
        (mavlink.MAV_CMD_CONDITION_YAW, (90, 10, 1, 0), mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.MAV_CMD_CONDITION_YAW, (361, 10, 1, 0), mavlink.MAV_RESULT_FAILED),
        (mavlink.MAV_CMD_MISSION_START, (0, 2), mavlink.MAV_RESULT_DENIED),
        (mavlink.MAV_CMD_DO_PAUSE_CONTINUE, (2,), mavlink.MAV_RESULT_DENIED),
        (mavlink.MAV_CMD_DO_SET_HOME, (2, 0, 0, 0, 48.2, 16.37, 150.0), mavlink.MAV_RESULT_FAILED),
        (mavlink.MAV_CMD_DO_SET_HOME, (0, 0, 0, 0, 48.2, 16.37, math.nan), mavlink.MAV_RESULT_DENIED),
        (mavlink.MAV_CMD_DO_SET_HOME, (0, 0, 0, 0, 95.0, 16.37, 150.0), mavlink.MAV_RESULT_FAILED),
        (mavlink.MAV_CMD_DO_SET_ROI_LOCATION, (0, 0, 0, 0, 95.0, 16.37, 0.0), mavlink.MAV_RESULT_FAILED),
        (mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, (1,), mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, (0, 0, 0, 0, 2), mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, (), mavlink.MAV_RESULT_UNSUPPORTED),
        (mavlink.MAV_CMD_SET_EKF_SOURCE_SET, (2,), mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.MAV_CMD_SET_EKF_SOURCE_SET, (4,), mavlink.MAV_RESULT_DENIED),
        (mavlink.MAV_CMD_DO_JUMP_TAG, (70_000,), mavlink.MAV_RESULT_DENIED),
        (mavlink.MAV_CMD_DO_WINCH, (), mavlink.MAV_RESULT_FAILED),
        (mavlink.MAV_CMD_DO_SPRAYER, (1,), mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, (70_000,), mavlink.MAV_RESULT_FAILED),
    ],
)
def test_command_results_depend_on_parameter_values(command: int, params: tuple[float, ...], result: int):
    vehicle, pilot = alone()
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    assert pilot.command(command, *params) is result


@pytest.mark.parametrize(
    ("command", "params", "texts"),
    [
        (mavlink.MAV_CMD_DO_PAUSE_CONTINUE, (0,), ["Failed to pause"]),
        (mavlink.MAV_CMD_DO_PAUSE_CONTINUE, (1,), ["Failed to resume"]),
        (
            mavlink.MAV_CMD_PREFLIGHT_CALIBRATION,
            (0, 0, 1),
            ["Updating barometer calibration", "Barometer calibration complete"],
        ),
    ],
)
def test_statustexts_depend_on_parameter_values(command: int, params: tuple[float, ...], texts: list[str]):
    _, pilot = alone()
    pilot.texts.clear()
    pilot.command(command, *params)
    assert [text for text in pilot.texts if text in texts] == texts


def test_armed_vehicle_on_the_ground_starts_only_missions_with_takeoff():
    vehicle, pilot = alone()
    upload(pilot, 0, [HOME, _waypoint(20.0)])
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    assert pilot.mode(mavlink.COPTER_MODE_AUTO) == mavlink.MAV_RESULT_FAILED
    assert pilot.texts[-2:] == ["Auto: Missing Takeoff Cmd", "Mode change to AUTO failed: init failed"]
    upload(pilot, 0, [HOME, {"command": 93, "param1": 1.0}, TAKEOFF, _waypoint(20.0)])
    assert pilot.mode(mavlink.COPTER_MODE_AUTO) == mavlink.MAV_RESULT_ACCEPTED


def test_repeated_takeoff_command_does_not_delay_climb():
    vehicle, pilot = alone()
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    takeoff = (mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5)
    assert pilot.command(*takeoff) == mavlink.MAV_RESULT_ACCEPTED
    first = vehicle.lift_after_s
    pilot.fly_on(1.0)
    assert pilot.command(*takeoff) == mavlink.MAV_RESULT_ACCEPTED
    assert vehicle.lift_after_s == first
    pilot.wait(lambda: not vehicle.landed, 10.0)
    assert pilot.command(*takeoff) == mavlink.MAV_RESULT_FAILED


@pytest.mark.parametrize(
    ("mode", "keep_place", "result"),
    [
        (mavlink.COPTER_MODE_ALT_HOLD, 0.0, mavlink.MAV_RESULT_FAILED),
        (mavlink.COPTER_MODE_ALT_HOLD, 1.0, mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.COPTER_MODE_POSHOLD, 0.0, mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.COPTER_MODE_ZIGZAG, 0.0, mavlink.MAV_RESULT_ACCEPTED),
        (mavlink.COPTER_MODE_DRIFT, 0.0, mavlink.MAV_RESULT_FAILED),
    ],
)
def test_takeoff_result_depends_on_mode(mode: int, keep_place: float, result: int):
    vehicle, pilot = alone()
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    assert pilot.mode(mode) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    assert pilot.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, keep_place, 0, 0, 0, 5) is result


def test_takeoff_accepts_relative_altitude_frame_only():
    _, pilot = alone()
    for frame, result in (
        (0, mavlink.MAV_RESULT_DENIED),
        (6, mavlink.MAV_RESULT_DENIED),
        (3, mavlink.MAV_RESULT_FAILED),
    ):
        assert pilot.command_int(mavlink.MAV_CMD_NAV_TAKEOFF, {"frame": frame, "z": 5.0}) is result


@pytest.mark.parametrize(("direction", "sign"), [(0, 1.0), (1, 1.0), (-1, -1.0)])
def test_condition_yaw_turns_in_requested_direction(direction: int, sign: float):
    vehicle, pilot = airborne(8.0)
    assert pilot.command(mavlink.MAV_CMD_CONDITION_YAW, 90, 30, direction, 0) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(2.0)
    assert vehicle.est.yaw == pytest.approx(sign * math.radians(55.0), abs=math.radians(10.0))
    pilot.fly_on(9.0)
    assert wrap_pi(vehicle.est.yaw - math.pi / 2) == pytest.approx(0.0, abs=0.05)


def test_yaw_in_body_frame_is_relative_to_the_nose():
    vehicle, pilot = airborne(8.0)
    pilot.command(mavlink.MAV_CMD_CONDITION_YAW, 90, 0, 0, 0)
    pilot.fly_on(4.0)
    values = {"coordinate_frame": 9, "type_mask": 0x9F8, "yaw": 0.5}
    pilot.send("SET_POSITION_TARGET_LOCAL_NED", TARGET | values)
    pilot.fly_on(4.0)
    assert wrap_pi(vehicle.est.yaw - math.pi / 2 - 0.5) == pytest.approx(0.0, abs=0.05)


def test_reposition_requires_position_and_ignores_yaw():
    vehicle, pilot = airborne(8.0)
    place = START.offset(0.0, 15.0)
    target = {"frame": 3, "x": place.lat_e7, "y": place.lon_e7, "z": 8.0}
    for bad in ({"z": 0.0}, {"x": 0, "y": 0}, {"z": math.nan}, {"x": 950_000_000}):
        assert pilot.command_int(mavlink.MAV_CMD_DO_REPOSITION, target | bad) == mavlink.MAV_RESULT_DENIED
    assert pilot.command_int(mavlink.MAV_CMD_DO_REPOSITION, target | {"param4": 180.0}) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(5.0)
    assert vehicle.est.yaw == pytest.approx(math.pi / 2, abs=0.2), "the heading follows the direction of flight"


def test_velocity_target_is_accepted_in_any_frame_if_position_is_ignored():
    vehicle, pilot = airborne(8.0)
    for _ in range(10):
        values = {"coordinate_frame": 99, "type_mask": 0xDC7, "vx": 2.0, "lat_int": 2_000_000_000}
        pilot.send("SET_POSITION_TARGET_GLOBAL_INT", TARGET | values)
        pilot.fly_on(0.3)
    assert vehicle.body.vn == pytest.approx(2.0, abs=0.3)
    assert not any("Unknown mavlink" in text for text in pilot.texts)


@pytest.mark.parametrize("speed", [math.nan, 1001.0])
def test_implausible_velocity_stops_vehicle(speed: float):
    vehicle, pilot = airborne(8.0)
    for _ in range(10):
        pilot.send("SET_POSITION_TARGET_LOCAL_NED", TARGET | {"coordinate_frame": 1, "type_mask": 0xDC7, "vx": 3.0})
        pilot.fly_on(0.3)
    pilot.send("SET_POSITION_TARGET_LOCAL_NED", TARGET | {"coordinate_frame": 1, "type_mask": 0xDC7, "vx": speed})
    pilot.fly_on(2.9)
    assert math.hypot(vehicle.body.vn, vehicle.body.ve) < 0.5


def test_position_targets_have_no_effect_in_guided_nogps():
    vehicle, pilot = airborne(8.0)
    assert pilot.mode(mavlink.COPTER_MODE_GUIDED_NOGPS) == mavlink.MAV_RESULT_ACCEPTED
    pilot.go_to(30.0, 0.0, 8.0)
    pilot.fly_on(5.0)
    assert distance_m(vehicle, 0.0, 0.0) < 5.0


def test_repeated_mission_item_gets_invalid_sequence_and_upload_continues():
    vehicle, pilot = alone()
    pilot.send("MISSION_COUNT", TARGET | {"count": 2})
    pilot.expect("MISSION_REQUEST")
    for _ in range(2):
        pilot.send("MISSION_ITEM_INT", TARGET | {"seq": 0} | HOME)
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_INVALID_SEQUENCE
    pilot.read()
    pilot.send("MISSION_ITEM_INT", TARGET | {"seq": 1} | _waypoint(9.0))
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ACCEPTED
    assert len(vehicle.mission.items) == 2


def test_fence_upload_during_mission_upload_is_accepted():
    vehicle, pilot = alone()
    pilot.send("MISSION_COUNT", TARGET | {"count": 2})
    assert pilot.expect("MISSION_REQUEST").integer("mission_type") == 0
    circle = {"command": 5003, "frame": 0, "param1": 50.0, "x": START.lat_e7, "y": START.lon_e7}
    assert upload(pilot, 1, [circle]) == mavlink.MAV_MISSION_ACCEPTED
    for seq, item in enumerate((HOME, _waypoint(9.0))):
        pilot.send("MISSION_ITEM_INT", TARGET | {"seq": seq} | item)
        pilot.step()
    assert len(vehicle.mission.items) == 2


@pytest.mark.parametrize(("kind", "text"), [(1, "Fence upload timeout"), (2, "Rally upload timeout")])
def test_upload_timeout_text_names_the_list(kind: int, text: str):
    _, pilot = alone()
    pilot.send("MISSION_COUNT", TARGET | {"count": 1, "mission_type": kind})
    pilot.fly_on(9.0)
    assert text in pilot.texts


def test_current_mission_item_is_a_nav_command():
    vehicle, pilot = alone()
    upload(pilot, 0, [HOME, TAKEOFF, {"command": 178, "param2": 3.0}, _waypoint(9.0), {"command": 178, "param2": 3.0}])
    for chosen, current in ((0, 1), (2, 3)):
        assert pilot.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, chosen) == mavlink.MAV_RESULT_ACCEPTED
        assert vehicle.mission.current == current
    assert pilot.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 4) == mavlink.MAV_RESULT_FAILED, (
        "no navigation item follows item 4"
    )
    assert pilot.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 5) == mavlink.MAV_RESULT_DENIED
    pilot.send("MISSION_SET_CURRENT", TARGET | {"seq": 2})
    assert pilot.expect("MISSION_CURRENT").integer("seq") == 2, "the requested number is reported"


def test_mission_in_flight_is_not_cleared():
    vehicle, pilot = airborne(8.0)
    upload(pilot, 0, [HOME, _waypoint(60.0), _waypoint(90.0)])
    pilot.mode(mavlink.COPTER_MODE_AUTO)
    pilot.fly_on(1.0)
    pilot.read()
    pilot.send("MISSION_CLEAR_ALL", TARGET)
    assert pilot.expect("MISSION_ACK").integer("type") == mavlink.MAV_MISSION_ERROR
    assert len(vehicle.mission.items) == 3


def test_mission_items_are_validated_by_their_stored_fields():
    for item, result in (
        ({"command": 22, "frame": 99, "z": 9.0}, mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        ({"command": 20, "frame": 99, "z": math.nan}, mavlink.MAV_MISSION_ACCEPTED),
        ({"command": 201, "frame": 3, "x": 950_000_000}, mavlink.MAV_MISSION_INVALID_PARAM5_X),
        ({"command": 178, "frame": 99, "x": 950_000_000}, mavlink.MAV_MISSION_ACCEPTED),
        ({"command": 218, "param1": 9.0}, mavlink.MAV_MISSION_ACCEPTED),
    ):
        _, pilot = alone()
        assert upload(pilot, 0, [HOME, item]) == result, item


def test_waypoint_stores_only_its_delay_parameter():
    vehicle, pilot = alone()
    upload(pilot, 0, [HOME, _waypoint(9.0, frame=2, param1=2.7, param2=5.0, param3=1.0, param4=90.0)])
    item = vehicle.mission.items[1]
    assert (item.param1, item.param2, item.param3, item.param4, item.frame) == (2.0, 0.0, 0.0, 0.0, 0)


def test_stream_all_sets_all_sr_parameters():
    vehicle, pilot = alone()
    pilot.channel.port = 0
    pilot.send("REQUEST_DATA_STREAM", TARGET | {"req_stream_id": 0, "req_message_rate": 4, "start_stop": 1})
    rates = {name: value for name, value in vehicle.params.items() if name.startswith("SR0_")}
    assert {name for name, value in rates.items() if value != 4.0} == {"SR0_PARAMS"}


def test_spline_leg_stops_at_its_end():
    vehicle, pilot = airborne(10.0)
    upload(pilot, 0, [HOME, _waypoint(25.0, command=82)])
    pilot.mode(mavlink.COPTER_MODE_AUTO)
    took = pilot.wait(lambda: vehicle.mission.complete, 20.0)
    assert math.hypot(vehicle.est.vn, vehicle.est.ve) < 0.5
    assert took < 12.0
    pilot.fly_on(3.0)
    assert distance_m(vehicle, 25.0, 0.0) < 0.5


def test_target_during_pause_is_flown_on_resume():
    vehicle, pilot = airborne(8.0)
    assert pilot.command(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 0) == mavlink.MAV_RESULT_ACCEPTED
    pilot.go_to(15.0, 0.0, 8.0)
    pilot.fly_on(4.0)
    assert distance_m(vehicle, 0.0, 0.0) < 1.0
    assert pilot.command(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 1) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(9.0)
    assert distance_m(vehicle, 15.0, 0.0) < 1.0


@pytest.mark.parametrize("noise_m", [-0.4, 0.0])
def test_takeoff_to_no_altitude_fails(noise_m: float):
    vehicle, pilot = alone()
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    assert vehicle.home is not None
    set_home(vehicle, replace(vehicle.home, alt_m=vehicle.place.alt_m - noise_m))
    assert pilot.command(mavlink.MAV_CMD_NAV_TAKEOFF) == mavlink.MAV_RESULT_FAILED


STORED_AS = [
    ((21, 3.7, 8.0, 9.0, 180.0), (3, 0, 0, 1)),
    ((21, 0.0, 0.0, 0.0, -90.0), (0, 0, 0, -1)),
    ((21, 0.0, 0.0, 0.0, math.nan), (0, 0, 0, 1)),
    ((177, 1.0, 2.9, 7.0, 7.0), (1, 2, 0, 0)),
    ((177, 1.0, -1.0), (1, -1, 0, 0)),
    ((177, 1.0, 1e6), (1, 32767, 0, 0)),
    ((17, 5.0, 0.0, -12.5, 3.0), (0, 0, -12, 0)),
    ((18, 300.0, 5.0, -12.5, 0.5), (255, 0, -12, 1)),
    ((18, 0.5, 0.0, 1234.0), (0.5, 0, 1230, 0)),
    ((19, 2.9, 5.0, 0.0, 0.0), (2, 0, 1, 0)),
    ((31, 1.0, -20.5, 3.0, 1.0), (0, -20, 0, 1)),
    (
        (
            94,
            1.239,
        ),
        (1.23, 0, 0, 0),
    ),
    ((92, 1.0, 2.0), (1, 0, 0, 0)),
    ((223, 2.0, -1.0, 1.5), (1, 0, 1.5, 0)),
    ((115, 90.0, 20.0, -1.0, 1.0), (90, 20, -1, 1)),
]


@pytest.mark.parametrize(("sent", "stored"), STORED_AS, ids=lambda value: "-".join(map(str, value)))
def test_mission_item_parameters_are_stored_like_on_a_real_autopilot(sent, stored):
    _, pilot = alone()
    command, *params = sent
    item = _waypoint(5.0, command=command, **{f"param{at}": value for at, value in enumerate(params, start=1)})
    assert upload(pilot, 0, [HOME, item]) == mavlink.MAV_MISSION_ACCEPTED
    pilot.send("MISSION_REQUEST_INT", TARGET | {"seq": 1})
    message = pilot.expect("MISSION_ITEM_INT")
    assert [message.real(f"param{at}") for at in range(1, 5)] == pytest.approx(stored, abs=1e-4)


def test_mission_item_altitude_is_stored_in_whole_centimetres():
    _, pilot = alone()
    assert upload(pilot, 0, [HOME, _waypoint(5.0, z=12.349), _waypoint(6.0, z=0.29)]) == mavlink.MAV_MISSION_ACCEPTED
    for seq, altitude_m in ((1, 12.34), (2, 0.29)):
        pilot.send("MISSION_REQUEST_INT", TARGET | {"seq": seq})
        assert pilot.expect("MISSION_ITEM_INT").real("z") == pytest.approx(altitude_m, abs=1e-6)


@pytest.mark.parametrize("command", [84, 85, 92, 94, 194, 215, 223, 42702, 42703])
def test_mission_command_is_stored(command: int):
    vehicle, pilot = alone()
    assert upload(pilot, 0, [HOME, _waypoint(5.0, command=command)]) == mavlink.MAV_MISSION_ACCEPTED
    assert vehicle.mission.items[1].command == command


def test_mission_with_commands_without_effect_is_flown_to_its_end():
    vehicle, pilot = alone()
    passed = [92, 94, 194, 215, 223, 42600]
    items = [
        {"command": 84, "frame": 3, "z": 5.0},
        *({"command": command, "frame": 3, "z": 5.0} for command in passed),
        {"command": 42702, "param1": 1.0, "param2": 2.0},
        {"command": 42703, "param1": 2.0},
        {"command": 85, "frame": 3},
    ]
    upload(pilot, 0, [HOME, *items])
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.wait(lambda: not arming_refusals(vehicle), 5.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    before = len(pilot.texts)
    assert pilot.command(mavlink.MAV_CMD_MISSION_START) == mavlink.MAV_RESULT_ACCEPTED
    took_s = pilot.wait(lambda: not vehicle.armed, 60.0)
    assert took_s > 4.0
    titles = [text.split()[-1] for text in pilot.texts[before:] if text.startswith("Mission")]
    assert [title for title in titles if title.startswith(("VTOL", "Guided", "Nav", "Payload"))] == [
        *("VTOLTakeoff", "VTOLTakeoff", "GuidedEnable", "PayloadPlace", "NavScriptTime", "NavAttitudeTime"),
        "VTOLLand",
    ]


@pytest.mark.parametrize("name", ["wpnav_speed", "WpNav_Speed"])
def test_parameter_names_are_case_insensitive(name: str):
    vehicle, pilot = alone()
    pilot.send("PARAM_REQUEST_READ", TARGET | {"param_id": name.encode("ascii"), "param_index": -1})
    assert pilot.expect("PARAM_VALUE").text("param_id") == name, "a reader gets the spelling that it requested"
    pilot.send("PARAM_SET", TARGET | {"param_id": name.encode("ascii"), "param_value": 345.0, "param_type": 9})
    reply = pilot.expect("PARAM_VALUE")
    assert (reply.text("param_id"), reply.real("param_value")) == ("WPNAV_SPEED", 345.0)
    assert vehicle.params["WPNAV_SPEED"] == 345.0


def test_list_of_logs_is_empty():
    _, pilot = alone()
    pilot.send("LOG_REQUEST_LIST", TARGET | {"start": 0, "end": 65535})
    entry = pilot.expect("LOG_ENTRY")
    assert [entry.integer(name) for name in ("id", "num_logs", "last_log_num", "size")] == [0, 0, 0, 0]


def test_relay_status_contains_enabled_relays_and_their_state():
    _, pilot = alone(RELAY3_FUNCTION=1)

    def relays() -> tuple[int, int]:
        pilot.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_RELAY_STATUS)
        status = pilot.last["RELAY_STATUS"]
        return status.integer("present"), status.integer("on")

    assert relays() == (0b101, 0)
    pilot.command(mavlink.MAV_CMD_DO_SET_RELAY, 2, 1)
    assert relays() == (0b101, 0b100)
    pilot.command(mavlink.MAV_CMD_DO_SET_RELAY, 2, 0)
    assert relays() == (0b101, 0)


def test_wind_is_part_of_the_extra3_stream_once_the_position_is_known():
    vehicle, pilot = alone(SIM_WIND_SPD=3.0)
    values = {"req_stream_id": mavlink.MAV_DATA_STREAM_EXTRA3, "req_message_rate": 4, "start_stop": 1}
    pilot.send("REQUEST_DATA_STREAM", TARGET | values)
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    assert "WIND" not in pilot.last
    assert pilot.expect("WIND").real("speed") == 3.0


def test_origin_is_sent_with_every_new_home():
    vehicle, pilot = alone()
    pilot.wait(lambda: vehicle.position_ok, 5.0)
    origin = pilot.last["GPS_GLOBAL_ORIGIN"]
    assert origin.integer("latitude") == START.lat_e7
    del pilot.last["GPS_GLOBAL_ORIGIN"]
    pilot.command(mavlink.MAV_CMD_DO_SET_HOME, 1.0)
    assert "GPS_GLOBAL_ORIGIN" in pilot.last
