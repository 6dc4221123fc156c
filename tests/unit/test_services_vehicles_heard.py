"""Which vehicle on a link is the drone's own."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from fractus_runtime.mavlink_codec import Endpoint, Message, Parser
from fractus_services.mobility.mavlink.neighbours import CHOICE_S, GONE_S, SURE_S, Memory, Neighbours
from pymavlink.dialects.v20 import ardupilotmega as mavlink

URL = "udpin:127.0.0.1:14550"


def heartbeat(sysid: int, compid: int = 1, *, kind: int = mavlink.MAV_TYPE_QUADROTOR, armed: bool = False) -> Message:
    values = {
        "type": kind,
        "autopilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        "base_mode": mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0,
    }
    (heard,) = Parser().feed(Endpoint(sysid, compid).encode("HEARTBEAT", values))
    return heard


def memory(directory: Path, url: str = URL) -> Memory:
    return Memory(directory / "vehicle.json", url)


async def stored(found: Memory) -> None:
    assert found._storing is not None
    async with asyncio.timeout(10):
        await found._storing


def test_another_vehicle_takes_the_place_of_one_that_was_not_alone_for_long_and_stands() -> None:
    link = Neighbours()
    assert link.finds(heartbeat(1), 0.0, flying=False)
    assert not link.problem(heartbeat(1), SURE_S - 0.1)
    assert not link.finds(heartbeat(2), 20.0, flying=True)
    assert link.finds(heartbeat(2), 21.0, flying=False)
    assert not link.problem(heartbeat(2), 21.1 + SURE_S)
    assert not link.finds(heartbeat(1), 40.0, flying=False)
    assert "the drone's own (system 2) is waited for" in link.problem(heartbeat(1), 40.0)
    assert link.finds(heartbeat(2), 41.0, flying=False)


def test_others_are_told_until_they_are_gone() -> None:
    link = Neighbours()
    assert link.finds(heartbeat(1), 0.0, flying=False)
    assert "systems 2, 3" in (link.problem(heartbeat(3), 1.0) and link.problem(heartbeat(2), 2.0))
    assert "systems 2)" in link.problem(heartbeat(1), 1.5 + GONE_S)
    assert not link.problem(heartbeat(1), 2.5 + GONE_S)


async def test_a_vehicle_is_chosen_and_remembered_after_it_was_alone(tmp_path: Path) -> None:
    known = memory(tmp_path)
    link = Neighbours(known)
    assert not link.finds(heartbeat(7), 0.0, flying=False)
    assert not link.problem(heartbeat(7), 0.0), "it is no other one than the drone's own"
    assert not link.finds(heartbeat(7), CHOICE_S - 0.1, flying=False)
    assert link.finds(heartbeat(7), CHOICE_S, flying=False)
    assert not link.problem(heartbeat(7), CHOICE_S + SURE_S)
    assert known.own is None, "another one may still appear"
    assert not link.problem(heartbeat(7), CHOICE_S + SURE_S + 0.1)
    await stored(known)
    again = Neighbours(memory(tmp_path))
    assert not again.finds(heartbeat(8), 0.0, flying=False)
    assert not again.finds(heartbeat(8), 3600.0, flying=False), "on the ground, too: it is a stranger"
    assert "MAVLink system 8" in again.problem(heartbeat(8), 3600.0)
    assert again.finds(heartbeat(7, armed=True), 3600.5, flying=False)
    assert "systems 8)" in again.problem(heartbeat(7), 3600.5)
    assert memory(tmp_path, "serial:/dev/ttyACM0:115200").own is None


async def test_one_that_was_armed_here_is_remembered_at_once(tmp_path: Path) -> None:
    link = Neighbours(memory(tmp_path))
    for at in (0.0, CHOICE_S):
        link.finds(heartbeat(7), at, flying=False)
    known = link._memory
    assert known is not None
    link.problem(heartbeat(7, armed=True), CHOICE_S + 1.0)
    await stored(known)
    assert memory(tmp_path).own == (7, 1)


def test_of_several_unknown_vehicles_none_is_taken(tmp_path: Path) -> None:
    link = Neighbours(memory(tmp_path))
    for at in range(20):
        assert not link.finds(heartbeat(1 + at % 2), float(at), flying=False) or at < CHOICE_S
        assert at == 0 or "systems 1, 2" in link.problem(heartbeat(1), float(at))
    assert not link.finds(heartbeat(1), 27.0, flying=False)
    assert link.finds(heartbeat(1), 19.0 + GONE_S, flying=False)


def test_an_unknown_vehicle_that_flies_is_left_alone(tmp_path: Path) -> None:
    link = Neighbours(memory(tmp_path))
    for at in (0.0, 60.0):
        assert not link.finds(heartbeat(7, armed=True), at, flying=False)
    assert "running motors" in link.problem(heartbeat(7, armed=True), 60.0)
    link.finds(heartbeat(7), 61.0, flying=False)
    assert link.finds(heartbeat(7), 61.0 + CHOICE_S, flying=False)
    assert not link.problem(heartbeat(7), 61.0 + CHOICE_S)


def test_an_autopilot_with_another_component_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    link = Neighbours(memory(tmp_path))
    assert not link.finds(heartbeat(1, 154, kind=mavlink.MAV_TYPE_GIMBAL), 0.0, flying=False)
    assert not link.problem(heartbeat(1, 154, kind=mavlink.MAV_TYPE_GIMBAL), 0.0)
    assert not link.finds(heartbeat(1, 25), 1.0, flying=False)
    assert "heard as component 25 of MAVLink system 1" in link.problem(heartbeat(1, 25), 1.0)
    assert "component 25" in caplog.text
    link.finds(heartbeat(1), 2.0, flying=False)
    assert link.finds(heartbeat(1), 2.0 + CHOICE_S, flying=False)
    assert not link.problem(heartbeat(1, 25), 6.0)


def test_a_torn_memory_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "vehicle.json").write_text("{")
    assert memory(tmp_path).own is None
    assert "is forgotten" in caplog.text


async def test_a_vehicle_that_cannot_be_stored_is_stored_later(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    known = Memory(tmp_path / "state" / "vehicle.json", URL)
    for _ in range(2):
        known.keep((7, 1))
        await stored(known)
    assert caplog.text.count("cannot be stored yet") == 1
    (tmp_path / "state").mkdir()
    known.keep((7, 1))
    await stored(known)
    assert Memory(tmp_path / "state" / "vehicle.json", URL).own == (7, 1)
