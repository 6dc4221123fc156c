"""Drivers that fly toward a wall as fast as permitted, over links with a delay.

The result is the least distance of the true position from the wall. `closed_loop` provides service and vehicle.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
import tempfile
from collections.abc import AsyncGenerator, Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import shapely
from closed_loop import HALF_M, Account, Drone, Oracle, Sky, Weather
from fractus_core.api.grants import GrantSpec
from fractus_core.control import StreamState
from fractus_core.policy.decision_types import TakeoffArgs, VelocityArgs
from fractus_services.errors import AutopilotError, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from mobility_world import area, goto, spec, zone

WALL = shapely.box(-120.0, 60.0, 120.0, 90.0)


@dataclass
class Attempt:
    """Result of one driver's flight toward a wall.

    Attributes:
        least_distance_m: Least true distance from the wall, negative inside of it.
        permitted: Number of permitted setpoints.
        denied: Number of denied setpoints.
        unavailable: Number of denied setpoints while the position was unknown.
        problem: Reason why the drone did not take off.
    """

    least_distance_m: float = math.inf
    permitted: int = 0
    denied: int = 0
    unavailable: int = 0
    problem: str = ""
    account: Account | None = None


Pilot = Callable[["Flown"], Awaitable[None]]


@dataclass
class Flown:
    """Drone, Grant and oracle of a flight."""

    drone: Drone
    chance: random.Random
    attempt: Attempt
    oracle: Oracle
    walls: list[shapely.Polygon]
    grant: ActiveGrant = field(init=False)

    def spec(self) -> GrantSpec:
        """Return a Grant with an exclusion zone for each current wall."""
        zones = [zone(f"wall-{number}", "ignore", *wall.bounds) for number, wall in enumerate(self.walls)]
        return spec(*zones, operationArea=[area(-HALF_M, -HALF_M, HALF_M, HALF_M)])

    def put(self) -> ActiveGrant:
        """Issue a Grant with an exclusion zone for each current wall."""
        self.grant = self.drone.grants.put(self.spec())
        return self.grant

    async def fly(self, north: float, east: float, hold_s: float) -> bool:
        """Request a velocity. Return True if it is permitted."""
        try:
            await self.drone.service.set_velocity(self.grant, VelocityArgs(north, east, 0.0, None, hold_s))
        except (Refused, AutopilotError) as error:
            self.attempt.denied += 1
            self.attempt.unavailable += isinstance(error, Unavailable)
            return False
        self.attempt.permitted += 1
        return True

    async def to(self, x: float, y: float, speed: float = 10.0) -> None:
        """Fly to a position in metres east and north of home."""
        await _fly_with_retries(lambda: self.drone.service.goto(self.grant, goto(x, y, 15, speed_mps=speed), 0.0))


async def straight(flown: Flown) -> None:
    """Request a high velocity toward the wall repeatedly, also after refusals."""
    chance = flown.chance
    speed = chance.uniform(6, 12)
    hold_s = chance.choice([0.5, 1.0, 2.0])
    every_s = chance.choice([0.05, 0.1, 0.2])
    for _ in range(int(14 / every_s)):
        await flown.fly(speed, chance.uniform(-0.5, 0.5), hold_s)
        await asyncio.sleep(every_s)


async def bursts(flown: Flown) -> None:
    """Request velocities in quick succession, in all directions but mostly toward the wall."""
    chance = flown.chance
    for _ in range(100):
        angle = chance.gauss(0.0, 1.2)
        speed = chance.uniform(2, 12)
        await flown.fly(speed * math.cos(angle), speed * math.sin(angle), chance.choice([0.3, 0.5, 1.0]))
        await asyncio.sleep(chance.choice([0.02, 0.05, 0.09, 0.3]))


async def both(flown: Flown) -> None:
    """Run the pilot `straight`, then the pilot `bursts`."""
    await straight(flown)
    await flown.to(0, 15)
    await bursts(flown)


SPEEDS_MPS = (12, 10, 8, 7, 6, 5, 4, 3.5, 3, 2.5, 2, 1.5, 1, 0.7, 0.4)


async def at_highest_permitted_speed(flown: Flown) -> None:
    """Fly straight toward the wall. Each request uses the highest speed that is permitted at that moment."""
    await flown.to(0, 0)
    for _ in range(30):
        for speed in SPEEDS_MPS:
            if await flown.fly(speed, 0.0, 1.0):
                break
        await asyncio.sleep(0.4)


def wall_added_ahead(away_m: float, speed_mps: float = 10.0) -> Pilot:
    """Return a pilot that flies one leg. During the leg, a wall is added `away_m` ahead of the drone."""

    async def pilot(flown: Flown) -> None:
        flown.walls.clear()
        flown.put()
        await flown.to(0, -110)
        flying = asyncio.ensure_future(flown.to(0, 110, speed_mps))
        while flown.oracle.speeds()[0] < 0.95 * speed_mps or flown.oracle.place()[1] < -40:  # noqa: ASYNC110
            await asyncio.sleep(0.05)
        y = flown.oracle.place()[1]
        flown.walls.append(shapely.box(-120, y + away_m, 120, y + away_m + 15))
        flown.attempt.least_distance_m = math.inf
        flown.put()
        with contextlib.suppress(Refused, AutopilotError):
            await flying
        while flown.oracle.speeds()[0] > 0.2:  # noqa: ASYNC110 - the simulation has no notification
            await asyncio.sleep(0.1)

    return pilot


async def _fly_with_retries(motion: Callable[[], AsyncGenerator[Any]]) -> None:
    """Fly a motion to its end. Repeat the call while the service raises Unavailable, as the SDK does."""
    for _ in range(20):
        try:
            async with contextlib.aclosing(motion()) as running:
                async for _ in running:
                    pass
        except Unavailable:
            await asyncio.sleep(0.2)
        else:
            return


async def _fly(sky: Sky, pilot: Pilot, seed: int, directory: Path) -> Attempt:
    attempt = Attempt(account=Account(seed))
    assert attempt.account is not None
    oracle = Oracle(sky, attempt.account)
    drone = Drone(directory, attempt.account)
    flown = Flown(drone, random.Random(seed), attempt, oracle, [WALL])
    grant = flown.put()

    def measure() -> None:
        x, y, height = oracle.place()
        point = shapely.Point(x, y)
        for wall in flown.walls if height > 1.0 else ():
            away = -wall.exterior.distance(point) if wall.contains(point) else wall.distance(point)
            attempt.least_distance_m = min(attempt.least_distance_m, float(away))

    sky.witnesses.append(measure)
    turning = [asyncio.ensure_future(sky.run_vehicle())]
    following = asyncio.ensure_future(drone.follow(grant))
    try:
        async with asyncio.timeout(120):
            while not (drone.state is StreamState.GRANTED and drone.autopilot.vehicle.ready):  # noqa: ASYNC110
                await asyncio.sleep(0.2)
            while True:
                try:
                    await drone.service.arm(grant)
                    break
                except (Refused, AutopilotError) as error:
                    attempt.problem = str(error)
                    await asyncio.sleep(1.0)
            attempt.problem = ""
            try:
                async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                    pass
            except Unavailable:
                await flown.to(0, 0)
            await pilot(flown)
    except TimeoutError:
        pass
    finally:
        for task in (following, *turning):
            task.cancel()
        await asyncio.gather(following, *turning, return_exceptions=True)
        await drone.close()
    return attempt


def attempt(pilot: Pilot, seed: int, weather: Weather, parameters: dict[str, float] | None = None) -> Attempt:
    """Fly one attempt and return its result."""
    sky = Sky(seed, weather, parameters or {})
    with tempfile.TemporaryDirectory() as directory, asyncio.Runner(loop_factory=lambda: sky) as runner:
        return runner.run(_fly(sky, pilot, seed, Path(directory)))
