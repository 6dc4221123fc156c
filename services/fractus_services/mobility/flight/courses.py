"""Flights by the system: the shortest legal way to a place, leg by leg, around zones that appear on it."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Callable, Iterable
from contextlib import aclosing
from dataclasses import dataclass, replace

import shapely
from fractus_core.api.geometry import Position, Reference
from fractus_core.policy.compiled import Air, CompiledGrant, height_m
from fractus_core.policy.limits import speed_bounds
from fractus_core.policy.motion import margin_m
from fractus_core.policy.routes import searching
from fractus_core.policy.values import Call, GotoArgs, Home, Situation

from fractus_services.background import in_slices
from fractus_services.errors import Aborted, PreconditionFailed, Refused, Unavailable
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.leases import FlightConstraints, Motion
from fractus_services.mobility.autopilot import Permit
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.motions import REACHED_M, Step, come_to_rest, fly_to

log = logging.getLogger(__name__)

MAX_REPLANS = 5
"""How many times a way is looked for again after the monitor stopped the drone on it."""

MAX_LEGS = 60
"""A way with more legs than this makes no headway: every leg is planned again from where the drone is."""

FAULT = "the mobility service has a fault, see its log"
"""What clients read when an error of ours ends a mission; its details are in the log."""

STOPPED = frozenset(
    {
        "ExclusionZoneAhead", "InsideExclusionZone", "InclusionBorderAhead", "OutsideInclusionZone",
        "OperationAreaBorderAhead", "OutsideOperationArea", "AltitudeAboveLimit",
    }
)  # fmt: skip
"""Codes with which the monitor stops a leg that has become illegal: another way may exist. Other codes end the flight."""


@dataclass(frozen=True, slots=True)
class Trip:
    """A flight by the system.

    Attributes:
        constraints: what it keeps to; they follow the grant when that changes in flight.
        kind: what its motions are called.
        permit: for each motion, the check that each of its commands must pass before it is sent.
    """

    constraints: FlightConstraints
    kind: str
    permit: Callable[[Motion], Permit]


def target_of(place: Position) -> GotoArgs:
    """A place as the engine takes it."""
    return GotoArgs(place.lat, place.lon, place.alt, place.altitude_reference)


def above_home_m(altitude_m: float, reference: Reference, home: Home | None, grant: CompiledGrant) -> float:
    """An altitude as metres above home.

    Raises:
        Refused: it is given above terrain, which is not known.
    """
    height = height_m(altitude_m, reference, home, grant.flat_terrain)
    if height is None:
        raise PreconditionFailed(
            "TerrainUnknown", "the altitude is given above terrain, and no terrain model is loaded"
        )
    return height


def stopped_by_monitor(refusal: Refused) -> bool:
    """Whether a leg ended because it had become illegal, so that another way may exist."""
    return isinstance(refusal, Aborted) and refusal.verdict.code in STOPPED


async def first_leg(
    goal: tuple[float, float], heights_m: Iterable[float], now: Situation, trip: Trip
) -> tuple[GotoArgs, bool, float] | None:
    """The first leg of the shortest legal way to a place from where the drone stands.

    The search runs in slices between the other tasks of the event loop. Constraints that change meanwhile start it again.

    Args:
        goal: latitude and longitude.
        heights_m: altitudes above home to fly at, in the order of preference.
        now: the state of the drone; its position is known.
        trip: whose constraints.

    Returns:
        The leg, whether it is the last one, and the altitude of the way; None when there is no way.

    Raises:
        Refused: the constraints change faster than a way is found.
    """
    heights = tuple(dict.fromkeys(heights_m))
    for _ in range(MAX_REPLANS + 1):
        grant = trip.constraints.compiled
        found = await _first_leg(goal, heights, now, grant)
        if trip.constraints.compiled is grant:
            return found
    raise Aborted("FencesChanged", "the flight constraints change faster than a way is found")


async def _first_leg(
    goal: tuple[float, float], heights_m: Iterable[float], now: Situation, grant: CompiledGrant
) -> tuple[GotoArgs, bool, float] | None:
    frame = grant.frame
    begin, end = frame.xy(now.lat or 0.0, now.lon or 0.0), frame.xy(*goal)
    for height in heights_m:
        way = await in_slices(searching(begin, end, now, grant, height, from_m=now.altitude_m))
        if way is not None:
            return GotoArgs(*frame.latlon(*way[0]), height), len(way) == 1, height
    return None


def limited_mps(speed_mps: float, leg: GotoArgs, now: Situation, grant: CompiledGrant) -> float:
    """The speed that the limits along a leg allow, at most the wanted one.

    Lower limits do not count and no limit refuses the leg: the system flies home even where a driver may not fly.

    Args:
        speed_mps: wanted.
        leg: altitude above home.
        now: the state of the drone.
        grant: whose limits.
    """
    at = grant.locate(now)
    if at is None:
        return speed_mps
    target = grant.frame.xy(leg.lat, leg.lon)
    heights = (now.altitude_m, now.altitude_m if leg.alt is None else leg.alt)
    ground = shapely.points(at) if at == target else shapely.linestrings((at, target))
    air = Air(ground, margin_m(now), min(heights), max(heights))
    return min([speed_mps, *(bound.upper for bound in speed_bounds(grant, now, air) if bound.upper is not None)])


class Courses:
    """Flies the system's trips."""

    def __init__(self, control: Control, guard: Guard) -> None:
        self._control = control
        self._guard = guard

    async def fly(self, trip: Trip, target: GotoArgs) -> AsyncGenerator[Step, None]:
        """Fly to a place; a way that becomes illegal under the flying drone is replaced by another.

        Raises:
            Refused: there is no legal way, or the trip is over.
            AutopilotError: the autopilot refuses.
        """
        for attempt in range(MAX_REPLANS + 1):
            motion = self._control.begin(trip.kind)
            try:
                async with aclosing(self._along(trip, motion, target)) as steps:
                    async for step in steps:
                        yield step
            except Refused as refusal:
                if attempt == MAX_REPLANS or not stopped_by_monitor(refusal):
                    raise
                log.info("courses: leg stopped, searching another way (attempt=%d, reason=%s)", attempt + 1, refusal)
            else:
                return
            finally:
                self._control.finish(motion)

    async def _along(self, trip: Trip, motion: Motion, target: GotoArgs) -> AsyncGenerator[Step, None]:
        autopilot, permit = self._control.autopilot, trip.permit(motion)
        for _ in range(MAX_LEGS):
            # A leg is judged from where it begins: a drone that still moves would begin it somewhere else.
            if not autopilot.vehicle.at_rest(autopilot.now):
                await come_to_rest(autopilot, motion, permit)
            leg, last = await self._next(trip, target)
            leg = self._allowed(trip, leg)
            if last:
                leg = replace(leg, yaw_deg=target.yaw_deg)
            async for step in fly_to(autopilot, motion, leg, REACHED_M, permit):
                yield Step(step.distance_m, step.complete and last)
            if last:
                return
        raise Aborted("NotFollowing", f"the drone did not arrive within {MAX_LEGS} legs")

    async def _next(self, trip: Trip, target: GotoArgs) -> tuple[GotoArgs, bool]:
        now, grant = self._guard.situation(), trip.constraints.compiled
        if now.lat is None or now.lon is None:
            raise Unavailable("AutopilotUnavailable", "the drone's position is not known")
        wanted = now.altitude_m if target.alt is None else above_home_m(target.alt, target.reference, now.home, grant)
        found = await first_leg((target.lat, target.lon), (wanted, now.altitude_m), now, trip)
        if found is None:
            raise self._unreachable(trip, target)
        leg, last, height = found
        # The only legal way was at the present height. Its end is a stop on the way: from there the drone climbs or sinks.
        if last and height != wanted:
            if self._arrived(leg):
                raise self._unreachable(trip, target)
            last = False
        return leg, last

    def _arrived(self, leg: GotoArgs) -> bool:
        """Whether the drone is at the end of a leg already, so that flying it would change nothing."""
        return self._control.autopilot.vehicle.distance_m(leg.lat, leg.lon) <= 2 * REACHED_M

    def _unreachable(self, trip: Trip, target: GotoArgs) -> Refused:
        """The refusal when no way is found; the verdict on the straight leg names the zone that is in the way."""
        verdict = self._guard.judge(Call("Goto", target), trip.constraints.grant, trip.constraints.compiled)
        why = verdict.reason or "no way around the zones is found"
        return PreconditionFailed("NoLegalWay", f"the system cannot fly to {target.lat:.6f}, {target.lon:.6f}: {why}")

    def _allowed(self, trip: Trip, leg: GotoArgs) -> GotoArgs:
        """A leg as the policies allow it."""
        verdict = self._guard.judge(Call("Goto", leg), trip.constraints.grant, trip.constraints.compiled)
        if not verdict.permits or not isinstance(verdict.args, GotoArgs):
            raise PreconditionFailed("NoLegalWay", f"the system cannot fly there: {verdict.reason}")
        return replace(verdict.args, speed_mps=verdict.args.speed_mps or self._control.cruise_mps)
