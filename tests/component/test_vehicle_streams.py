"""Telemetry streams: groups, intervals, stopping, and the send queue of a client that does not read."""

from __future__ import annotations

import itertools

import pytest
from fractus_services.mavlink_server.channel import OUTBOX_LIMIT, Channel
from fractus_services.mavlink_server.stream_groups import ALL_GROUPS, GROUPS
from fractus_vehicle.streams import BUILDERS
from fractus_vehicle.telemetry import send
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_world import airborne, alone


@pytest.mark.parametrize("interval_us", [10_000, 20_000, 30_000, 33_333, 100_000, 250_000, 1_000_000])
def test_message_intervals_are_exact_in_whole_milliseconds(interval_us: int):
    interval_ms = interval_us // 1000
    vehicle, pilot = alone()
    assert pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, interval_us) == mavlink.MAV_RESULT_ACCEPTED
    times = []
    for _ in range(3000):
        times += [m.integer("time_boot_ms") for m in pilot.step() if m.name == "ATTITUDE"]
    assert len(times) == pytest.approx(30e3 / interval_ms, abs=4)
    gaps = {later - earlier for earlier, later in itertools.pairwise(times)}
    assert all(abs(gap - interval_ms) <= 10.0 for gap in gaps)
    if interval_ms % 10 == 0:
        assert gaps == {interval_ms}
    assert vehicle.time_s >= 30.0


def test_all_streams_at_4_hz_produce_measured_rate():
    _, pilot = airborne(5.0)
    pilot.send(
        "REQUEST_DATA_STREAM", {"target_system": 1, "target_component": 1, "req_message_rate": 4, "start_stop": 1}
    )
    count = sum(len(pilot.step()) for _ in range(1000)) / 10.0
    assert count == pytest.approx(107.0, rel=0.2)


def test_stream_can_be_stopped_and_unknown_message_is_denied():
    _, pilot = alone()
    pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 100_000)
    pilot.fly_on(1.0)
    assert pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, -1) == mavlink.MAV_RESULT_ACCEPTED
    pilot.last.clear()
    pilot.fly_on(2.0)
    assert pilot.last.keys() <= {"HEARTBEAT", "STATUSTEXT", "HOME_POSITION", "GPS_GLOBAL_ORIGIN"}
    assert pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 9999, 1000) == mavlink.MAV_RESULT_DENIED
    assert pilot.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 9999) == mavlink.MAV_RESULT_FAILED
    assert pilot.command(mavlink.MAV_CMD_REQUEST_MESSAGE, float("nan")) == mavlink.MAV_RESULT_FAILED


@pytest.mark.parametrize("name", sorted(BUILDERS))
def test_every_telemetry_message_is_built_in_every_phase(name: str):
    for vehicle, pilot in (alone(), airborne(5.0, FENCE_ENABLE=1)):
        pilot.read()
        if send(vehicle, pilot.channel, name):
            assert pilot.read()[-1].name == name
        else:
            assert BUILDERS[name](vehicle) is None


def test_stream_groups_contain_known_messages_once():
    names = [name for number in ALL_GROUPS for name in GROUPS[number][1]]
    assert len(names) == len(set(names))
    assert set(names) <= set(BUILDERS)


def test_default_streams_follow_sr_parameters():
    vehicle, pilot = alone(SR0_POSITION=5)
    channel = pilot.craft.open("second", port=0)
    pilot.fly_on(4.0)
    frames = channel.take()
    assert frames.count(bytes((33, 0, 0))) >= 15
    assert "LOCAL_POSITION_NED" in channel.streams
    assert vehicle.channels[0].streams.keys() == {"HEARTBEAT"}


def test_client_that_does_not_read_has_bounded_queue():
    vehicle, pilot = alone()
    blocked = pilot.craft.open("blocked")
    for name in BUILDERS:
        blocked.set_interval(name, 0.01)
    pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 100_000)
    received = 0
    for _ in range(3000):
        received += sum(m.name == "ATTITUDE" for m in pilot.step())
    assert received == pytest.approx(300, abs=2)
    assert blocked.waiting <= OUTBOX_LIMIT
    assert blocked.dropped > 1000
    assert isinstance(vehicle.channels[1], Channel)
