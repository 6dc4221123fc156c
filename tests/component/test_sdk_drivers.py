"""Drivers that hang, crash, run twice or contain a typing error: each flight ends as documented, with the drone at home."""

from __future__ import annotations

import asyncio
import contextlib
import math
import warnings
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fractus
import pytest
import virtual_time
from depth import DEEP
from driver_world import Process
from fractus.drone import Mobility
from mobility_world import World, at, spec, zone

GRACE_S = 15.0
STAGES = ("control", "armed", "up", "leg", "reached")


def stages(*covering: str) -> tuple[str, ...]:
    """Return the stages to fly: all in a deep run, otherwise those that differ in their effect."""
    return STAGES[STAGES[0] not in covering :] if DEEP else covering


FOREVER = math.inf

Fault = Callable[["Flight"], Awaitable[None]]


@dataclass
class Flight:
    """One driver process and its drone, at the moment of the fault."""

    world: World
    process: Process
    drone: Mobility
    control: fractus.Control


@dataclass
class End:
    """End of a flight: outcome of the mission, error of the process, takeovers, position of the drone, waypoint counts."""

    outcome: str
    error: str
    takeovers: list[str]
    home: bool
    lease: bool
    waypoints: str


def program(stage: str, fault: Fault, flight: Callable[[Mobility, fractus.Control], Flight]) -> Any:
    """Return a driver that flies its path. The fault occurs once, at a stage."""
    occurred = False

    async def survey(drone: fractus.Mobility, control: fractus.Control) -> None:
        async def reach(name: str) -> None:
            nonlocal occurred
            if name == stage and not occurred:
                occurred = True
                await fault(flight(drone, control))

        async def on_leg(step: fractus.Progress) -> None:
            if step.distance_m < 40:
                await reach("leg")

        await reach("control")
        await drone.arm()
        await reach("armed")
        await drone.takeoff(10)
        await reach("up")
        async for point in control.remaining():
            await drone.goto(point.lat, point.lon, point.alt, progress=on_leg)
        await reach("reached")

    return survey


async def run_process(process: Process, survey: Any, **options: Any) -> str:
    """Run a driver like `fractus.run`. Return the error with which its process exits; its connection then ends."""
    drone = process.drone(**options)
    try:
        await fractus.fly(survey, drone)
    except Exception as error:  # every error of a program ends its process
        return f"{type(error).__name__}: {error}"
    finally:
        process.die()
    return ""


def fly(directory: Path, stage: str, fault: Fault, *policies: Any, **options: Any) -> End:
    """Fly until the mission has ended and the drone has landed, at most for 200 s."""
    ends: list[End] = []

    async def flight() -> None:
        async with World(directory, grace_s=GRACE_S) as world:
            grant = world.grants.put(spec(*policies))
            process = Process(world, grant.identity)
            survey = program(stage, fault, lambda drone, control: Flight(world, process, drone, control))
            running = asyncio.ensure_future(run_process(process, survey, **options))
            for _ in range(200):
                await asyncio.sleep(1.0)
                if running.done() and not world.plane.vehicle.armed and world.control.state.grace is None:
                    break
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            plane = world.plane
            home = not plane.vehicle.armed and math.hypot(*plane.xy) < 2.0 and plane.height < 0.2
            error = "" if running.cancelled() else running.result()
            takeovers = [entry["code"] for entry in world.kinds("takeover")]
            counts = "".join(str(outcome.waypoints) for outcome in world.control.state.outcomes.values())
            ends.append(End(world.outcome(), error, takeovers, home, world.control.lease is not None, counts))

    virtual_time.fly(flight)
    assert ends[0].home, f"the drone is not at home: {ends[0]}"
    return ends[0]


def hanging(seconds: float) -> Fault:
    async def fault(flight: Flight) -> None:
        flight.process.hang(seconds)
        await flight.process.wait_running()

    return fault


@pytest.mark.parametrize("stage", stages("control", "leg"))
def test_driver_that_blocks_for_four_seconds_completes_without_takeover(stage: str, tmp_path: Path) -> None:
    end = fly(tmp_path, stage, hanging(4.0))
    assert (end.error, end.outcome, end.takeovers) == ("", "complete", [])


@pytest.mark.parametrize("stage", stages(*STAGES))
def test_driver_that_blocks_for_ten_seconds_loses_control_and_continues(stage: str, tmp_path: Path) -> None:
    end = fly(tmp_path, stage, hanging(10.0))
    assert (end.error, end.outcome, end.takeovers) == ("", "complete", ["DriverUnresponsive"])


@pytest.mark.parametrize(
    ("stage", "seconds"), [("armed", FOREVER), ("up", 40.0), ("leg", FOREVER), ("leg", 40.0), ("reached", FOREVER)]
)
def test_mission_of_driver_that_hangs_fails_with_this_reason(stage: str, seconds: float, tmp_path: Path) -> None:
    end = fly(tmp_path, stage, hanging(seconds))
    assert end.outcome == "failed: the driver's program did not respond for 5 s"
    assert end.takeovers[0] == "DriverUnresponsive"
    assert end.error.startswith("MissionEnded: ") is (seconds < FOREVER)


def test_driver_that_hangs_before_arming_keeps_the_drone_on_the_ground(tmp_path: Path) -> None:
    end = fly(tmp_path, "control", hanging(FOREVER))
    assert end.takeovers == ["DriverUnresponsive"]
    assert not end.lease, "the hanging driver blocks the drone for other drivers"


@pytest.mark.parametrize("stage", stages("armed", "leg"))
def test_mission_of_driver_whose_process_dies_fails_with_this_reason(stage: str, tmp_path: Path) -> None:
    async def fault(flight: Flight) -> None:
        flight.process.die()
        await flight.process.wait_running()

    end = fly(tmp_path, stage, fault)
    assert end.outcome == "failed: driver lost"


async def divide(_flight: Flight) -> None:
    raise ZeroDivisionError("division by zero")


async def misspell(flight: Flight) -> None:
    await flight.drone.fly_to(1, 2)  # type: ignore[attr-defined]


async def omit_argument(flight: Flight) -> None:
    await flight.drone.goto(1.0, 2.0)  # type: ignore[call-arg]


async def swap_text_and_number(flight: Flight) -> None:
    await flight.drone.goto("39.36", 22.95, 10)  # type: ignore[arg-type]


async def fly_to_nan(flight: Flight) -> None:
    await flight.drone.goto(math.nan, 22.95, 10)


async def swap_coordinates(flight: Flight) -> None:
    await flight.drone.goto(22.95, 39.36, 10)


async def fail_in_task_group(flight: Flight) -> None:
    async def work() -> None:
        raise OSError("no space left on device")

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(work())
        tasks.create_task(flight.drone.hover())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (divide, "ZeroDivisionError: division by zero"),
        (misspell, "AttributeError: 'Mobility' object has no attribute 'fly_to'"),
        (omit_argument, "TypeError: Mobility.goto() missing 1 required positional argument: 'alt'"),
        (swap_text_and_number, "InvalidRequest: lat must be a number, not '39.36'"),
        (fly_to_nan, "InvalidRequest: Goto: "),
        (swap_coordinates, "InvalidRequest: Goto: the target is more than 100 km away"),
        (fail_in_task_group, "OSError: no space left on device"),
    ],
)
def test_mission_of_driver_that_fails_ends_at_home(fault: Fault, error: str, tmp_path: Path) -> None:
    end = fly(tmp_path, "up", fault)
    assert end.error.startswith(error)
    assert end.outcome == "failed: driver lost"


@pytest.mark.parametrize("strict", [False, True])
def test_motion_without_await_warns_at_once_and_fails_in_strict_mode(strict: bool, tmp_path: Path) -> None:
    async def fault(flight: Flight) -> None:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            flight.drone.goto(*at(0, 20), 10)
        assert len(caught) == 1
        assert caught[0].category is RuntimeWarning
        assert "goto was not awaited" in str(caught[0].message)
        assert caught[0].filename == __file__

    end = fly(tmp_path, "reached", fault, strict=strict)
    if strict:
        assert end.error.startswith(f"InvalidRequest: {__file__}:")
        assert "write `await drone.goto(...)`" in end.error
        assert end.outcome == "failed: driver lost"
    else:
        assert (end.error, end.outcome) == ("", "complete")


@pytest.mark.parametrize("completed", ["report", "mission"])
def test_mission_with_a_refused_waypoint_counts_it_as_skipped(completed: str, tmp_path: Path) -> None:
    async def fault(flight: Flight) -> None:
        points = [fractus.Position(*at(0, 20), 12.0), fractus.Position(*at(0, 70), 12.0)]
        if completed == "mission":
            await flight.drone.mission(points, skip_refused=True)
            return
        async for point in flight.control.remaining(points):
            with contextlib.suppress(fractus.PolicyDenied):
                await flight.drone.goto(point.lat, point.lon, point.alt)

    end = fly(tmp_path, "up", fault, zone("wall", "ignore", -40, 60, 40, 80))
    assert (end.error, end.outcome) == ("", "complete")
    assert end.waypoints == "1 of 2 waypoints reached, 1 skipped"


def test_interrupted_tasks_of_a_task_group_restart_the_program(tmp_path: Path) -> None:
    async def fault(flight: Flight) -> None:
        async def leg(east_m: float) -> None:
            await flight.drone.goto(*at(east_m, 0), 10)

        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(leg(20))
            tasks.create_task(leg(-20))  # replaces the first motion, which is interrupted

    end = fly(tmp_path, "up", fault)
    assert (end.error, end.outcome) == ("", "complete")


@pytest.mark.parametrize("stage", stages("control", "leg"))
def test_second_process_of_a_driver_is_refused_while_the_first_one_flies(stage: str, tmp_path: Path) -> None:
    errors: list[str] = []

    async def fault(flight: Flight) -> None:
        second = Process(flight.world, flight.process.identity)

        async def use() -> None:
            try:
                async with second.drone().control():
                    errors.append("granted")
            except fractus.FractusError as error:
                errors.append(f"{type(error).__name__}: {error}")

        task = asyncio.ensure_future(use())
        await asyncio.sleep(8.0)
        assert task.done()

    end = fly(tmp_path, stage, fault)
    assert len(errors) == 1
    assert errors[0].startswith("ControlHeld: ")
    assert "another process of this component" in errors[0]
    assert (end.error, end.outcome, end.takeovers) == ("", "complete", [])


@pytest.mark.parametrize("stage", stages("control", "armed", "leg"))
def test_second_process_continues_when_the_connection_of_the_first_one_ends(stage: str, tmp_path: Path) -> None:
    seconds: list[asyncio.Task[str]] = []

    async def no_fault(_flight: Flight) -> None:
        raise AssertionError("the second process has no fault")

    async def fault(flight: Flight) -> None:
        flight.process.hang(FOREVER)
        # The gRPC server disconnects a client that does not reply to pings after 4 s.
        asyncio.get_running_loop().call_later(4.0, flight.process.die)
        second = Process(flight.world, flight.process.identity)
        survey = program("", no_fault, lambda drone, control: Flight(flight.world, second, drone, control))
        seconds.append(asyncio.ensure_future(run_process(second, survey)))
        await flight.process.wait_running()

    end = fly(tmp_path, stage, fault)
    assert seconds[0].done()
    assert seconds[0].result() == ""
    assert end.outcome == "complete"


def test_driver_that_repeats_a_forbidden_leg_ends_its_mission_with_the_reason(tmp_path: Path) -> None:
    async def nothing(_flight: Flight) -> None:
        raise AssertionError("there is no such stage")

    end = fly(tmp_path, "", nothing, zone("wall", "hover", -40, 60, 40, 80))
    assert end.takeovers[:3] == ["InsideExclusionZone"] * 3
    assert end.outcome.startswith("failed: the target is 10.0 m inside zone wall-zone of policy wall")
    assert "3 times" in end.outcome
    assert end.error.startswith("MissionEnded: ")


def synchronous(_drone: Any, _control: Any) -> None:
    raise AssertionError("a synchronous program was called")


async def one_argument(_drone: Any) -> None:
    raise AssertionError("a program with a wrong signature was called")


async def generator(_drone: Any, _control: Any) -> Any:
    yield


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (synchronous, "synchronous is a synchronous function: define it as `async def program(drone, control)`"),
        (one_argument, "one_argument cannot be called with drone and control"),
        (generator, "generator contains `yield`"),
        (None, "a program is a coroutine function, not None"),
    ],
)
def test_wrong_program_is_refused_before_it_gets_control(wrong: Any, sentence: str, tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, grace_s=GRACE_S) as world:
            grant = world.grants.put(spec())
            error = await run_process(Process(world, grant.identity), wrong)
            assert error.startswith(f"InvalidRequest: {sentence}")
            assert world.control.lease is None

    virtual_time.fly(flight)


@pytest.mark.parametrize("wrong", [synchronous, one_argument])
def test_run_exits_with_one_sentence_for_a_wrong_program(wrong: Any) -> None:
    with pytest.raises(SystemExit, match=r"define it as `async def program\(drone, control\)`"):
        fractus.run(wrong)


async def test_run_names_fly_if_an_event_loop_is_running() -> None:
    with pytest.raises(fractus.InvalidRequest, match=r"await fractus\.fly\(program\)"):
        fractus.run(one_argument)  # type: ignore[arg-type]
