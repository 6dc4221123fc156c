"""The way home: flown by the system on legal legs, at legal heights and speeds; the autopilot's own return is the last line."""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import replace

from fractus_core.control.state import FlightMode, ModeKind, TaskKind
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.kinematics import height_margin_m, margin_m
from fractus_core.policy.return_route import (
    RTL_CONE_SLOPE,
    check_straight_return,
    descent_enters_fence,
    may_change_altitude,
    return_altitudes_m,
)

from fractus_services.errors import AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.home import home_moved, restore_home
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.flight.courses import STOPPED, Courses, NextLeg, Trip, first_leg, limited_mps
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.motions import REACHED_M, Step

log = logging.getLogger(__name__)

LEVEL_M = 1.0
"""A way home that leads higher or lower than this climbs or sinks first."""

LAST_LEG_M = 0.5
"""How near to home the last leg ends: there the drone lands."""

MAX_TRIES = 3
"""How many times the system tries to fly around what is in the way when the autopilot refuses. After that the drone goes
back the way it came (SmartRTL), and when that is refused too, straight (RTL)."""


class Homing:
    """Brings the drone home, see `WayHome`."""

    def __init__(self, control: ControlStore, guard: Guard, courses: Courses) -> None:
        self._control = control
        self._guard = guard
        self._courses = courses
        self.given_up: ActiveGrant | None = None

    async def approach(self, kind: TaskKind, wanted: Callable[[], bool], tries: int) -> FlightMode:
        """Fly home, for the system, until only the descent is left; a drone that is to land does so at once, unless into a zone.

        Args:
            kind: to land, or to return.
            wanted: whether the system still has the drone.
            tries: how often that has failed.

        Returns:
            The mode in which the autopilot does the rest. Where no legal way home is known, that is SMART_RTL if the
            autopilot remembers the path flown, else RTL: flying home through a zone is the lesser evil, for a drone that
            stays in the air comes down somewhere when its battery is empty.

        Raises:
            AutopilotError: the autopilot refuses, or its link broke.
        """
        control = self._control
        grant, vehicle, stack = control.last_grant, control.autopilot.vehicle, control.autopilot.stack
        self.given_up = None
        if kind is TaskKind.RETURN and tries < MAX_TRIES:
            await self._keep_home()
        # A landing under way is a failsafe's or a pilot's choice, with a battery that may be too low for any other way.
        landing = vehicle.mode.kind is ModeKind.LANDING or self._blind()
        if kind is TaskKind.LAND and (grant is None or landing or not self._lands_in_zone(grant)):
            return stack.land
        if vehicle.in_air and not vehicle.mode.comes_down and tries <= MAX_TRIES and self._path_is_home():
            control.note("returnToLaunch", "home was moved; the drone goes back the way it came", "HomeMoved")
            return stack.return_retracing
        if grant is None or not vehicle.in_air or vehicle.mode.comes_down or self._blind():
            return stack.return_straight
        try:
            why = await self._bring(grant, wanted) if tries < MAX_TRIES else self._give_up(grant, tries)
        except AutopilotError:
            raise
        except Exception:
            log.exception("homing: planner failed")
            why = "the planner failed"
        if not why:
            return self.descent(grant)
        back = control.retraces and tries <= MAX_TRIES
        how = "goes back the way it came" if back else "flies straight"
        control.note("returnToLaunch", f"no legal way home is known ({why}); the drone {how}", "NoLegalWay")
        log.error("homing: no legal way home is known, the drone %s (reason=%s)", how, why)
        self.given_up = grant
        return stack.return_retracing if back else stack.return_straight

    async def _keep_home(self) -> None:
        """Set home back if it was moved: the autopilot's own return leads there.

        Raises:
            AutopilotError: it does not stay set back. While the vehicle is heard that counts as a try: a station that moves
                home again and again does not keep the drone in the air.
        """
        control = self._control
        try:
            await restore_home(control.autopilot, control)
        except AutopilotError as error:
            raise AutopilotError(str(error), link=not control.autopilot.connected) from error

    def _path_is_home(self) -> bool:
        """Whether home was moved, so that only the path flown leads back to where the mission armed."""
        return self._control.retraces and home_moved(self._control.state, self._control.autopilot.vehicle)

    def _give_up(self, grant: ActiveGrant, tries: int) -> str:
        """Why the way home is not flown by us any more; nothing where the straight one is legal."""
        return "" if self._clear(self._control.for_transit(grant)) else f"the autopilot refused {tries} times"

    async def _bring(self, grant: ActiveGrant, wanted: Callable[[], bool]) -> str:
        """Fly home; why that is impossible, or nothing.

        Raises:
            AutopilotError: the drone did not fly what it was told.
        """
        control = self._control
        constraints = control.begin_system_flight(grant)

        def permit() -> None:
            if not wanted() or control.constraints is not constraints:
                raise AutopilotError("the system has lost the control of the drone")

        trip = Trip(constraints, "Homeward", lambda motion: _both(permit, motion))
        try:
            await control.modes.enter_guided(permit)
            async for _ in self._courses.follow(trip, lambda: self._search(trip)):
                pass
        except Refused as refusal:
            if self._rests_nowhere(refusal, trip):
                return ""
            if refusal.verdict.code == "NoLegalWay" or refusal.verdict.code in STOPPED:
                return str(refusal)
            moved = home_moved(control.state, control.autopilot.vehicle)
            raise AutopilotError(str(refusal), link=isinstance(refusal, Unavailable) and not moved) from refusal
        finally:
            control.end_system_flight(constraints)
        return ""

    async def attempt(self, trip: Trip, motion: Motion) -> AsyncGenerator[Step, None]:
        """Fly home for a driver, as one motion; the drone is in GUIDED.

        Raises:
            Refused: there is no legal way, and the autopilot remembers none; or the motion was stopped.
            AutopilotError: the autopilot refuses.
        """
        self.given_up = None
        await restore_home(self._control.autopilot, self._control)
        if self._blind():
            return
        try:
            async with aclosing(self._courses.legs(trip, motion, lambda: self._search(trip))) as steps:
                async for step in steps:
                    yield step
        except Refused as refusal:
            if refusal.verdict.code == "NoLegalWay" and self._control.retraces:
                self.given_up = trip.constraints.grant
            elif not self._rests_nowhere(refusal, trip):
                raise

    def descent(self, grant: ActiveGrant) -> FlightMode:
        """How the autopilot does the rest: it lands at home; from elsewhere it flies on the path it came, or straight."""
        autopilot, stack = self._control.autopilot, self._control.autopilot.stack
        if grant is self.given_up:
            return stack.return_retracing
        there = autopilot.vehicle.position_fresh(autopilot.now) and self._home_m() <= 2 * REACHED_M
        return stack.land if there else stack.return_straight

    def _rests_nowhere(self, refusal: Refused, trip: Trip) -> bool:
        """Whether wind keeps the drone from resting where the straight way is legal, so that it flies home all the same."""
        return refusal.verdict.code == "NotStopping" and self._clear(trip.constraints.compiled)

    def _lands_in_zone(self, grant: ActiveGrant) -> bool:
        """Whether the drone, over ground that is closed to it, would come down into what it is above."""
        return descent_enters_fence(self._guard.situation(), self._control.for_transit(grant))

    def _blind(self) -> bool:
        """Whether there is nothing to plan with; the autopilot's own estimate is the better one then."""
        now = self._guard.situation()
        return now.lat is None or now.home is None

    def _clear(self, grant: CompiledGrant) -> bool:
        """Whether the autopilot's own straight way home is legal from where the drone is."""
        now = self._guard.situation()
        if now.lat is None or now.lon is None or now.home is None:
            return True
        room = {"margin": margin_m(now), "slack": height_margin_m(now)}
        return check_straight_return(grant.frame.xy(now.lat, now.lon), now.altitude_m, now, grant, **room) is None

    def _home_m(self) -> float:
        """How far home is."""
        vehicle = self._control.autopilot.vehicle
        return vehicle.distance_m(vehicle.home.lat, vehicle.home.lon) if vehicle.home is not None else math.inf

    async def _search(self, trip: Trip) -> NextLeg | None:
        """The next leg of the way home; None at home, or where nothing can be planned.

        Raises:
            Refused: there is no legal way.
        """
        if home_moved(self._control.state, self._control.autopilot.vehicle):
            raise Unavailable("AutopilotUnavailable", "another station moved home; it is set back first")
        now, away_m = self._guard.situation(), self._home_m()
        if now.lat is None or now.lon is None or now.home is None or away_m <= REACHED_M:
            return None
        for height in return_altitudes_m(now, trip.constraints.compiled, RTL_CONE_SLOPE * away_m):
            turns = may_change_altitude(now, trip.constraints.compiled, height)
            # All of it is flown by us, so the autopilot's own straight return need not be legal from its waypoints:
            # `retraces` takes that condition out of the search.
            free = replace(
                now, airframe=replace(now.airframe, retraces=True), altitude_m=height if turns else now.altitude_m
            )
            found = await first_leg((now.home.lat, now.home.lon), (height,), free, trip)
            if found is None:
                continue
            leg, last, _ = found
            if turns and abs(height - now.altitude_m) > LEVEL_M:
                leg, last = replace(leg, lat=now.lat, lon=now.lon), False
            speed_mps = limited_mps(self._control.cruise_mps, leg, now, trip.constraints.compiled)
            return NextLeg(replace(leg, speed_mps=speed_mps), last=False, reached_m=LAST_LEG_M if last else REACHED_M)
        raise PreconditionFailed("NoLegalWay", "zones are all around the drone or its home")


def _both(permit: Callable[[], None], motion: Motion) -> Callable[[], None]:
    def check() -> None:
        motion.check()
        permit()

    return check
