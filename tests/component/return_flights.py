"""Return flights by the system or by the autopilot, in the oracle of the policy engine.

The class `ReturnFlight` of the service plans each leg that the system flies. The oracle simulates the motion and checks
it for violations.
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
"""Maximum duration of a return flight."""

CHECK_EVERY = 4
"""Number of steps between two checks of the distance from a drone to its target."""

AT_REST_MPS = 0.25
CRUISE_MPS = 5.0
SPEED_SLACK = 0.6

BRAKE = Verdict("allow", None, brake_first=True)


@dataclass(frozen=True)
class ReturnFlights:
    """Simulator of return flights.

    Attributes:
        seed: Seed of the flights, which the texts of violations contain.
        every: In each group of `every` drones, the system returns the first drone and the autopilot the second.
    """

    seed: int
    every: int

    def fly_by_system(self, fleet: Fleet, exempt: Flags, tally: Tally) -> None:
        """Simulate return flights of some flying drones by the system.

        The check ignores:

        - fences that a drone violates or approaches before it stops,
        - zones if no legal return route exists,
        - altitude limits that the drone violates at the beginning, until it has returned within them.
        """
        rows = np.arange(0, len(fleet.scenes), self.every)
        group = _ReturningDrones(fleet.part(rows), exempt[rows])
        for i in range(len(rows)):
            group.fleet.send(i, BRAKE)
        with asyncio.Runner() as runner:
            group.next_leg = lambda i: runner.run(_search(group.fleet, i))
            group.fly()
        tally.autopilot_returns += int(group.by_autopilot.sum())
        tally.system_returns += len(rows) - int(group.by_autopilot.sum())
        tally.wrong += [f"seed {self.seed}, return flight of drone {rows[i]}: {text}" for i, text in group.wrong]

    def fly_by_autopilot(self, fleet: Fleet, exempt: Flags, tally: Tally) -> None:
        """Simulate straight return flights by the autopilot, from the ends of permitted legs.

        The engine has verified that no zone blocks these returns. Altitude limits of zones are ignored, because the
        autopilot does not descend for them.
        """
        at_rest = np.linalg.norm(fleet.speed, axis=1) < AT_REST_MPS
        at_target = np.linalg.norm(fleet.goal - fleet.place, axis=1) < SETTINGS.reached_m
        straight = np.array([not a.retraces for a in fleet.airframes])
        rows = np.arange(1, len(fleet.scenes), self.every)
        rows = rows[(at_rest & at_target & straight & fleet.arrives)[rows]]
        if not len(rows):
            return
        group = _ReturningDrones(fleet.part(rows), exempt[rows])
        group.exempt[:, :ZONES] |= group.fleet.kinds == LIMIT
        for i in range(len(rows)):
            group.start_autopilot_return(i)
        group.fly()
        tally.autopilot_returns += len(rows)
        tally.wrong += [
            f"seed {self.seed}, drone {rows[i]} returning by its autopilot: {text}" for i, text in group.wrong
        ]


class _ReturningDrones:
    """Drones on return flights."""

    def __init__(self, fleet: Fleet, exempt: Flags) -> None:
        self.fleet = fleet
        self.exempt = exempt | excused(fleet)
        self.count = len(fleet.scenes)
        self.by_autopilot = np.zeros(self.count, dtype=bool)
        self.wrong: list[tuple[int, str]] = []
        self.next_leg: Any = None
        self._arrived = np.zeros(self.count, dtype=bool)
        self._legs: list[GotoArgs | None] = [None] * self.count
        self._last = np.zeros(self.count, dtype=bool)
        self._reached = np.full(self.count, SETTINGS.reached_m)
        self._climbing = np.zeros(self.count, dtype=bool)
        self._ceilings = fleet.heights[:, 1].copy()
        """Upper altitude limit of each drone, or its initial altitude if it began above the limit."""
        self._begun = np.zeros(self.count, dtype=bool)
        self._tops = np.full(self.count, np.inf)

    def fly(self) -> None:
        """Fly until all drones are home."""
        fleet = self.fleet
        for n in range(int(LIMIT_S / STEP_S)):
            fleet.step()
            if n % CHECK_EVERY == 0:
                self._decide()
                if self._arrived.all():
                    return
            self._check()
        for i in np.flatnonzero(~self._arrived):
            self.wrong.append((int(i), f"not home after {LIMIT_S:.0f} s, at {fleet.estimated[i].round(1)}"))

    def start_autopilot_return(self, i: int) -> None:
        """Start a return flight by the autopilot. It climbs, and then flies straight home."""
        fleet = self.fleet
        bounds = return_bounds(self.fleet.situation(i, measured=True), self.fleet.scenes[i].grant)
        owned = {"RTL_ALT": 100.0 * fleet.airframes[i].return_altitude_m, "RTL_SPEED": 0.0, "WPNAV_SPEED": 1000.0}
        values = ARDUCOPTER.return_values(owned, bounds)
        fleet.place[i] = fleet.estimated[i]
        fleet.settled[i] = fleet._wind()[i]
        fleet.goal[i] = fleet.place[i]
        fleet.goal[i, 2] = max(fleet.place[i, 2], values["RTL_ALT"] / 100)
        fleet.cruise[i] = (values["RTL_SPEED"] or values["WPNAV_SPEED"]) / 100
        self._tops[i] = bounds.speed_mps
        self.by_autopilot[i] = self._climbing[i] = self._begun[i] = True

    def _decide(self) -> None:
        fleet = self.fleet
        speeds = np.linalg.norm(fleet.speed, axis=1)
        expected = {i for _, i, _ in fleet.mail}
        for i in np.flatnonzero(~self._arrived).tolist():
            leg = self._legs[i]
            if self.by_autopilot[i]:
                self._advance_autopilot_return(i)
            elif i in expected:
                continue
            elif leg is not None:
                z = fleet.estimated[i, 2]
                if (
                    self._distance_m(i, leg) <= self._reached[i]
                    and abs(z - (leg.alt or z)) <= SETTINGS.height_reached_m
                ):
                    self._legs[i] = None
                    if self._last[i]:
                        self._arrived[i] = self.exempt[i] = True
                    else:
                        fleet.send(i, BRAKE)
            elif speeds[i] < AT_REST_MPS:
                self._begin_leg(i)

    def _distance_m(self, i: int, leg: GotoArgs) -> float:
        x, y, _ = self.fleet.estimated[i]
        return math.hypot(x - (leg.lon - HOME.lon) * EAST_M, y - (leg.lat - HOME.lat) * NORTH_M)

    def _begin_leg(self, i: int) -> None:
        try:
            leg = self.next_leg(i)
        except Refused:
            self.start_autopilot_return(i)
            self.exempt[i] = True
            return
        if leg is None:
            self._arrived[i] = self.exempt[i] = True
            return
        self._legs[i] = leg.args
        self._last[i] = leg.last
        self._reached[i] = leg.acceptance_m(self._distance_m(i, leg.args))
        self._begun[i] = True
        self._tops[i] = leg.args.speed_mps
        self.fleet.send(i, Verdict("allow", leg.args))

    def _advance_autopilot_return(self, i: int) -> None:
        fleet = self.fleet
        if self._climbing[i] and fleet.place[i, 2] > fleet.goal[i, 2] - 1.0:
            self._climbing[i] = False
            fleet.goal[i, :2] = 0.0
        elif not self._climbing[i] and math.hypot(*fleet.place[i, :2]) < SETTINGS.reached_m:
            self._arrived[i] = self.exempt[i] = True

    def _check(self) -> None:
        fleet = self.fleet
        broken = fleet.trespassing() & ~self.exempt
        for i in np.flatnonzero(broken.any(axis=1)).tolist():
            self._report(i, f"breaks fence {np.flatnonzero(broken[i])}")
        self._ceilings = np.where(self._begun, self._ceilings, np.maximum(self._ceilings, fleet.estimated[:, 2]))
        high = fleet.true[:, 2] > self._ceilings + HEIGHT_ERROR_M + TRACKING_M + JUST_M
        for i in np.flatnonzero(high & ~self._arrived).tolist():
            self._report(i, "climbs above a limit")
            self._ceilings[i] = np.inf
        fast = np.linalg.norm(fleet.speed[:, :2], axis=1) > self._tops + SPEED_SLACK
        for i in np.flatnonzero(fast & self._begun & ~self._arrived).tolist():
            self._report(i, "is too fast")
            self._tops[i] = np.inf

    def _report(self, i: int, text: str) -> None:
        fleet = self.fleet
        details = f"at {fleet.true[i].round(2)} after {fleet.time_s:.1f} s, {'autopilot' if self.by_autopilot[i] else self._legs[i]}"
        self.wrong.append((i, f"{text} {details}; {fleet.situation(i, measured=True)}"))
        self.exempt[i] = True


async def _search(fleet: Fleet, i: int) -> Any:
    """Return the next leg of a return flight, planned by the service."""
    now: Situation = fleet.situation(i, measured=True)
    place: Floats = fleet.estimated[i]
    vehicle = SimpleNamespace(
        home=HOME,
        position_problem="",
        distance_m=lambda _lat, _lon: math.hypot(place[0], place[1]),
        speed_mps=math.hypot(now.north_mps, now.east_mps),
    )
    state = SimpleNamespace(mission=None)
    control: Any = SimpleNamespace(
        autopilot=SimpleNamespace(vehicle=vehicle), cruise_mps=CRUISE_MPS, state=state, home_moved=False
    )
    gate: Any = SimpleNamespace(situation=lambda: now)
    flight: Any = SimpleNamespace(constraints=SimpleNamespace(compiled=fleet.scenes[i].grant), return_altitude_m=None)
    return await ReturnFlight(control, gate, SimpleNamespace())._next_leg(flight)  # type: ignore[arg-type]
