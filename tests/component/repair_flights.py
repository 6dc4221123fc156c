"""Random flights of the mobility service on the simulated vehicle whose policies and Application select a repair.

A seed determines the repair, the zones, the place of landing, and the moments of violations and of lost contact. The
oracle knows the true position of the vehicle, and decides without the policy engine where the drone must be in the end.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import shapely
from closed_loop import HALF_M, HOME_S, Account, Flight, Sky, Wall, Weather
from fractus_core.api.grants import GrantSpec
from fractus_core.control import StreamState
from fractus_core.policy.decision_types import GotoArgs, TakeoffArgs, VelocityArgs
from fractus_services.errors import AutopilotError, Refused
from fractus_services.mobility.flight.service import Progress
from mobility_world import FRAME, area, at, goto, spec, zone

Repair = Literal["suspend", "abort", "hover", "lose"]
REPAIRS: tuple[Repair, ...] = ("suspend", "abort", "hover", "lose")
"""Suspension by a corrected leg, abort by a policy, and `hover` and `abort` because of lost contact."""

MARGIN_M = 5.0
"""A place at least this far from every zone and border is legal. Zones are at least 25 m apart, so a route leads there."""

LANDED_M = 3.0
"""Maximum distance between a landing and its place. The position error of these flights is at most 1 m."""


class RepairFlight(Flight):
    """Flight that ends with the repair that the seed selects."""

    def __init__(self, seed: int, directory: Path, weather: Weather, sky: Sky) -> None:
        super().__init__(seed, directory, weather, sky)
        self.repair = REPAIRS[seed % len(REPAIRS)]
        self.place = self._random_place()
        self.after_s = self.chance.randrange(10, 25)
        self._contact_at = 0.0
        self.in_contact = True
        self.corner: tuple[float, float, float, float] | None = None

    def _random_place(self) -> tuple[float, float]:
        """Return a landing place: usually inside the operation area."""
        reach_m = HALF_M + (20.0 if self.chance.random() < 0.2 else -10.0)
        return self.chance.uniform(-reach_m, reach_m), self.chance.uniform(-reach_m, reach_m)

    def spec(self) -> GrantSpec:
        half = HALF_M
        lost = None
        if self.repair == "hover":
            lost = {"after": self.after_s, "action": "hover"}
        elif self.repair == "lose":
            lost = {"after": self.after_s, "action": "abort", "landAt": self._land_at()}
        return spec(*self.policies, operationArea=[area(-half, -half, half, half)], contactLost=lost)

    def _land_at(self) -> dict[str, float]:
        return dict(zip(("lat", "lon"), at(*self.place), strict=True))

    def add_repair_zone(self, action: str) -> bool:
        """Add a zone whose policy has the action of this flight. Return False if there is no space for it."""
        for _ in range(50):
            box = self._box()
            if all(wall.box.distance(shapely.box(*box)) >= 25.0 for wall in self.oracle.rules.walls):
                policy = zone("repair", action, *box)
                if action == "abort":
                    policy["spec"]["landAt"] = self._land_at()
                self.policies.append(policy)
                self.oracle.add_wall(Wall(shapely.box(*box), -math.inf, math.inf))
                self.corner = box
                self._note_request(f"zone repair {action} {[round(edge) for edge in box]}")
                return True
        return False

    async def fly(self) -> Account:
        for _ in range(self.chance.randrange(4)):
            self.add_zone()
        # Zones of other policies must not end the flight in another way.
        for policy in self.policies:
            policy["spec"]["action"] = "ignore"
        placed = self.repair not in {"suspend", "abort"} or self.add_repair_zone(
            "adjust" if self.repair == "suspend" else "abort"
        )
        turning = [asyncio.ensure_future(self.sky.run_vehicle()), asyncio.ensure_future(self.oracle.run())]
        grant = self.drone.grants.put(self.spec())
        following = asyncio.ensure_future(self.drone.follow(grant))
        reporting = asyncio.ensure_future(self._report_contact())
        try:
            async with asyncio.timeout(120):
                await self._take_off()
            if placed:
                async with asyncio.timeout(300):
                    await {"suspend": self._suspend, "abort": self._abort, "hover": self._hover, "lose": self._lose}[
                        self.repair
                    ]()
            following.cancel()
            async with asyncio.timeout(HOME_S):
                await self._landed()
            self.account.down = True
            if placed and self.repair in {"abort", "lose"}:
                self._check_landing()
        except (TimeoutError, Refused, AutopilotError) as error:
            self.account.wrong.append(f"{self.repair}: {type(error).__name__} {error}")
        finally:
            for task in (following, reporting, *turning):
                task.cancel()
            await asyncio.gather(following, reporting, *turning, return_exceptions=True)
            await self.drone.close()
        return self.account

    async def _report_contact(self) -> None:
        while True:
            now = self.drone.autopilot.now
            if self.in_contact:
                self._contact_at = now
            self.drone.control.contact.report(now - self._contact_at)
            await asyncio.sleep(1.0)

    async def _take_off(self) -> None:
        drone = self.drone
        await self._until(lambda: drone.state is StreamState.GRANTED and drone.autopilot.vehicle.ready)
        while True:
            with contextlib.suppress(Refused, AutopilotError):
                await drone.service.arm(self.grant)
                break
            await asyncio.sleep(2.0)
        while True:
            with contextlib.suppress(AutopilotError):
                await self._finish(drone.service.take_off(self.grant, TakeoffArgs(self.chance.uniform(8, 20))))
                return

    def _expects(self, condition: bool, text: str) -> None:
        if not condition:
            self.account.wrong.append(f"{self.repair}: {text} at {self.sky.time() - 1000:.1f} s")

    # Suspension

    async def _suspend(self) -> None:
        """Fly through the zone, and request other motions meanwhile."""
        assert self.corner is not None
        west, south, east, north = self.corner
        x, y = (west + east) / 2, (south + north) / 2
        away = math.hypot(x, y)
        target = x + x / away * 60, y + y / away * 60
        if max(map(abs, target)) > HALF_M - MARGIN_M:
            target = x, y
        leg = goto(*target, 15.0)
        steps: list[Progress] = []
        flying = asyncio.ensure_future(self._follow_leg(leg, steps))
        await self._until(lambda: steps or flying.done())
        moved = bool(steps) and isinstance(steps[0].verdict.args, GotoArgs)
        flown = steps[0].verdict.args if moved else None
        if not isinstance(flown, GotoArgs) or (flown.lat, flown.lon) == (leg.lat, leg.lon):
            await asyncio.gather(flying, return_exceptions=True)
            return
        began = self.drone.autopilot.now
        ends_early = self.chance.random() < 0.3
        while not flying.done() and self.drone.autopilot.now - began < 55:
            await asyncio.sleep(self.chance.uniform(0.2, 3))
            if flying.done():
                break
            if ends_early and self.drone.autopilot.now - began > 4:
                await self.drone.service.hover(self.grant)
                await asyncio.gather(flying, return_exceptions=True)
                return
            await self._expect_suspension()
        with contextlib.suppress(Refused):
            await flying
        if steps[-1].step.complete:
            here = self.oracle.place()[:2]
            end = FRAME.xy(flown.lat, flown.lon)
            self._expects(
                math.dist(here, end) < LANDED_M, f"the drone is {math.dist(here, end):.1f} m from its corrected target"
            )
            distance_m = shapely.box(*self.corner).distance(shapely.Point(end))
            self._expects(0.0 < distance_m < 30.0, f"the corrected target is {distance_m:.1f} m from the zone")

    async def _follow_leg(self, leg: GotoArgs, steps: list[Progress]) -> None:
        async with contextlib.aclosing(self.drone.service.goto(self.grant, leg, 0.0)) as motion:
            async for step in motion:
                steps.append(step)  # noqa: PERF401 - the list is read while it grows

    async def _expect_suspension(self) -> None:
        service = self.drone.service
        x, y = self.chance.uniform(-100, 100), self.chance.uniform(-100, 100)
        try:
            if self.chance.random() < 0.5:
                motion: Any = service.goto(self.grant, goto(x, y, 12.0), 0.0)
                await motion.aclose()
            else:
                await service.set_velocity(self.grant, VelocityArgs(x / 50, y / 50))
        except Refused as refusal:
            self._expects(refusal.verdict.code == "Suspended", f"a motion was refused with {refusal.verdict.code}")
        else:
            self._expects(False, "a motion was permitted during a corrected leg")

    # Ends of missions

    async def _wander(self) -> None:
        """Fly somewhere, so that the violation begins at a random position and speed."""
        x, y = self.chance.uniform(-100, 100), self.chance.uniform(-100, 100)
        with contextlib.suppress(Refused, AutopilotError, TimeoutError):
            async with asyncio.timeout(self.chance.uniform(2, 30)):
                await self._finish(self.drone.service.goto(self.grant, goto(x, y, 12.0), 0.0))

    async def _abort(self) -> None:
        """Request a leg into the zone from random positions, until the policy ends the mission."""
        assert self.corner is not None
        west, south, east, north = self.corner
        for _ in range(20):
            await self._wander()
            inside = self.chance.uniform(west + 1, east - 1), self.chance.uniform(south + 1, north - 1)
            with contextlib.suppress(Refused, AutopilotError):
                await self._finish(self.drone.service.goto(self.grant, goto(*inside, 12.0), 0.0))
            if self._outcome():
                break
        self._expects(self._outcome().startswith("revoked:"), f"the mission is {self._outcome() or 'not over'}")

    def _outcome(self) -> str:
        mission = self.drone.control.state.missions.get("m1")
        return str(mission.outcome) if mission is not None and mission.outcome is not None else ""

    async def _lose(self) -> None:
        """Lose contact twice: first for a time that is too short for a reaction, then permanently."""
        await self._lose_contact(self.chance.uniform(1, self.after_s - 2.5))
        self._expects(not self._outcome(), f"a short interruption of contact ended the mission: {self._outcome()}")
        flying = asyncio.ensure_future(self._wander_on())
        self.in_contact = False
        await asyncio.sleep(self.after_s + 3.0)
        flying.cancel()
        await asyncio.gather(flying, return_exceptions=True)
        self._expects(
            self._outcome().startswith("failed: no contact"), f"the mission is {self._outcome() or 'not over'}"
        )

    async def _hover(self) -> None:
        """Lose contact for a random time, and continue."""
        await self._lose_contact(self.chance.uniform(1, self.after_s - 2.5))
        self._expects(not self.drone.control.state.contact_lost, "a short interruption of contact had an effect")
        flying = asyncio.ensure_future(self._wander_on())
        self.in_contact = False
        await asyncio.sleep(self.after_s + 12.0)
        for _ in range(self.chance.randrange(1, 10)):
            speed_mps = self.oracle.speeds()[0]
            self._expects(
                speed_mps < 1.5 + self.weather.gusts_mps, f"the drone flies {speed_mps:.1f} m/s without contact"
            )
            await asyncio.sleep(3.0)
        self.in_contact = True
        await asyncio.sleep(2.5)
        flying.cancel()
        await asyncio.gather(flying, return_exceptions=True)
        self._expects(self.drone.state is StreamState.GRANTED, "the driver lost control")
        await self.drone.service.hover(self.grant)
        self._expects(not self._outcome(), f"the mission is over: {self._outcome()}")

    async def _lose_contact(self, duration_s: float) -> None:
        flying = asyncio.ensure_future(self._wander_on())
        await asyncio.sleep(self.chance.uniform(1, 10))
        self.in_contact = False
        await asyncio.sleep(duration_s)
        self.in_contact = True
        await asyncio.sleep(2.0)
        flying.cancel()
        await asyncio.gather(flying, return_exceptions=True)

    async def _wander_on(self) -> None:
        while True:
            await self._wander()
            await asyncio.sleep(0.3)

    def _check_landing(self) -> None:
        """Check that the drone has landed at its place if this is clearly legal, and at home if it is clearly illegal."""
        here = self.oracle.place()[:2]
        point = shapely.Point(self.place)
        gap_m = min((wall.box.distance(point) for wall in self.oracle.rules.walls), default=math.inf)
        inner_m = HALF_M - max(map(abs, self.place))
        at_place = math.dist(here, self.place) < LANDED_M
        at_home = math.hypot(*here) < LANDED_M
        if gap_m > MARGIN_M and inner_m > MARGIN_M:
            self._expects(at_place, f"landed at {here}, not at the legal place {self.place}")
        elif gap_m == 0.0 or inner_m < 0.0:
            self._expects(at_home, f"landed at {here}, not at home, although the place {self.place} is illegal")
        else:
            self._expects(at_place or at_home, f"landed at {here}, neither at {self.place} nor at home")


def repair_weather(seed: int) -> Weather:
    """Return the environment of a flight: wind and a link of ordinary quality."""
    chance = random.Random(seed * 7 + 1)
    return Weather(
        uplink_s=chance.uniform(0, 0.1),
        downlink_s=chance.uniform(0, 0.1),
        loss=chance.choice([0.0, 0.0, 0.03]),
        wind_mps=chance.choice([0.0, 3.0, 6.0]),
        gusts_mps=chance.choice([0.0, 1.0]),
    )


def repair_flight(seed: int, directory: Path) -> Account:
    """Fly the repair flight of a seed, and return its result."""
    weather = replace(repair_weather(seed))
    sky = Sky(seed, weather, {})

    async def flying() -> Account:
        return await RepairFlight(seed, directory, weather, sky).fly()

    with asyncio.Runner(loop_factory=lambda: sky) as runner:
        return runner.run(flying())
