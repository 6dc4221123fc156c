"""Data that the vehicle stores: parameters on disk, and missions, fences and signing keys across a reboot."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
from fractus_runtime.mavlink_codec import Endpoint
from fractus_vehicle.params import Parameters, UnknownParameterError, table
from fractus_vehicle.readiness import arming_refusals
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_world import CONFIG, START, airborne, alone, upload

FENCE = {"command": 5003, "param1": 80.0, "frame": 0, "x": START.lat_e7, "y": START.lon_e7}


def test_parameter_table_is_consistent():
    names = [row.name for row in table()]
    assert len(names) == len(set(names)) == 1397
    assert names[0] == "FORMAT_VERSION"
    assert all(0 < len(name) <= 16 for name in names)


def test_parameter_values_are_converted_to_their_type():
    params = Parameters()
    assert params.set("RTL_ALT", 1234.6)
    assert params["RTL_ALT"] == 1234.0
    assert params.set("RTL_ALT", -3.995)
    assert params["RTL_ALT"] == -4.0
    assert params.set("FS_GCS_ENABLE", 1000.0)
    assert params["FS_GCS_ENABLE"] == 127.0
    assert not params.set("RTL_ALT", float("nan"))
    assert not params.set("NO_SUCH", 1.0)
    assert not params.set("SYSID_THISMAV", 7.0)
    with pytest.raises(UnknownParameterError):
        params.assign("NO_SUCH", 1.0)


def test_denied_parameter_write_is_reported_and_nan_is_ignored():
    vehicle, pilot = alone()
    assert pilot.parameter("MIS_TOTAL", 9.0) == 0.0
    assert pilot.texts[-1] == "Param write denied (MIS_TOTAL)"
    target = {"target_system": 1, "target_component": 1, "param_id": b"WPNAV_SPEED", "param_type": 9}
    pilot.last.clear()
    pilot.send("PARAM_SET", target | {"param_value": float("nan")})
    pilot.fly_on(0.1)
    assert "PARAM_VALUE" not in pilot.last
    assert vehicle.params["WPNAV_SPEED"] == 1000.0


def test_changed_parameters_are_stored_on_disk(tmp_path: Path):
    store = tmp_path / "vehicle.parm"
    config = replace(CONFIG, store=store)
    _, pilot = alone(config=config)
    assert pilot.parameter("WPNAV_SPEED", 750.0) == 750.0
    rebooted, _ = alone(config=config)
    assert rebooted.params["WPNAV_SPEED"] == 750.0
    assert rebooted.control.limits.speed_mps == 7.5
    assert "WPNAV_SPEED,750" in store.read_text()


def test_parameter_names_of_later_releases_are_accepted():
    vehicle, pilot = alone()
    pilot.parameter("MAV_GCS_SYSID", 42)
    assert vehicle.params["SYSID_MYGCS"] == 42.0
    assert pilot.last["PARAM_VALUE"].text("param_id") == "MAV_GCS_SYSID"


def test_reboot_keeps_stored_data_and_resets_the_rest():
    vehicle, pilot = alone()
    pilot.parameter("WPNAV_SPEED", 750.0)
    assert upload(pilot, 1, [FENCE]) == 0
    pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 100_000)
    assert pilot.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == mavlink.MAV_RESULT_ACCEPTED
    pilot.fly_on(0.1)
    rebooted = pilot.craft.vehicle.state
    assert rebooted is not vehicle
    assert rebooted.params["WPNAV_SPEED"] == 750.0
    assert len(rebooted.fence.shapes) == 1
    assert pilot.channel.streams.keys() == {"HEARTBEAT"}
    pilot.wait(lambda: not arming_refusals(rebooted), 10.0)


def test_erased_parameters_are_reset_on_next_boot():
    vehicle, pilot = alone()
    pilot.parameter("WPNAV_SPEED", 750.0)
    assert pilot.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 2) == mavlink.MAV_RESULT_ACCEPTED
    assert vehicle.params["WPNAV_SPEED"] == 750.0
    pilot.parameter("RTL_ALT", 2500.0)
    pilot.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1)
    pilot.fly_on(0.1)
    rebooted = pilot.craft.vehicle.state
    assert rebooted.params["WPNAV_SPEED"] == Parameters()["WPNAV_SPEED"]
    assert rebooted.params["RTL_ALT"] == 2500.0


def test_reboot_is_refused_in_flight():
    vehicle, pilot = airborne(5.0)
    assert pilot.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == mavlink.MAV_RESULT_FAILED
    pilot.fly_on(0.1)
    assert pilot.craft.vehicle.state is vehicle


def test_signing_rejects_clients_without_key():
    _, pilot = alone()
    key = hashlib.sha256(b"secret").digest()
    target = {"target_system": 1, "target_component": 1}
    pilot.send("SETUP_SIGNING", target | {"secret_key": tuple(key), "initial_timestamp": 5_000})
    pilot.fly_on(0.1)
    order = target | {"command": 512, "param1": 0.0}

    def station(signing_key: bytes | None, timestamp: int = 0) -> Endpoint:
        endpoint = Endpoint(255, 190)
        endpoint.set_signing(signing_key, timestamp)
        return endpoint

    def answers(endpoint: Endpoint) -> bool:
        pilot.channel.take()
        pilot.craft.receive(pilot.channel, endpoint.encode("COMMAND_LONG", order))
        pilot.simulation.step()
        read = station(key).decode(pilot.channel.take())
        return any(message.name == "COMMAND_ACK" and message.signed for message in read)

    assert not answers(station(None))
    assert not answers(station(hashlib.sha256(b"other").digest(), 9_000))
    mine = station(key, 9_000)
    assert answers(mine)
    assert not answers(station(key, 8_000)), "a message with an earlier timestamp is rejected as a replay"
    assert answers(mine)
    assert pilot.craft.vehicle.signing_key == key
