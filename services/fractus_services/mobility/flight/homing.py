"""The way home: the autopilot's own straight return where it is legal, else a flight around what is in its way."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import replace

from fractus_core.control.values import FlightMode
from fractus_core.policy.compiled import CompiledGrant
from fractus_core.policy.motion import height_margin_m, margin_m
from fractus_core.policy.returning import straight_home_blocked
from fractus_core.policy.values import GotoArgs, Situation

from fractus_services.errors import AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grants import ActiveGrant
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.flight.courses import (
    MAX_LEGS,
    MAX_REPLANS,
    Trip,
    first_leg,
    limited_mps,
    stopped_by_monitor,
)
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.motions import REACHED_M, Step, come_to_rest, fly_to

log = logging.getLogger(__name__)

HOME_M = 3.0
"""Closer to home than this the rest is left to the autopilot, which only comes down there."""

MAX_TRIES = 3
"""How many times the system tries to fly around what is in the way when the autopilot refuses. After that the drone goes
back the way it came (SmartRTL), and when that is refused too, straight (RTL)."""


class Homing:
    """Brings the drone to where the autopilot's own return is legal."""

    def __init__(self, control: Control, guard: Guard) -> None:
        self._control = control
        self._guard = guard

    async def approach(self, wanted: Callable[[], bool], tries: int) -> FlightMode:
        """Fly, for the system, until the autopilot can do the rest.

        Args:
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
        if grant is None or not vehicle.in_air or vehicle.mode.comes_down:
            return stack.return_straight
        try:
            why = await self._bring(grant, wanted) if tries < MAX_TRIES else self._give_up(grant, tries)
        except AutopilotError:
            raise
        except Exception:
            log.exception("homing: planner failed")
            why = "the planner failed"
        if not why:
            return stack.return_straight
        back = control.retraces and tries <= MAX_TRIES
        how = "goes back the way it came" if back else "flies straight"
        control.note("returnToLaunch", f"no legal way home is known ({why}); the drone {how}", "NoLegalWay")
        log.error("homing: no legal way home is known, the drone %s (reason=%s)", how, why)
        return stack.return_retracing if back else stack.return_straight

    def _give_up(self, grant: ActiveGrant, tries: int) -> str:
        """Why the way home is not flown by us any more; nothing where the straight one is legal."""
        return "" if self._clear(grant.compiled) else f"the autopilot refused {tries} times"

    async def _bring(self, grant: ActiveGrant, wanted: Callable[[], bool]) -> str:
        """Fly to where the straight way home is legal; why that is impossible, or nothing."""
        control = self._control
        if self._clear(grant.compiled):
            return ""
        constraints = control.begin_system_flight(grant)

        def permit() -> None:
            if not wanted() or control.constraints is not constraints:
                raise AutopilotError("the system has lost the control of the drone")

        try:
            await control.modes.enter_guided(permit)
            return await self._round(Trip(constraints, "Homeward", lambda motion: _both(permit, motion)))
        finally:
            control.end_system_flight(constraints)

    async def _round(self, trip: Trip) -> str:
        """Fly around what is in the way; why there is no way, or nothing.

        Raises:
            AutopilotError: the drone did not fly what it was told.
        """
        why = ""
        for _ in range(MAX_REPLANS + 1):
            motion = self._control.begin(trip.kind)
            try:
                async for _ in self.around(trip, motion):
                    pass
            except Refused as refusal:
                why = str(refusal)
                if refusal.verdict.code == "NoLegalWay":
                    return why
                if not stopped_by_monitor(refusal):
                    raise AutopilotError(why, link=isinstance(refusal, Unavailable)) from refusal
            else:
                return ""
            finally:
                self._control.finish(motion)
        return why

    async def around(self, trip: Trip, motion: Motion) -> AsyncGenerator[Step, None]:
        """Fly the legs after which the straight way home is legal; none when it is already. The drone is in GUIDED.

        It comes to rest before each judgement, so that what is judged is the place where the way begins.

        Raises:
            Refused: there is no such way, or the motion was stopped.
            AutopilotError: the autopilot refuses.
        """
        autopilot, permit = self._control.autopilot, trip.permit(motion)
        for _ in range(MAX_LEGS):
            if self._guard.situation().lat is not None and not autopilot.vehicle.at_rest(autopilot.now):
                try:
                    await come_to_rest(autopilot, motion, permit)
                except Refused as refusal:
                    if refusal.verdict.code == "NotStopping" and self._clear(trip.constraints.compiled):
                        return  # Wind keeps it from resting; the straight way is legal from here, so it flies home all the same.
                    raise
            leg = await self._leg(trip)
            if leg is None:
                return
            async with aclosing(fly_to(autopilot, motion, leg, REACHED_M, permit)) as steps:
                async for step in steps:
                    yield Step(step.distance_m, complete=False)
        raise PreconditionFailed("NoLegalWay", f"the drone is not home after {MAX_LEGS} legs")

    def _clear(self, grant: CompiledGrant) -> bool:
        now = self._guard.situation()
        if now.lat is None or now.lon is None or now.home is None:
            return True  # Without a position there is nothing to plan with; the autopilot's own estimate is the better one.
        return _straight(now, grant)

    async def _leg(self, trip: Trip) -> GotoArgs | None:
        now, grant = self._guard.situation(), trip.constraints.compiled
        if now.lat is None or now.lon is None or now.home is None or _straight(now, grant):
            return None
        # All of it is flown by us, so the autopilot's own straight return need not be legal from its waypoints:
        # `retraces` takes that condition out of the search.
        free = replace(now, airframe=replace(now.airframe, retraces=True))
        home = (now.home.lat, now.home.lon)
        found = await first_leg(home, (now.altitude_m, now.airframe.return_altitude_m), free, trip)
        if found is None:
            raise PreconditionFailed("NoLegalWay", "zones are all around the drone or its home")
        leg, last, _ = found
        if last and self._control.autopilot.vehicle.distance_m(leg.lat, leg.lon) <= HOME_M:
            return None
        return replace(leg, speed_mps=limited_mps(self._control.cruise_mps, leg, now, grant))


def _straight(now: Situation, grant: CompiledGrant) -> bool:
    """Whether the autopilot's own straight way home is legal from where the drone is."""
    at = grant.frame.xy(now.lat or 0.0, now.lon or 0.0)
    room = {"margin": margin_m(now), "slack": height_margin_m(now)}
    return straight_home_blocked(at, now.altitude_m, now, grant, **room) is None


def _both(permit: Callable[[], None], motion: Motion) -> Callable[[], None]:
    def check() -> None:
        motion.check()
        permit()

    return check
