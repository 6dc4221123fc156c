"""Flights by the system: the shortest legal way to a place, leg by leg, around zones that appear on it."""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from contextlib import aclosing
from dataclasses import dataclass, replace
from typing import Protocol

import shapely
from fractus_core.api.geometry import Position, Reference
from fractus_core.control.state import FlightMode
from fractus_core.policy.altitude import altitude_above_home_m
from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant
from fractus_core.policy.decision_types import Call, GotoArgs, Home, Situation
from fractus_core.policy.kinematics import margin_m
from fractus_core.policy.limits import speed_bounds
from fractus_core.policy.route_search import route_steps

from fractus_services.background import in_slices
from fractus_services.errors import Aborted, PreconditionFailed, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.leases import FlightConstraints, Motion
from fractus_services.mobility.autopilot import Permit
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.motions import HEIGHT_REACHED_M, REACHED_M, Step, come_to_rest, fly_to

log = logging.getLogger(__name__)

MAX_REPLANS = 5
"""How many times a way is looked for again after the monitor stopped the drone on it, under the same fences."""

MAX_LEGS = 60
"""A way with more legs than this makes no headway: every leg is planned again from where the drone is."""

NEAR_M = 0.3
"""A drone this near to a waypoint is there: waypoints keep more than this beyond the margin of legs."""

FAULT = "the mobility service has a fault, see its log"
"""What clients read when an error of ours ends a mission; its details are in the log."""

STOPPED = frozenset(
    {
        "ExclusionZoneAhead", "InsideExclusionZone", "InclusionBorderAhead", "OutsideInclusionZone",
        "OperationAreaBorderAhead", "OutsideOperationArea", "AltitudeAboveLimit", "AltitudeBelowLimit",
    }
)  # fmt: skip
"""Codes with which the monitor stops a leg that has become illegal: another way may exist. Other codes end the flight."""


Search = Callable[[], Awaitable["NextLeg | None"]]


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
    height = altitude_above_home_m(altitude_m, reference, home, grant.flat_terrain)
    if height is None:
        raise PreconditionFailed(
            "TerrainUnknown", "the altitude is given above terrain, and no terrain model is loaded"
        )
    return height


class Replans:
    """Counts how often another way was looked for, since the fences changed last.

    Args:
        constraints: of the flight.
    """

    def __init__(self, constraints: FlightConstraints) -> None:
        self._constraints = constraints
        self._compiled = constraints.compiled
        self._count = 0

    def allow(self, refusal: Refused) -> bool:
        """Whether a flight that was refused goes on: a leg of it had become illegal, so that another way may exist."""
        if self._constraints.compiled is not self._compiled:
            self._compiled, self._count = self._constraints.compiled, 0
        self._count += 1
        if self._count > MAX_REPLANS or not (isinstance(refusal, Aborted) and refusal.verdict.code in STOPPED):
            return False
        log.info("courses: leg stopped, searching another way (attempt=%d, reason=%s)", self._count, refusal)
        return True


@dataclass(frozen=True, slots=True)
class NextLeg:
    """What is flown next of a way.

    Attributes:
        args: the leg.
        last: whether the way ends with it.
        reached_m: how near to its end it is complete.
    """

    args: GotoArgs
    last: bool
    reached_m: float = REACHED_M


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
        way = await in_slices(route_steps(begin, end, now, grant, height, from_m=now.altitude_m))
        if way is not None:
            # From a place this near to a waypoint the next leg is legal, and this one would change nothing but the height.
            there = math.dist(begin, way[0]) <= NEAR_M and abs(now.altitude_m - height) <= HEIGHT_REACHED_M
            first = min(there, len(way) - 1)
            return GotoArgs(*frame.latlon(*way[first]), height), len(way) == first + 1, height
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
    air = AirVolume(ground, margin_m(now), min(heights), max(heights))
    return min([speed_mps, *(bound.upper for bound in speed_bounds(grant, now, air) if bound.upper is not None)])


class WayHome(Protocol):
    """The way home, as others need it.

    Attributes:
        given_up: the grant under which no legal way home was known last: the autopilot's own is flown then.
    """

    given_up: ActiveGrant | None

    def attempt(self, trip: Trip, motion: Motion) -> AsyncGenerator[Step, None]:
        """Fly home for a driver, as one motion; the drone is in GUIDED."""

    def descent(self, grant: ActiveGrant) -> FlightMode:
        """How the autopilot does the rest."""


class Courses:
    """Flies the system's trips."""

    def __init__(self, control: ControlStore, guard: Guard) -> None:
        self._control = control
        self._guard = guard

    async def fly(self, trip: Trip, target: GotoArgs) -> AsyncGenerator[Step, None]:
        """Fly to a place; a way that becomes illegal under the flying drone is replaced by another.

        Raises:
            Refused: there is no legal way, or the trip is over.
            AutopilotError: the autopilot refuses.
        """
        async with aclosing(self.follow(trip, lambda: self._next(trip, target))) as steps:
            async for step in steps:
                yield step

    async def follow(self, trip: Trip, search: Search) -> AsyncGenerator[Step, None]:
        """Fly leg by leg, as `fly` does.

        Args:
            trip: whose flight.
            search: the next leg from where the drone rests; None when it is there.
        """
        replans = Replans(trip.constraints)
        while True:
            motion = self._control.begin_motion(trip.kind, trip.permit)
            try:
                async with aclosing(self.legs(trip, motion, search)) as steps:
                    async for step in steps:
                        yield step
            except Refused as refusal:
                if not replans.allow(refusal):
                    raise
            else:
                return
            finally:
                self._control.finish_motion(motion)

    async def legs(self, trip: Trip, motion: Motion, search: Search) -> AsyncGenerator[Step, None]:
        """One attempt of `follow`, as one motion."""
        autopilot, permit = self._control.autopilot, trip.permit(motion)
        for _ in range(MAX_LEGS):
            # A leg is judged from where it begins: a drone that still moves would begin it somewhere else.
            if not autopilot.at_rest:
                await come_to_rest(autopilot, motion, permit)
            leg = await search()
            if leg is None:
                return
            away_m = autopilot.vehicle.distance_m(leg.args.lat, leg.args.lon)
            # A leg that is shorter than the usual radius, out of a zone's margin say, is flown all the same.
            short = NEAR_M < away_m < 2 * leg.reached_m and not leg.last
            reached_m = min(leg.reached_m, max(away_m / 3, NEAR_M)) if short else leg.reached_m
            async with aclosing(fly_to(autopilot, motion, leg.args, reached_m, permit)) as steps:
                async for step in steps:
                    yield Step(step.distance_m, step.complete and leg.last)
            if leg.last:
                return
        raise Aborted("NotFollowing", f"the drone did not arrive within {MAX_LEGS} legs")

    async def _next(self, trip: Trip, target: GotoArgs) -> NextLeg:
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
        leg = self._allowed(trip, leg)
        return NextLeg(replace(leg, yaw_deg=target.yaw_deg) if last else leg, last)

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
