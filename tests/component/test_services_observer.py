"""What keeps the autopilot's last line as it was armed with, while the drone flies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fractus_services.errors import AutopilotError
from fractus_services.mobility.settings import SETTINGS
from mobility_world import World, spec
from virtual_time import fly


async def heard(world: World, condition: Callable[[], object], timeout_s: float) -> None:
    """Wait for a condition while the vehicle's heartbeats are heard."""

    def beats() -> object:
        world.observer.heartbeat()
        return condition()

    await world.until(beats, timeout_s)


def taken_over(world: World) -> list[dict[str, Any]]:
    return [entry for entry in world.kinds("takeover") if entry["code"] == "FailsafeLost"]


@pytest.mark.parametrize("link", [False, True])
def test_a_full_disk_hides_no_other_loss_of_the_last_line(tmp_path: Path, link: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            await world.up(world.grants.put(spec()))

            async def fails(_grant: object) -> tuple[str, ...]:
                if link:
                    raise AutopilotError("the autopilot does not answer", link=True)
                raise OSError("no space left on device")

            async def changed() -> tuple[str, ...]:
                raise AutopilotError("another station changed its fence")

            world.observer._limit_return = fails
            world.fence.hold = changed  # type: ignore[method-assign]
            await world.until(lambda: world.outcome().startswith("failed:"), 30)
            reason = taken_over(world)[0]["reason"]
            assert "another station changed its fence" in reason
            assert ("no space left" in reason) is not link
            await world.until(lambda: not world.plane.vehicle.armed)

    fly(flight)


def test_a_way_home_that_cannot_be_limited_any_more_is_flown_by_the_system(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            await world.up(world.grants.put(spec()))

            async def fails(_grant: object) -> tuple[str, ...]:
                raise OSError("no space left on device")

            world.observer._limit_return = fails
            await world.until(lambda: taken_over(world), 30)
            assert "no space left" in world.outcome()

    fly(flight)


def test_a_vehicle_that_tells_no_parameters_in_flight_comes_home(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            await world.up(world.grants.put(spec()))
            world.plane.parameters.clear()
            silent_at = world.plane.now
            await heard(world, lambda: taken_over(world), 2 * SETTINGS.unverified_timeout_s)
            assert world.plane.now - silent_at > SETTINGS.unverified_timeout_s
            assert "has not reported" in world.outcome()
            await world.until(lambda: not world.plane.vehicle.armed)
            assert len(taken_over(world)) == 1

    fly(flight)


def test_parameters_that_answer_again_in_time_change_nothing(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            await world.up(world.grants.put(spec()))
            for _ in range(3):
                told = dict(world.plane.parameters)
                world.plane.parameters.clear()
                begun = world.plane.now
                silent_s = 0.7 * SETTINGS.unverified_timeout_s
                await heard(world, lambda: world.plane.now - begun > silent_s, 2 * silent_s)  # noqa: B023
                world.plane.parameters |= told
                await heard(world, lambda: world.observer._unverified_since is None, 60)
            assert not taken_over(world)
            assert not world.outcome()

    fly(flight)
