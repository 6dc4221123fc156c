"""Reactions of the drone when its agent loses contact with the API server."""

from __future__ import annotations

import asyncio
import json
import math
from pathlib import Path
from typing import Any

import pytest
from fractus_core.control import Authority, StreamState
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_services.errors import Unavailable
from fractus_services.mobility.authority.contact import LastContactFile
from mobility_world import GUIDED, LOITER, World, at, end, goto, partial, refusal, spec, touring
from virtual_time import fly

PLACE = (80.0, -50.0)
HOVER = {"after": 10, "action": "hover"}
ABORT = {"after": 10, "action": "abort", "landAt": dict(zip(("lat", "lon"), at(*PLACE), strict=True))}


class Agent:
    """Fake agent that reports its contact once per second while it runs."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._contact_at = world.plane.now
        self.in_contact = True
        self.runs = True
        self._reporting = asyncio.ensure_future(self._report())
        world._tasks.append(self._reporting)

    async def _report(self) -> None:
        while True:
            if self.in_contact:
                self._contact_at = self._world.plane.now
            if self.runs:
                self._world.contact.report(self._world.plane.now - self._contact_at)
            await asyncio.sleep(1.0)


async def leg(world: World, x: float, y: float) -> Any:
    (grant,) = world.grants.active.values()
    return await end(world.service.goto(grant, goto(x, y), 0))


def at_rest(world: World) -> bool:
    return math.hypot(*world.plane.velocity) < 0.1


def contact_entries(world: World) -> list[str]:
    return [entry["action"] for entry in world.kinds("control") if entry["code"] == "ContactLost"]


@pytest.mark.parametrize("lost", [None, {"after": 10}, {"after": 10, "action": "continue"}])
def test_flight_continues_without_contact_by_default(tmp_path: Path, lost: dict[str, Any] | None) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(contactLost=lost))
            await world.up(grant)
            await leg(world, 0, 150)
            assert world.plane.now > 1020
            assert contact_entries(world) == []

    fly(flight)


def test_drone_hovers_until_contact_returns(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=HOVER))
            await world.up(grant)
            flying = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 180, speed_mps=5.0), 0)))
            await world.until(lambda: world.plane.velocity[1] > 3)
            agent.in_contact = False
            lost_at = world.plane.now
            stopped = await refusal(flying)
            assert isinstance(stopped, Unavailable)
            assert stopped.verdict.code == "ContactLost"
            assert 9 <= world.plane.now - lost_at < 12.5
            await world.until(lambda: at_rest(world), 10)
            waiting = await refusal(leg(world, 0, 0))
            assert isinstance(waiting, Unavailable)
            assert (waiting.verdict.code, waiting.retry_after_s > 0) == ("ContactLost", True)
            await asyncio.sleep(60)
            assert at_rest(world)
            assert world.control.state.drives, "the driver keeps control"
            agent.in_contact = True
            await world.until(lambda: not world.control.state.contact_lost, 3)
            await leg(world, 0, 0)
            assert world.outcome() == ""
            assert contact_entries(world) == ["contactLost", "contactRestored"]

    fly(flight)


@pytest.mark.parametrize(("lost", "place"), [(ABORT, PLACE), ({"after": 10, "action": "abort"}, (0.0, 0.0))])
def test_abort_lands_at_its_place_or_at_home(tmp_path: Path, lost: dict[str, Any], place: tuple[float, float]) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=lost))
            await world.up(grant)
            await leg(world, 0, 60)
            agent.in_contact = False
            await world.until(world.outcome)
            assert world.outcome() == "failed: no contact with the API server for 10 s"
            agent.in_contact = True
            await world.until(lambda: not world.plane.vehicle.armed)
            assert math.dist(world.plane.xy, place) < 1.5, "an abort is final"

    fly(flight)


def test_missing_reports_count_as_missing_contact(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=ABORT))
            await world.up(grant)
            agent.runs = False
            ended_at = world.plane.now
            await world.until(world.outcome)
            assert 9 <= world.plane.now - ended_at <= 12

    fly(flight)


def test_short_interruptions_of_contact_and_of_reports_have_no_effect(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=ABORT))
            await world.up(grant)
            for number in range(12):
                agent.in_contact = bool(number % 2)
                agent.runs = bool(number % 3)
                await asyncio.sleep(7.5)
                agent.in_contact = True
                agent.runs = True
                await asyncio.sleep(1.5)
            assert (world.outcome(), contact_entries(world)) == ("", [])

    fly(flight)


def test_late_report_does_not_set_the_contact_back(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.contact.report(0.0)
            world.contact.report(300.0)
            assert world.contact.age_s < 1
            await asyncio.sleep(20)
            world.contact.report(2.0)
            assert 2 <= world.contact.age_s < 2.5

    fly(flight)


@pytest.mark.parametrize("method", ["land", "return_to_launch"])
@pytest.mark.parametrize("lost", [HOVER, ABORT])
def test_descent_of_the_driver_is_completed_without_contact(tmp_path: Path, method: str, lost: dict[str, Any]) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=lost))
            await world.up(grant, 40.0)
            await leg(world, 0, 30)
            agent.in_contact = False
            await asyncio.sleep(8)
            assert (await end(getattr(world.service, method)(grant))).step.complete
            assert contact_entries(world) == ["contactLost"]
            place = (0.0, 30.0) if method == "land" else (0.0, 0.0)
            assert math.dist(world.plane.xy, place) < 1.5

    fly(flight)


def test_takeoff_is_completed_without_contact(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=HOVER))
            await world.drive(grant)
            await world.service.arm(grant)
            agent.in_contact = False
            await asyncio.sleep(8)
            await end(world.service.take_off(grant, TakeoffArgs(20)))
            assert world.control.state.contact_lost
            assert world.plane.height > 18

    fly(flight)


def test_drone_without_contact_stays_on_the_ground(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=HOVER))
            await world.drive(grant)
            await world.service.arm(grant)
            agent.in_contact = False
            await asyncio.sleep(14)

            async def climb() -> Any:
                return await end(world.service.take_off(grant, TakeoffArgs(10)))

            assert (await refusal(climb())).verdict.code == "ContactLost"
            assert (await refusal(world.service.arm(grant))).verdict.code == "ContactLost"
            agent.in_contact = True
            await asyncio.sleep(2)
            await climb()

    fly(flight)


def test_waiting_driver_gets_control_when_contact_returns(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            agent.in_contact = False
            grant = world.grants.put(spec(contactLost=HOVER))
            await asyncio.sleep(14)
            driving = asyncio.ensure_future(world.drive(grant))
            await asyncio.sleep(14)
            assert not driving.done()
            reasons = [event.reason for event in world.events if event.state is StreamState.WAITING]
            assert reasons == [] or "no contact" in reasons[-1]
            agent.in_contact = True
            await driving
            assert world.control.state.drives

    fly(flight)


def test_lost_driver_comes_home_without_contact(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=HOVER))
            stream = await world.up(grant)
            await leg(world, 0, 40)
            agent.in_contact = False
            await asyncio.sleep(14)
            stream.cancel()
            await world.until(lambda: not world.plane.vehicle.armed)
            assert math.hypot(*world.plane.xy) < 1.5
            assert world.outcome().startswith("failed: driver lost")

    fly(flight)


def test_transit_waits_for_contact_and_continues(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(partial(contactLost=HOVER))

            async def reconnect() -> None:
                while not world.control.state.drives:
                    try:
                        await world.drive(grant)
                    except Unavailable:
                        await asyncio.sleep(0.5)

            agent.in_contact = False
            driving = asyncio.ensure_future(reconnect())
            await world.until(lambda: world.control.state.contact_lost, 40)
            await asyncio.sleep(60)
            assert not driving.done()
            assert world.outcome() == ""
            agent.in_contact = True
            await driving
            assert math.dist(world.plane.xy, (0, 70)) < 1.5

    fly(flight)


def test_tour_waits_for_contact_and_continues(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            world.grants.put(touring(tour=((0, 40), (0, 120)), contactLost=HOVER))
            await world.until(lambda: world.plane.xy[1] > 10)
            agent.in_contact = False
            await world.until(lambda: world.control.state.contact_lost)
            await asyncio.sleep(60)
            assert at_rest(world)
            assert world.outcome() == ""
            assert world.plane.vehicle.armed
            agent.in_contact = True
            await world.until(world.outcome, 120)
            assert world.outcome() == "complete"

    fly(flight)


async def complete_tour(world: World, agent: Agent) -> None:
    """Check that a tour hovers without contact for longer than the grace period, and is completed afterwards."""
    await asyncio.sleep(40)
    assert (world.control.state.contact_lost, at_rest(world), world.outcome()) == (True, True, "")
    agent.in_contact = True
    await world.until(world.outcome, 120)
    assert world.outcome() == "complete"


def test_tour_waits_for_contact_after_restart_of_the_service(tmp_path: Path) -> None:
    file = tmp_path / "contact.json"

    async def flight() -> None:
        grant = touring(tour=((0, 40), (0, 120)), contactLost=HOVER)
        world = World(tmp_path, contact_file=LastContactFile(file))
        async with world:
            agent = Agent(world)
            world.grants.put(grant)
            await world.until(lambda: world.plane.xy[1] > 10)
            agent.in_contact = False
            await world.until(lambda: world.control.state.contact_lost)
            await asyncio.sleep(5)
            await until_stored(file)
        async with World(
            tmp_path, after=world, initialised=False, grace_s=15.0, contact_file=LastContactFile(file)
        ) as restarted:
            agent = Agent(restarted)
            agent.in_contact = False
            agent._contact_at = -math.inf
            restarted.grants.put(grant)
            restarted.observer.found()
            await complete_tour(restarted, agent)

    fly(flight)


def test_tour_waits_for_contact_after_a_pilot_hands_the_drone_back(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, grace_s=15.0) as world:
            agent = Agent(world)
            world.grants.put(touring(tour=((0, 40), (0, 120)), contactLost=HOVER))
            await world.until(lambda: world.plane.xy[1] > 10)
            world.plane.set_to(LOITER)
            world.observer.heartbeat()
            agent.in_contact = False
            await asyncio.sleep(20)
            world.plane.set_to(GUIDED)
            world.observer.heartbeat()
            await complete_tour(world, agent)

    fly(flight)


def test_pilot_keeps_control_without_contact(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=ABORT))
            await world.up(grant)
            world.plane.set_to(LOITER)
            world.observer.heartbeat()
            agent.in_contact = False
            await asyncio.sleep(20)
            assert world.control.authority is Authority.PILOT
            assert world.outcome() == ""
            world.plane.set_to(GUIDED)
            world.observer.heartbeat()
            await world.until(world.outcome, 5)
            await world.until(lambda: not world.plane.vehicle.armed)
            assert math.dist(world.plane.xy, PLACE) < 1.5

    fly(flight)


def test_time_without_contact_continues_when_the_service_restarts(tmp_path: Path) -> None:
    file = tmp_path / "contact.json"

    async def flight() -> None:
        world = World(tmp_path, contact_file=LastContactFile(file))
        async with world:
            agent = Agent(world)
            grant = world.grants.put(spec(contactLost=ABORT | {"after": 30}))
            await world.up(grant)
            agent.in_contact = False
            lost_at = world.plane.now
            await asyncio.sleep(20)
            await until_stored(file)
        async with World(
            tmp_path, after=world, initialised=False, grace_s=90.0, contact_file=LastContactFile(file)
        ) as restarted:
            restarted.grants.put(spec(contactLost=ABORT | {"after": 30}))
            restarted.observer.found()
            await restarted.until(restarted.outcome)
            assert restarted.outcome() == "failed: no contact with the API server for 30 s"
            assert 29 <= restarted.plane.now - lost_at <= 33

    fly(flight)


async def until_stored(file: Path) -> None:
    """Wait for a write in a thread, which takes no virtual time."""
    for _ in range(1000):
        if await asyncio.to_thread(file.exists):
            return
    raise AssertionError("the last contact was not stored")


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", '{"boot": "another", "contact_at": 5}', '{"boot": "", "contact_at": NaN}', '{"boot": 3}'],
)
def test_damaged_or_outdated_contact_file_counts_as_missing(tmp_path: Path, content: str) -> None:
    file = tmp_path / "contact.json"
    file.write_text(content)
    assert LastContactFile(file).contact_at is None


async def test_contact_file_is_valid_until_the_next_boot(tmp_path: Path) -> None:
    file = tmp_path / "contact.json"
    first = LastContactFile(file)
    first.keep(5.0)
    await until_stored(file)
    assert LastContactFile(file).contact_at == 5.0
    stored = json.loads(file.read_text())
    file.write_text(json.dumps(stored | {"boot": "earlier"}))
    assert LastContactFile(file).contact_at is None


def test_contact_in_the_future_counts_from_now(tmp_path: Path) -> None:
    file = tmp_path / "contact.json"
    file.write_text(
        json.dumps({"boot": Path("/proc/sys/kernel/random/boot_id").read_text().strip(), "contact_at": 1e12})
    )

    async def flight() -> None:
        async with World(tmp_path, contact_file=LastContactFile(file)) as world:
            assert world.contact.age_s < 1
            await asyncio.sleep(3)
            assert 2.5 < world.contact.age_s < 4

    fly(flight)


def test_waiting_stream_does_not_block_when_contact_returns_between_two_checks(tmp_path: Path) -> None:
    checks = 0

    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(contactLost=HOVER))
            await asyncio.sleep(14)
            waiting = asyncio.ensure_future(world.drive(grant))
            await world.until(lambda: world.control.state.contact_lost, 5)
            await asyncio.sleep(0.03)
            examine = world.control.not_ready_reason

            def counted(key: str) -> str | None:
                nonlocal checks
                checks += 1
                assert checks < 100, "the stream checks without end, and the event loop hangs"
                return examine(key)

            world.control.not_ready_reason = counted  # type: ignore[method-assign]
            world.contact.report(0.0)
            world.control.changes.notify()  # the stream checks before the next tick of the monitor
            await asyncio.wait_for(waiting, 3)
            assert world.control.state.drives

    fly(flight)


def test_driver_without_control_waits_between_two_attempts_for_any_reason(tmp_path: Path) -> None:
    attempts = 0

    async def flight() -> None:
        nonlocal attempts
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())

            def refuse(_lease: object) -> None:
                nonlocal attempts
                attempts += 1
                assert attempts < 100, "the stream tries without end, and the event loop hangs"

            world.control.grant_control = refuse  # type: ignore[assignment,method-assign]
            waiting = asyncio.ensure_future(world.drive(grant))
            await asyncio.sleep(3)
            assert not waiting.done()
            waiting.cancel()
            assert 1 < attempts < 10

    fly(flight)


@pytest.mark.parametrize("demand", [HOVER, ABORT])
def test_time_without_contact_counts_from_the_begin_of_the_demand(tmp_path: Path, demand: dict[str, Any]) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await asyncio.sleep(40)
            world.grants.put(spec(contactLost=demand))
            await asyncio.sleep(1)
            agent = Agent(world)
            await asyncio.sleep(5)
            assert (world.outcome(), contact_entries(world)) == ("", [])
            agent.runs = False
            await asyncio.sleep(12)
            assert contact_entries(world) == ["contactLost"]

    fly(flight)


def test_mission_start_records_no_lost_contact_before_the_first_report(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            await asyncio.sleep(60)
            grant = world.grants.put(spec(contactLost=HOVER))
            driving = asyncio.ensure_future(world.drive(grant))
            await asyncio.sleep(1)
            Agent(world)
            await driving
            assert contact_entries(world) == []
            assert all("contact" not in event.reason for event in world.events)

    fly(flight)
