"""The way home: the autopilot's own straight one where it is legal, else around what stands in its way."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Callable
from contextlib import aclosing
from dataclasses import replace

from fractus_core.policy.compiled import CompiledGrant
from fractus_core.policy.motion import height_margin_m, margin_m
from fractus_core.policy.returning import straight_home_blocked
from fractus_core.policy.values import GotoArgs, Situation

from fractus_services.errors import AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grants import ActiveGrant
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.leases import Motion
from fractus_services.mobility.flight.courses import MAX_LEGS, REPLANS, Trip, first_leg, limited_mps, stopped_by_monitor
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.motions import REACHED_M, Step, come_to_rest, fly_to
from fractus_services.mobility.mavlink.vehicle import GUIDED, HOMEWARD, RTL, SMART_RTL

log = logging.getLogger(__name__)

HOME_M = 3.0

TRIES = 3
"""So often the system tries to fly around what is in the way, when the autopilot refuses; the way that the drone came is
tried after that, and at last the straight one."""


class Homing:
    """Brings the drone to where the autopilot's own return is legal."""

    def __init__(self, control: Control, guard: Guard) -> None:
        self._control = control
        self._guard = guard

    async def approach(self, wanted: Callable[[], bool], tries: int) -> int:
        """Fly, for the system, until the autopilot can do the rest.

        Args:
            wanted: whether the system still has the drone.
            tries: how often that has failed.

        Returns:
            The mode in which the autopilot does the rest. Where no legal way home is known it is the path that the drone
            came, if the autopilot remembers that, and else straight: a drone that stays in the air comes down anywhere.

        Raises:
            AutopilotError: the autopilot refuses, or its link broke.
        """
        control = self._control
        grant, vehicle = control.last_grant, control.autopilot.vehicle
        if grant is None or not vehicle.in_air or vehicle.mode in HOMEWARD:
            return RTL
        try:
            why = await self._bring(grant, wanted) if tries < TRIES else self._give_up(grant, tries)
        except AutopilotError:
            raise
        except Exception:
            log.exception("the way home cannot be planned")
            why = "the planner failed"
        if not why:
            return RTL
        back = control.retraces and tries <= TRIES
        how = "goes back the way it came" if back else "flies straight"
        control.note("returnToLaunch", "system", f"no legal way home is known ({why}); the drone {how}", "NoLegalWay")
        log.error("no legal way home is known (%s); the drone %s", why, how)
        return SMART_RTL if back else RTL

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
                raise AutopilotError("the system does not have the drone any more")

        try:
            await control.modes.change_mode(GUIDED, permit)
            return await self._round(Trip(constraints, "Homeward", lambda motion: _both(permit, motion)))
        finally:
            control.end_system_flight(constraints)

    async def _round(self, trip: Trip) -> str:
        """Fly around what is in the way; why there is no way, or nothing.

        Raises:
            AutopilotError: the drone did not fly what it was told.
        """
        why = ""
        for _ in range(REPLANS + 1):
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

    async def around(self, trip: Trip, motion: Motion) -> AsyncIterator[Step]:
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
                        return  # in a wind that gives it no rest the drone flies home all the same
                    raise
            leg = await self._leg(trip)
            if leg is None:
                return
            async with aclosing(fly_to(autopilot, motion, leg, REACHED_M, permit)) as steps:  # type: ignore[type-var]
                async for step in steps:
                    yield Step(step.distance_m, complete=False)
        raise PreconditionFailed("NoLegalWay", f"the drone is not home after {MAX_LEGS} legs")

    def _clear(self, grant: CompiledGrant) -> bool:
        now = self._guard.situation()
        if now.lat is None or now.lon is None or now.home is None:
            return True  # nobody can say anything of the way; the autopilot knows more than we do
        return _straight(now, grant)

    async def _leg(self, trip: Trip) -> GotoArgs | None:
        now, grant = self._guard.situation(), trip.constraints.compiled
        if now.lat is None or now.lon is None or now.home is None or _straight(now, grant):
            return None
        # The whole way is flown by us, so the autopilot's own straight one need not be legal from its waypoints.
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
