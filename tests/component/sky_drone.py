"""Fixture for tests of the complete service on the simulated vehicle, in virtual time.

Its drone is ready to be armed by its driver.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path

from closed_loop import Account, Drone, Sky, Weather
from fractus_core.control import StreamState
from fractus_services.grant_files import ActiveGrant
from mobility_world import spec


async def until(condition: Callable[[], object], timeout_s: float = 120.0) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():  # noqa: ASYNC110 - the simulation has no notification
            await asyncio.sleep(0.1)


@contextlib.asynccontextmanager
async def ready(sky: Sky, directory: Path) -> AsyncGenerator[tuple[Drone, ActiveGrant]]:
    """Yield a drone and the Grant of its driver, who has control and may arm."""
    drone = Drone(directory, Account(0))
    turning = asyncio.ensure_future(sky.run_vehicle())
    grant = drone.grants.put(spec())
    following = asyncio.ensure_future(drone.follow(grant))
    try:
        await until(lambda: drone.state is StreamState.GRANTED)
        yield drone, grant
    finally:
        for task in (following, turning):
            task.cancel()
        await asyncio.gather(following, turning, return_exceptions=True)
        await drone.close()


def fly(
    work: Callable[[Sky, Path], Awaitable[None]],
    directory: Path,
    parameters: dict[str, float] | None = None,
    weather: Weather | None = None,
) -> None:
    sky = Sky(1, weather or Weather(uplink_s=0.02, downlink_s=0.02), parameters or {})
    with asyncio.Runner(loop_factory=lambda: sky) as runner:
        runner.run(work(sky, directory))  # type: ignore[arg-type]
