"""VehicleSelector: selection of the drone's own vehicle among the vehicles on its link."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from fractus_runtime.mavlink_codec import Endpoint, Message, Parser
from fractus_services.mobility.mavlink.vehicle_identification import (
    CONFIRM_AFTER_S,
    FORGET_AFTER_S,
    SELECT_AFTER_S,
    KnownVehicleFile,
    VehicleSelector,
)
from pymavlink.dialects.v20 import ardupilotmega as mavlink

URL = "udpin:127.0.0.1:14550"


def heartbeat(sysid: int, compid: int = 1, *, kind: int = mavlink.MAV_TYPE_QUADROTOR, armed: bool = False) -> Message:
    values = {
        "type": kind,
        "autopilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        "base_mode": mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0,
    }
    (message,) = Parser().feed(Endpoint(sysid, compid).encode("HEARTBEAT", values))
    return message


def known_file(directory: Path, url: str = URL) -> KnownVehicleFile:
    return KnownVehicleFile(directory / "vehicle.json", url)


async def stored(file: KnownVehicleFile) -> None:
    assert file._storing is not None
    async with asyncio.timeout(10):
        await file._storing


def test_selected_vehicle_on_the_ground_is_replaced_only_before_confirmation() -> None:
    selector = VehicleSelector()
    assert selector.select(heartbeat(1), 0.0, flying=False)
    assert not selector.problem(heartbeat(1), CONFIRM_AFTER_S - 0.1)
    assert not selector.select(heartbeat(2), 20.0, flying=True)
    assert selector.select(heartbeat(2), 21.0, flying=False)
    assert not selector.problem(heartbeat(2), 21.1 + CONFIRM_AFTER_S)
    assert not selector.select(heartbeat(1), 40.0, flying=False)
    assert "waiting for the drone's own (system 2)" in selector.problem(heartbeat(1), 40.0)
    assert selector.select(heartbeat(2), 41.0, flying=False)


def test_other_vehicles_are_a_problem_until_they_are_silent() -> None:
    selector = VehicleSelector()
    assert selector.select(heartbeat(1), 0.0, flying=False)
    assert "systems 2, 3" in (selector.problem(heartbeat(3), 1.0) and selector.problem(heartbeat(2), 2.0))
    assert "systems 2)" in selector.problem(heartbeat(1), 1.5 + FORGET_AFTER_S)
    assert not selector.problem(heartbeat(1), 2.5 + FORGET_AFTER_S)


async def test_unknown_vehicle_is_selected_and_stored_after_it_was_alone(tmp_path: Path) -> None:
    known = known_file(tmp_path)
    selector = VehicleSelector(known)
    assert not selector.select(heartbeat(7), 0.0, flying=False)
    assert not selector.problem(heartbeat(7), 0.0), "a single vehicle on the link is not a problem"
    assert not selector.select(heartbeat(7), SELECT_AFTER_S - 0.1, flying=False)
    assert selector.select(heartbeat(7), SELECT_AFTER_S, flying=False)
    assert not selector.problem(heartbeat(7), SELECT_AFTER_S + CONFIRM_AFTER_S)
    assert known.own is None, "the vehicle is not stored yet, because another vehicle may appear"
    assert not selector.problem(heartbeat(7), SELECT_AFTER_S + CONFIRM_AFTER_S + 0.1)
    await stored(known)
    restarted = VehicleSelector(known_file(tmp_path))
    assert not restarted.select(heartbeat(8), 0.0, flying=False)
    assert not restarted.select(heartbeat(8), 3600.0, flying=False), "an unknown vehicle is ignored on the ground, too"
    assert "MAVLink system 8" in restarted.problem(heartbeat(8), 3600.0)
    assert restarted.select(heartbeat(7, armed=True), 3600.5, flying=False)
    assert "systems 8)" in restarted.problem(heartbeat(7), 3600.5)
    assert known_file(tmp_path, "serial:/dev/ttyACM0:115200").own is None


async def test_vehicle_that_is_armed_while_alone_is_stored_at_once(tmp_path: Path) -> None:
    selector = VehicleSelector(known_file(tmp_path))
    for at in (0.0, SELECT_AFTER_S):
        selector.select(heartbeat(7), at, flying=False)
    known = selector._file
    assert known is not None
    selector.problem(heartbeat(7, armed=True), SELECT_AFTER_S + 1.0)
    await stored(known)
    assert known_file(tmp_path).own == (7, 1)


def test_no_vehicle_is_selected_among_several_unknown_vehicles(tmp_path: Path) -> None:
    selector = VehicleSelector(known_file(tmp_path))
    for at in range(20):
        assert not selector.select(heartbeat(1 + at % 2), float(at), flying=False) or at < SELECT_AFTER_S
        assert at == 0 or "systems 1, 2" in selector.problem(heartbeat(1), float(at))
    assert not selector.select(heartbeat(1), 27.0, flying=False)
    assert selector.select(heartbeat(1), 19.0 + FORGET_AFTER_S, flying=False)


def test_unknown_armed_vehicle_is_not_selected(tmp_path: Path) -> None:
    selector = VehicleSelector(known_file(tmp_path))
    for at in (0.0, 60.0):
        assert not selector.select(heartbeat(7, armed=True), at, flying=False)
    assert "armed" in selector.problem(heartbeat(7, armed=True), 60.0)
    selector.select(heartbeat(7), 61.0, flying=False)
    assert selector.select(heartbeat(7), 61.0 + SELECT_AFTER_S, flying=False)
    assert not selector.problem(heartbeat(7), 61.0 + SELECT_AFTER_S)


def test_autopilot_with_another_component_id_is_a_problem(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    selector = VehicleSelector(known_file(tmp_path))
    assert not selector.select(heartbeat(1, 154, kind=mavlink.MAV_TYPE_GIMBAL), 0.0, flying=False)
    assert not selector.problem(heartbeat(1, 154, kind=mavlink.MAV_TYPE_GIMBAL), 0.0)
    assert not selector.select(heartbeat(1, 25), 1.0, flying=False)
    assert "reports as component 25 of MAVLink system 1" in selector.problem(heartbeat(1, 25), 1.0)
    assert "component 25" in caplog.text
    selector.select(heartbeat(1), 2.0, flying=False)
    assert selector.select(heartbeat(1), 2.0 + SELECT_AFTER_S, flying=False)
    assert not selector.problem(heartbeat(1, 25), 6.0)


def test_unreadable_file_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "vehicle.json").write_text("{")
    assert known_file(tmp_path).own is None
    assert "cannot read which vehicle" in caplog.text


async def test_failed_write_is_logged_once_and_repeated(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    known = KnownVehicleFile(tmp_path / "state" / "vehicle.json", URL)
    for _ in range(2):
        known.keep((7, 1))
        await stored(known)
    assert caplog.text.count("cannot store the drone's own vehicle yet") == 1
    (tmp_path / "state").mkdir()
    known.keep((7, 1))
    await stored(known)
    assert KnownVehicleFile(tmp_path / "state" / "vehicle.json", URL).own == (7, 1)
