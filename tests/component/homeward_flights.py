"""Ways home in the oracle of the policy engine: flown by the system as the service decides them, and by the autopilot alone.

The service's `Homing` looks for each leg; how the vehicle flies it, and what it must not break on the way, is the oracle's.
"""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from fractus_core.policy.decision_types import GotoArgs, Situation, Verdict
from fractus_core.policy.return_route import return_bounds
from fractus_services.errors import Refused
from fractus_services.mobility.flight.return_to_launch import ReturnFlight
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.settings import SETTINGS
from policy_flights import (
    EAST_M,
    HEIGHT_ERROR_M,
    JUST_M,
    LIMIT,
    NORTH_M,
    STEP_S,
    TRACKING_M,
    ZONES,
    Flags,
    Fleet,
    Floats,
    Tally,
    excused,
)
from policy_world import HOME

LIMIT_S = 240.0
"""No way home takes longer."""

LOOK_EVERY = 4
"""Steps between two looks at where a drone is."""

AT_REST_MPS = 0.25
CRUISE_MPS = 5.0
SPEED_SLACK = 0.6

BRAKE = Verdict("allow", None, brake_first=True)


@dataclass(frozen=True)
class WaysHome:
    """Brings some drones home.

    Attributes:
        seed: told with what goes wrong.
        every: of that number of drones the system brings one home, and another one returns by itself.
    """

    seed: int
    every: int

    def called(self, fleet: Fleet, pardoned: Flags, tally: Tally) -> None:
        """Let the system fly some home that are in flight.

        Fences do not count that a drone breaks, or comes too close to, before it stands; nor do zones where there is no legal
        way home; nor limits of altitude while it comes back from beyond them.
        """
        who = np.arange(0, len(fleet.scenes), self.every)
        away = _Away(fleet.part(who), pardoned[who])
        for i in range(len(who)):
            away.fleet.send(i, BRAKE)
        with asyncio.Runner() as runner:
            away.homing = lambda i: runner.run(_search(away.fleet, i))
            away.fly()
        tally.straight += int(away.alone.sum())
        tally.homeward += len(who) - int(away.alone.sum())
        tally.wrong += [f"seed {self.seed}, the way home of drone {who[i]}: {what}" for i, what in away.wrong]

    def alone(self, fleet: Fleet, pardoned: Flags, tally: Tally) -> None:
        """Let vehicles that go home straight do so from the ends of legs, where the engine let them fly: no zone is in the way.

        Limits of altitude in zones do not count: the autopilot does not sink for them.
        """
        rests = np.linalg.norm(fleet.speed, axis=1) < AT_REST_MPS
        there = np.linalg.norm(fleet.goal - fleet.place, axis=1) < SETTINGS.reached_m
        straight = np.array([not a.retraces for a in fleet.airframes])
        who = np.arange(1, len(fleet.scenes), self.every)
        who = who[(rests & there & straight & fleet.arrives)[who]]
        if not len(who):
            return
        away = _Away(fleet.part(who), pardoned[who])
        away.pardoned[:, :ZONES] |= away.fleet.kinds == LIMIT
        for i in range(len(who)):
            away.start_alone(i)
        away.fly()
        tally.straight += len(who)
        tally.wrong += [f"seed {self.seed}, drone {who[i]} alone on its way home: {what}" for i, what in away.wrong]


class _Away:
    """Drones on their ways home."""

    def __init__(self, fleet: Fleet, pardoned: Flags) -> None:
        self.fleet = fleet
        self.pardoned = pardoned | excused(fleet)
        self.count = len(fleet.scenes)
        self.alone = np.zeros(self.count, dtype=bool)
        self.wrong: list[tuple[int, str]] = []
        self.homing: Any = None
        self._home = np.zeros(self.count, dtype=bool)
        self._legs: list[GotoArgs | None] = [None] * self.count
        self._reached = np.full(self.count, SETTINGS.reached_m)
        self._climbing = np.zeros(self.count, dtype=bool)
        self._ceilings = fleet.heights[:, 1].copy()
        """Limits of altitude that hold everywhere, or where those were that began above them."""
        self._begun = np.zeros(self.count, dtype=bool)
        self._tops = np.full(self.count, np.inf)

    def fly(self) -> None:
        """Until all are home."""
        fleet = self.fleet
        for n in range(int(LIMIT_S / STEP_S)):
            fleet.step()
            if n % LOOK_EVERY == 0:
                self._decide()
                if self._home.all():
                    return
            self._look()
        for i in np.flatnonzero(~self._home):
            self.wrong.append((int(i), f"not home after {LIMIT_S:.0f} s, at {fleet.seen[i].round(1)}"))

    def start_alone(self, i: int) -> None:
        """Begin the autopilot's own return: a climb, then straight."""
        fleet = self.fleet
        bounds = return_bounds(self.fleet.situation(i, told=True), self.fleet.scenes[i].grant)
        owned = {"RTL_ALT": 100.0 * fleet.airframes[i].return_altitude_m, "RTL_SPEED": 0.0, "WPNAV_SPEED": 1000.0}
        values = ARDUCOPTER.return_values(owned, bounds)
        fleet.place[i] = fleet.seen[i]
        fleet.settled[i] = fleet._wind()[i]
        fleet.goal[i] = fleet.place[i]
        fleet.goal[i, 2] = max(fleet.place[i, 2], values["RTL_ALT"] / 100)
        fleet.cruise[i] = (values["RTL_SPEED"] or values["WPNAV_SPEED"]) / 100
        self._tops[i] = bounds.speed_mps
        self.alone[i] = self._climbing[i] = self._begun[i] = True

    def _decide(self) -> None:
        fleet = self.fleet
        speeds = np.linalg.norm(fleet.speed, axis=1)
        expected = {i for _, i, _ in fleet.mail}
        for i in np.flatnonzero(~self._home).tolist():
            leg = self._legs[i]
            if self.alone[i]:
                self._go_on_alone(i)
            elif i in expected:
                continue
            elif leg is not None:
                east = (leg.lon - HOME.lon) * EAST_M
                north = (leg.lat - HOME.lat) * NORTH_M
                x, y, z = fleet.seen[i]
                if (
                    math.hypot(x - east, y - north) <= self._reached[i]
                    and abs(z - (leg.alt or z)) <= SETTINGS.height_reached_m
                ):
                    self._legs[i] = None
                    fleet.send(i, BRAKE)
            elif speeds[i] < AT_REST_MPS:
                self._begin_leg(i)

    def _begin_leg(self, i: int) -> None:
        try:
            found = self.homing(i)
        except Refused:
            self.start_alone(i)
            self.pardoned[i] = True
            return
        if found is None:
            self._home[i] = self.pardoned[i] = True
            return
        self._legs[i] = found.args
        self._reached[i] = found.reached_m
        self._begun[i] = True
        self._tops[i] = found.args.speed_mps
        self.fleet.send(i, Verdict("allow", found.args))

    def _go_on_alone(self, i: int) -> None:
        fleet = self.fleet
        if self._climbing[i] and fleet.place[i, 2] > fleet.goal[i, 2] - 1.0:
            self._climbing[i] = False
            fleet.goal[i, :2] = 0.0
        elif not self._climbing[i] and math.hypot(*fleet.place[i, :2]) < SETTINGS.reached_m:
            self._home[i] = self.pardoned[i] = True

    def _look(self) -> None:
        fleet = self.fleet
        found = fleet.trespassing() & ~self.pardoned
        for i in np.flatnonzero(found.any(axis=1)).tolist():
            self._tell(i, f"breaks fence {np.flatnonzero(found[i])}")
        self._ceilings = np.where(self._begun, self._ceilings, np.maximum(self._ceilings, fleet.seen[:, 2]))
        high = fleet.true[:, 2] > self._ceilings + HEIGHT_ERROR_M + TRACKING_M + JUST_M
        for i in np.flatnonzero(high & ~self._home).tolist():
            self._tell(i, "climbs above a limit")
            self._ceilings[i] = np.inf
        fast = np.linalg.norm(fleet.speed[:, :2], axis=1) > self._tops + SPEED_SLACK
        for i in np.flatnonzero(fast & self._begun & ~self._home).tolist():
            self._tell(i, "is too fast")
            self._tops[i] = np.inf

    def _tell(self, i: int, what: str) -> None:
        fleet = self.fleet
        where = f"at {fleet.true[i].round(2)} after {fleet.time_s:.1f} s, {'alone' if self.alone[i] else self._legs[i]}"
        self.wrong.append((i, f"{what} {where}; {fleet.situation(i, told=True)}"))
        self.pardoned[i] = True


async def _search(fleet: Fleet, i: int) -> Any:
    """The next leg of a way home, as the service finds it."""
    now: Situation = fleet.situation(i, told=True)
    place: Floats = fleet.seen[i]
    vehicle = SimpleNamespace(home=HOME, distance_m=lambda _lat, _lon: math.hypot(place[0], place[1]))
    state = SimpleNamespace(mission=None)
    control: Any = SimpleNamespace(
        autopilot=SimpleNamespace(vehicle=vehicle), cruise_mps=CRUISE_MPS, state=state, home_moved=False
    )
    gate: Any = SimpleNamespace(situation=lambda: now)
    flight: Any = SimpleNamespace(constraints=SimpleNamespace(compiled=fleet.scenes[i].grant))
    return await ReturnFlight(control, gate, SimpleNamespace())._next_leg(flight)  # type: ignore[arg-type]
