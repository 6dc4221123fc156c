"""Commands over links with a delay above the acknowledgement timeout of a fast link."""

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


def set_delay(plane: Plane, one_way_s: float) -> None:
    plane.uplink_s = plane.downlink_s = one_way_s


async def wait_until_measured(plane: Plane, one_way_s: float) -> None:
    """Wait until the service knows the delay of a link."""
    set_delay(plane, one_way_s)
    while not 2 * one_way_s <= plane.downlink_latency_s < math.inf:
        await plane.update(0.1)


@pytest.mark.parametrize("one_way_s", [0.4, 1.0, 1.4])
def test_command_is_sent_once_over_a_slow_link(tmp_path: Path, one_way_s: float) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            await wait_until_measured(plane, one_way_s)
            plane.commands.clear()
            began = plane.now
            await plane.set_speed(5.0)
            assert plane.commands.count(SPEED) == 1
            assert plane.now - began == pytest.approx(2 * one_way_s)

    fly(flight)


@pytest.mark.parametrize("one_way_s", [0.4, 1.0, 1.5])
@pytest.mark.parametrize("refused_first", [True, False])
def test_late_acknowledgements_are_not_assigned_to_the_next_command(
    tmp_path: Path, one_way_s: float, refused_first: bool
) -> None:
    """The link has just become slow.

    The service has not measured the delay yet. It repeats the first command, or gives it up.
    """

    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            set_delay(plane, one_way_s)
            plane.commands.clear()
            plane.refuses = {SPEED} if refused_first else set()
            first = asyncio.ensure_future(plane.set_speed(5.0))
            await asyncio.wait([first])
            assert was_refused(first) == (refused_first and one_way_s < 1.5)
            # All transmissions of the first command arrive before the second command, so they get the first result.
            asyncio.get_running_loop().call_later(one_way_s - 0.05, plane.refuses.symmetric_difference_update, {SPEED})
            second = asyncio.ensure_future(plane.set_speed(6.0))
            await asyncio.wait([second])
            assert plane.commands.count(SPEED) > 2
            assert was_refused(second) != refused_first

    fly(flight)


def test_delay_is_measured_by_acknowledgements_without_timesync(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            receive = plane._receive
            monkeypatch.setattr(plane, "_receive", lambda sent: None if sent.name == "TIMESYNC" else receive(sent))
            set_delay(plane, 0.5)
            await asyncio.sleep(20.0)
            assert plane.timing.unanswering
            assert 1.0 <= plane.downlink_latency_s < 1.1

    fly(flight)


def was_refused(command: asyncio.Future[None]) -> bool:
    error = command.exception()
    return isinstance(error, AutopilotError) and error.refused


def test_mode_change_does_not_wait_for_unacknowledged_mode_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change to LOITER is unacknowledged when RTL is requested.

    RTL must be commanded at once, and LOITER must not be commanded again afterwards.
    """

    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            received: list[tuple[float, float]] = []
            await wait_until_measured(plane, 1.0)
            receive = plane._receive
            pending_losses = [LOITER, RTL]

            def receive_or_lose(outgoing: Message) -> None:
                if outgoing.values.get("command") == MODE:
                    received.append((plane.now, outgoing.real("param2")))
                    if pending_losses:
                        pending_losses.pop()
                        return
                receive(outgoing)

            monkeypatch.setattr(plane, "_receive", receive_or_lose)
            began = plane.now
            first = asyncio.ensure_future(plane.set_mode(LOITER))
            await asyncio.sleep(0.1)
            await plane.set_mode(RTL)
            await asyncio.wait([first])
            assert isinstance(first.exception(), AutopilotError)
            assert received[1] == (pytest.approx(began + 1.1), plane.stack.mode_parameters(RTL)[0])
            assert [number for _, number in received[1:]] == [received[1][1]] * len(received[1:]), (
                "only RTL is commanded after the request"
            )
            assert plane.vehicle.mode == RTL

    fly(flight)


def test_drone_lands_over_a_slow_link(tmp_path: Path) -> None:
    """First the link becomes slow (1.5 s one way).

    When the Grant is then removed, the drone must return home and land.
    """

    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            plane = world.plane
            await world.up(grant)
            set_delay(plane, 1.5)
            await asyncio.sleep(5.0)
            assert plane.vehicle.mode == GUIDED
            plane.commands.clear()
            world.grants.remove(grant)
            await world.until(lambda: not plane.vehicle.armed)
            assert plane.commands.count(MODE) <= 2, "each mode change is sent once"
            assert plane.vehicle.mode in {RTL, LAND}

    fly(flight)
