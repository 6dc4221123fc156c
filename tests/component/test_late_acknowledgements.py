"""Commands over links so slow that an answer takes longer than a fast link's is waited for."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest
from fractus_runtime.mavlink_codec import Message
from fractus_services.errors import AutopilotError
from mobility_world import GUIDED, LAND, LOITER, RTL, Plane, World, spec
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import fly

MODE = mavlink.MAV_CMD_DO_SET_MODE
SPEED = mavlink.MAV_CMD_DO_CHANGE_SPEED


def slow(plane: Plane, each_way_s: float) -> None:
    plane.uplink_s = plane.downlink_s = each_way_s


async def measured(plane: Plane, each_way_s: float) -> None:
    """Wait until the service knows the delay of a link."""
    slow(plane, each_way_s)
    while not 2 * each_way_s <= plane.downlink_latency_s < math.inf:
        await plane.update(0.1)


@pytest.mark.parametrize("each_way_s", [0.4, 1.0, 1.4])
def test_a_command_is_sent_once_over_a_slow_link(tmp_path: Path, each_way_s: float) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            await measured(plane, each_way_s)
            plane.commands.clear()
            began = plane.now
            await plane.set_speed(5.0)
            assert plane.commands.count(SPEED) == 1
            assert plane.now - began == pytest.approx(2 * each_way_s)

    fly(flight)


@pytest.mark.parametrize("each_way_s", [0.4, 1.0, 1.5])
@pytest.mark.parametrize("refused_first", [True, False])
def test_answers_to_what_was_sent_again_are_not_for_the_next_command(
    tmp_path: Path, each_way_s: float, refused_first: bool
) -> None:
    """The link has become slow just now: the first command is sent again, or given up, as the delay is not measured."""

    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            slow(plane, each_way_s)
            plane.commands.clear()
            plane.refuses = {SPEED} if refused_first else set()
            first = asyncio.ensure_future(plane.set_speed(5.0))
            await asyncio.wait([first])
            assert was_refused(first) == (refused_first and each_way_s < 1.5)
            # What is still under way of the first command arrives before the second one.
            asyncio.get_running_loop().call_later(each_way_s - 0.05, plane.refuses.symmetric_difference_update, {SPEED})
            second = asyncio.ensure_future(plane.set_speed(6.0))
            await asyncio.wait([second])
            assert plane.commands.count(SPEED) > 2
            assert was_refused(second) != refused_first

    fly(flight)


def test_acknowledgements_measure_a_slow_link_to_a_vehicle_that_answers_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            hear = plane._hear
            monkeypatch.setattr(plane, "_hear", lambda sent: None if sent.name == "TIMESYNC" else hear(sent))
            slow(plane, 0.5)
            await asyncio.sleep(20.0)
            assert plane.timing.unanswering
            assert 1.0 <= plane.downlink_latency_s < 1.1

    fly(flight)


def was_refused(command: asyncio.Future[None]) -> bool:
    error = command.exception()
    return isinstance(error, AutopilotError) and error.refused


def test_a_change_of_mode_waits_for_none_that_is_not_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The way home is flown as soon as it is asked for, and what it overtakes is not sent again behind it."""

    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            heard: list[tuple[float, float]] = []
            await measured(plane, 1.0)
            hear = plane._hear
            lost = [LOITER, RTL]

            def listen(outgoing: Message) -> None:
                if outgoing.values.get("command") == MODE:
                    heard.append((plane.now, outgoing.real("param2")))
                    if lost:
                        lost.pop()
                        return
                hear(outgoing)

            monkeypatch.setattr(plane, "_hear", listen)
            began = plane.now
            first = asyncio.ensure_future(plane.set_mode(LOITER))
            await asyncio.sleep(0.1)
            await plane.set_mode(RTL)
            await asyncio.wait([first])
            assert isinstance(first.exception(), AutopilotError)
            assert heard[1] == (pytest.approx(began + 1.1), plane.stack.mode_parameters(RTL)[0])
            assert [number for _, number in heard[1:]] == [heard[1][1]] * len(heard[1:]), "nothing undoes it"
            assert plane.vehicle.mode == RTL

    fly(flight)


def test_a_slow_link_brings_the_drone_down(tmp_path: Path) -> None:
    """A flight over a link that becomes as slow as one and a half seconds each way: the driver's grant ends, and it comes home."""

    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            plane = world.plane
            await world.up(grant)
            slow(plane, 1.5)
            await asyncio.sleep(5.0)
            assert plane.vehicle.mode == GUIDED
            plane.commands.clear()
            world.grants.remove(grant)
            await world.until(lambda: not plane.vehicle.armed)
            assert plane.commands.count(MODE) <= 2, "each is sent once"
            assert plane.vehicle.mode in {RTL, LAND}

    fly(flight)
