"""Random golden flights, determined by a seed."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from typing import Any

from control_flights import Flight
from control_scripts import CONTROL_POINTS, Script
from fractus_core.policy.decision_types import GotoArgs, TakeoffArgs, VelocityArgs
from mobility_world import GUIDED, LAND, LOITER, RTL, partial, spec, touring, zone

WEIGHTS = {
    "stream": 12, "leave": 4, "arm": 8, "takeoff": 8, "goto": 8, "land": 2, "home": 2, "hover": 2, "velocity": 2,
    "cancel": 3, "give_back": 5, "grant": 3, "remove": 1, "zone": 2, "pilot": 1, "hand_back": 3, "failsafe": 1,
    "break_link": 1, "restore_link": 3, "refuse": 1, "obey": 3, "restart": 1, "motors": 1,
}  # fmt: skip
CALLS = frozenset({"arm", "takeoff", "goto", "land", "home", "hover", "velocity"})


def random_flight(seed: int) -> Script:
    """Return the random flight of a seed."""

    async def script(f: Flight) -> None:
        actor = RandomActor(f, random.Random(seed))
        for _ in range(actor.dice.randint(8, 30)):
            await actor.step()
            await f.sleep(actor.dice.choice((0.0, 0.05, 0.3, 1.0, 2.5, 5.0, 8.0)))
        f.world.plane.refuses.clear()
        if f.world.plane.disconnected:
            f.restore_link()
        await f.sleep(60)

    return script


class RandomActor:
    """Performs random actions and skips those that are currently impossible."""

    def __init__(self, flight: Flight, dice: random.Random) -> None:
        self.dice = dice
        self._flight = flight
        self._specs = {
            "m1": spec(controlPoints=CONTROL_POINTS),
            "m2": partial(instance="other"),
            "m3": touring(tour=((0, 30), (30, 30))),
        }
        keys = dice.sample(sorted(self._specs), dice.randint(1, 3))
        self._grants = {key: flight.put(self._specs[key], key) for key in keys}
        self._streams: list[asyncio.Task[None]] = []
        self._calls: list[asyncio.Task[None]] = []
        self._key = ""
        self._position = (0.0, 0.0)

    async def step(self) -> None:
        """Perform one random action."""
        dice = self.dice
        self._key = dice.choice(sorted(self._specs))
        self._position = dice.uniform(-60, 60), dice.uniform(-60, 60)
        action = dice.choices(tuple(WEIGHTS), tuple(WEIGHTS.values()))[0]
        if action in CALLS:
            self._call(action)
        elif action in {"give_back", "restart"}:
            await getattr(self, action)()
        else:
            getattr(self, action)()

    def _call(self, action: str) -> None:
        active_grant = self._grants.get(self._key)
        x, y = self._position
        service = self._flight.world.service
        if active_grant is None:
            return
        work: dict[str, Callable[[], Any]] = {
            "arm": lambda: service.arm(active_grant),
            "takeoff": lambda: service.take_off(active_grant, TakeoffArgs(10.0)),
            "goto": lambda: service.goto(active_grant, GotoArgs(39.36 + y / 111_000, 22.95 + x / 86_000, 12.0), 0),
            "land": lambda: service.land(active_grant),
            "home": lambda: service.return_to_launch(active_grant),
            "hover": lambda: service.hover(active_grant),
            "velocity": lambda: service.set_velocity(active_grant, VelocityArgs(x / 20, y / 20, hold_s=2.0)),
        }
        self._calls.append(self._flight.call(action, work[action]))

    # Drivers

    def stream(self) -> None:
        active_grant = self._grants.get(self._key)
        if active_grant is not None:
            self._streams.append(self._flight.follow(active_grant, self._key))

    def leave(self) -> None:
        if self._streams:
            self.dice.choice(self._streams).cancel()

    def cancel(self) -> None:
        if self._calls:
            self.dice.choice(self._calls).cancel()

    async def give_back(self) -> None:
        active_grant = self._grants.get(self._key)
        if active_grant is not None:
            await self._flight.give_back(active_grant)

    # Grants

    def grant(self) -> None:
        self._grants[self._key] = self._flight.put(self._specs[self._key], self._key)

    def remove(self) -> None:
        grants = self._flight.world.grants
        active_grant = self._grants.get(self._key)
        if active_grant is not None and grants.active.get(active_grant.identity) is active_grant:
            grants.remove(self._grants.pop(self._key))

    def zone(self) -> None:
        if self._key in self._grants:
            x, y = self._position
            reaction = self.dice.choice(("hover", "land", "returnToLaunch", "revoke", "ignore"))
            policies = spec(zone("new", reaction, x, y, x + 25, y + 25)).policies
            changed = self._specs[self._key].model_copy(update={"policies": policies})
            self._grants[self._key] = self._flight.put(changed, self._key)

    # Vehicle, pilot and failsafes

    def pilot(self) -> None:
        self._flight.world.plane.set_to(self.dice.choice((LOITER, LAND, RTL)))

    def hand_back(self) -> None:
        self._flight.world.plane.set_to(GUIDED)

    def failsafe(self) -> None:
        self._flight.failsafe(self.dice.choice((RTL, LAND)))

    def break_link(self) -> None:
        self._flight.break_link()

    def restore_link(self) -> None:
        self._flight.restore_link()

    def refuse(self) -> None:
        self._flight.world.plane.refuses.add(self.dice.choice((176, 192, 400, 22)))

    def obey(self) -> None:
        self._flight.world.plane.refuses.clear()

    def motors(self) -> None:
        plane = self._flight.world.plane
        if plane.height <= 0.0:
            plane.vehicle.armed = not plane.vehicle.armed

    async def restart(self) -> None:
        self._streams.clear()
        self._calls.clear()
        await self._flight.restart()
