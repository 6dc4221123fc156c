"""Supervision of failsafes, fence and RTL limits in flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fractus_services.errors import AutopilotError
from fractus_services.mobility.settings import SETTINGS
from mobility_world import World, spec
from virtual_time import fly


async def until_with_heartbeats(world: World, condition: Callable[[], object], timeout_s: float) -> None:
    """Wait for a condition while heartbeats of the vehicle arrive."""

    def beats() -> object:
        world.observer.heartbeat()
        return condition()

    await world.until(beats, timeout_s)


def takeovers(world: World) -> list[dict[str, Any]]:
    return [entry for entry in world.kinds("takeover") if entry["code"] == "FailsafeLost"]


@pytest.mark.parametrize("link", [False, True])
def test_changed_fence_ends_mission_although_return_limit_check_fails(tmp_path: Path, link: bool) -> None:
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

            world.observer._safeguards = replace(world.observer._safeguards, limit_return=fails)
            world.fence.hold = changed  # type: ignore[method-assign]
            await world.until(lambda: world.outcome().startswith("failed:"), 30)
            reason = takeovers(world)[0]["reason"]
            assert "another station changed its fence" in reason
            assert ("no space left" in reason) is not link
            await world.until(lambda: not world.plane.vehicle.armed)

    fly(flight)


def test_system_returns_drone_if_rtl_limits_cannot_be_applied(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            await world.up(world.grants.put(spec()))

            async def fails(_grant: object) -> tuple[str, ...]:
                raise OSError("no space left on device")

            world.observer._safeguards = replace(world.observer._safeguards, limit_return=fails)
            await world.until(lambda: takeovers(world), 30)
            assert "no space left" in world.outcome()

    fly(flight)


def test_drone_returns_home_if_parameters_stay_unverified(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            await world.up(world.grants.put(spec()))
            world.plane.parameters.clear()
            silent_at = world.plane.now
            await until_with_heartbeats(world, lambda: takeovers(world), 2 * SETTINGS.unverified_timeout_s)
            assert world.plane.now - silent_at > SETTINGS.unverified_timeout_s
            assert "has not reported" in world.outcome()
            await world.until(lambda: not world.plane.vehicle.armed)
            assert len(takeovers(world)) == 1

    fly(flight)


def test_short_parameter_outages_do_not_end_mission(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.observer.found()
            await world.up(world.grants.put(spec()))
            for _ in range(3):
                saved = dict(world.plane.parameters)
                world.plane.parameters.clear()
                begun = world.plane.now
                silent_s = 0.7 * SETTINGS.unverified_timeout_s
                await until_with_heartbeats(world, lambda: world.plane.now - begun > silent_s, 2 * silent_s)  # noqa: B023
                world.plane.parameters |= saved
                await until_with_heartbeats(world, lambda: world.observer._unverified_since is None, 60)
            assert not takeovers(world)
            assert not world.outcome()

    fly(flight)
