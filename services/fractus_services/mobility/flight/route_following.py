"""System flights along the shortest legal route. The route is planned again before each leg, and when zones appear on it."""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from contextlib import aclosing
from dataclasses import dataclass, replace

import shapely
from fractus_core.api.geometry import Position, Reference
from fractus_core.policy.compiled_grant import AirVolume, CompiledGrant, altitude_above_home_m
from fractus_core.policy.decision_types import Call, GotoArgs, Home, Situation
from fractus_core.policy.limits import speed_bounds
from fractus_core.policy.route_search import route_steps

from fractus_services.background import in_slices
from fractus_services.errors import Aborted, PreconditionFailed, Refused, Unavailable
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.effects import FlightConstraints, Motion
from fractus_services.mobility.autopilot import Permit
from fractus_services.mobility.flight.authorization import PolicyGate
from fractus_services.mobility.flight.motions import Step, come_to_rest, fly_to
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)

INTERNAL_ERROR = "the mobility service has an internal error; see its log"
"""Reason that clients receive when an internal error ends a mission. The log has the details."""

REPLAN_CODES = frozenset(
    {
        "ExclusionZoneAhead", "InsideExclusionZone", "InclusionBorderAhead", "OutsideInclusionZone",
        "OperationAreaBorderAhead", "OutsideOperationArea", "AltitudeAboveLimit", "AltitudeBelowLimit",
    }
)  # fmt: skip
"""Codes of legs that became illegal. Another route may still be legal. Other codes end the flight."""


Search = Callable[[], Awaitable["NextLeg | None"]]


@dataclass(frozen=True, slots=True)
class SystemFlight:
    """A flight by the system.

    Attributes:
        constraints: Flight constraints. If the grant changes, the constraints change too.
        kind: Kind of the motions of the flight.
        permit: Returns the permit for the commands of a motion.
        return_altitude_m: Altitude above home that a return flight prefers. None: the return altitude of the autopilot.
    """

    constraints: FlightConstraints
    kind: str
    permit: Callable[[Motion], Permit]
    return_altitude_m: float | None = None


def target_of(position: Position) -> GotoArgs:
    """Return a position as the target of a goto."""
    return GotoArgs(position.lat, position.lon, position.alt, position.altitude_reference)


def above_home_m(altitude_m: float, reference: Reference, home: Home | None, grant: CompiledGrant) -> float:
    """Return an altitude in metres above home.

    Raises:
        Refused: The altitude is above terrain, and the terrain is unknown.
    """
    height = altitude_above_home_m(altitude_m, reference, home, grant.flat_terrain)
    if height is None:
        raise PreconditionFailed(
            "TerrainUnknown", "the altitude is relative to terrain, and no terrain model is loaded; use home or amsl"
        )
    return height


class ReplanBudget:
    """Limits the number of route searches under the same flight constraints. Changed constraints reset the count.

    Args:
        constraints: Constraints of the flight.
    """

    def __init__(self, constraints: FlightConstraints) -> None:
        self._constraints = constraints
        self._compiled = constraints.compiled
        self._count = 0

    def allow(self, refusal: Refused) -> bool:
        """Count a refused leg. Return True if the flight may continue on a different route."""
        if self._constraints.compiled is not self._compiled:
            self._compiled = self._constraints.compiled
            self._count = 0
        self._count += 1
        if self._count > SETTINGS.max_replans or not (
            isinstance(refusal, Aborted) and refusal.verdict.code in REPLAN_CODES
        ):
            return False
        log.info("route: leg stopped, searching a different route (attempt=%d reason=%s)", self._count, refusal)
        return True


@dataclass(frozen=True, slots=True)
class NextLeg:
    """The next leg of a route.

    Attributes:
        args: Target, altitude and speed of the leg.
        last: True if the route ends with this leg.
        reached_m: Distance to the target within which the leg is complete.
        settles: True if the drone lands at the target, see `fly_to`.
    """

    args: GotoArgs
    last: bool
    reached_m: float = SETTINGS.reached_m
    settles: bool = False

    def acceptance_m(self, length_m: float) -> float:
        """Return the distance to the target within which a leg of this length is complete.

        The distance is smaller than `reached_m` for a short leg, for example out of a zone's margin, so that the drone flies it.
        """
        if self.last or not SETTINGS.at_waypoint_m < length_m < 2 * self.reached_m:
            return self.reached_m
        return min(self.reached_m, max(length_m / 3, SETTINGS.at_waypoint_m))


async def first_leg(
    goal: tuple[float, float], heights_m: Iterable[float], now: Situation, flight: SystemFlight
) -> tuple[GotoArgs, bool, float] | None:
    """Return the first leg of the shortest legal route from the current position.

    The search runs in slices between other tasks of the event loop. It restarts if the constraints change.

    Args:
        goal: Latitude and longitude.
        heights_m: Altitudes above home to fly at, in order of preference.
        now: Present situation, with a known position.
        flight: System flight whose constraints apply.

    Returns:
        The leg, True if it is the last leg of the route, and the altitude of the route; None if there is no route.

    Raises:
        Refused: The constraints change faster than a route is found.
    """
    heights = tuple(dict.fromkeys(heights_m))
    for _ in range(SETTINGS.max_replans + 1):
        grant = flight.constraints.compiled
        leg = await _first_leg(goal, heights, now, grant)
        if flight.constraints.compiled is grant:
            return leg
    raise Aborted("FencesChanged", "the flight constraints change faster than a route is found")


async def _first_leg(
    goal: tuple[float, float], heights_m: Iterable[float], now: Situation, grant: CompiledGrant
) -> tuple[GotoArgs, bool, float] | None:
    frame = grant.frame
    begin = frame.xy(now.lat or 0.0, now.lon or 0.0)
    end = frame.xy(*goal)
    for height in heights_m:
        route = await in_slices(route_steps(begin, end, now, grant, height, from_m=now.altitude_m))
        if route is not None:
            # If the drone is already at the first waypoint, skip it: the next leg is legal from the current position.
            reached = (
                math.dist(begin, route[0]) <= SETTINGS.at_waypoint_m
                and abs(now.altitude_m - height) <= SETTINGS.height_reached_m
            )
            first = min(reached, len(route) - 1)
            return GotoArgs(*frame.latlon(*route[first]), height), len(route) == first + 1, height
    return None


def limited_mps(speed_mps: float, leg: GotoArgs, now: Situation, grant: CompiledGrant) -> float:
    """Return the highest speed to command under the limits along a leg, at most the requested speed.

    Minimum speeds are ignored, and no limit refuses the leg, because the system must return even from where a driver may not fly.

    Args:
        speed_mps: Requested speed.
        leg: Leg with its altitude above home.
        now: Present situation.
        grant: Compiled constraints with the limits.
    """
    at = grant.locate(now)
    if at is None:
        return speed_mps
    target = grant.frame.xy(leg.lat, leg.lon)
    heights = (now.altitude_m, now.altitude_m if leg.alt is None else leg.alt)
    ground = shapely.points(at) if at == target else shapely.linestrings((at, target))
    air = AirVolume(ground, now.margin_m, min(heights), max(heights))
    bounds = speed_bounds(grant, now, air, now.height_margin_m)
    return min([speed_mps, *(bound.highest for bound in bounds if bound.highest is not None)])


class RouteFollower:
    """Flies system flights along legal routes.

    Args:
        control: Control state.
        gate: Policy engine.
    """

    def __init__(self, control: ControlStore, gate: PolicyGate) -> None:
        self._control = control
        self._gate = gate

    async def fly(self, flight: SystemFlight, target: GotoArgs) -> AsyncGenerator[Step, None]:
        """Fly to a target. A route that becomes illegal in flight is replaced.

        Raises:
            Refused: There is no legal route, or the flight lost its permit.
            AutopilotError: The autopilot refused.
        """
        async with aclosing(self.follow(flight, lambda: self._next(flight, target))) as steps:
            async for step in steps:
                yield step

    async def follow(self, flight: SystemFlight, search: Search) -> AsyncGenerator[Step, None]:
        """Fly leg by leg, as `fly` does.

        Args:
            flight: System flight.
            search: Returns the next leg from the current position at rest; None at the target.
        """
        replans = ReplanBudget(flight.constraints)
        while True:
            motion = self._control.begin_motion(flight.kind, flight.permit)
            try:
                async with aclosing(self.legs(flight, motion, search)) as steps:
                    async for step in steps:
                        yield step
            except Refused as refusal:
                if not replans.allow(refusal):
                    raise
            else:
                return
            finally:
                self._control.finish_motion(motion)

    async def legs(self, flight: SystemFlight, motion: Motion, search: Search) -> AsyncGenerator[Step, None]:
        """Fly the legs of one attempt of `follow` as one motion."""
        autopilot = self._control.autopilot
        permit = flight.permit(motion)
        for _ in range(SETTINGS.max_legs):
            # A leg is judged from the current position. A moving drone would begin the leg at another position.
            if not autopilot.at_rest:
                await come_to_rest(autopilot, motion, permit)
            leg = await search()
            if leg is None:
                return
            reached_m = leg.acceptance_m(autopilot.vehicle.distance_m(leg.args.lat, leg.args.lon))
            flying = fly_to(autopilot, motion, leg.args, reached_m, permit, settles=leg.settles)
            async with aclosing(flying) as steps:
                async for step in steps:
                    yield Step(step.distance_m, step.complete and leg.last)
            if leg.last:
                return
        raise Aborted("NotFollowing", f"the drone did not reach its target within {SETTINGS.max_legs} legs")

    async def _next(self, flight: SystemFlight, target: GotoArgs) -> NextLeg:
        now = self._gate.situation()
        grant = flight.constraints.compiled
        if now.lat is None or now.lon is None:
            raise Unavailable("AutopilotUnavailable", "the drone's position is not known")
        altitude_m = now.altitude_m
        if target.alt is not None:
            altitude_m = above_home_m(target.alt, target.reference, now.home, grant)
        first = await first_leg((target.lat, target.lon), (altitude_m, now.altitude_m), now, flight)
        if first is None:
            raise self._unreachable(flight, target)
        leg, last, height = first
        # If the only legal route is at the current altitude, the drone stops at its end, and the next leg climbs or descends.
        if last and height != altitude_m:
            if self._arrived(leg):
                raise self._unreachable(flight, target)
            last = False
        leg = self._allowed(flight, leg)
        return NextLeg(replace(leg, yaw_deg=target.yaw_deg) if last else leg, last)

    def _arrived(self, leg: GotoArgs) -> bool:
        """Return True if the drone is at the end of a leg already."""
        return self._control.autopilot.vehicle.distance_m(leg.lat, leg.lon) <= 2 * SETTINGS.reached_m

    def _unreachable(self, flight: SystemFlight, target: GotoArgs) -> Refused:
        """Return the refusal for a missing route. The verdict on the straight leg names the zone in the way."""
        verdict = self._gate.judge(Call("Goto", target), flight.constraints.grant, flight.constraints.compiled)
        reason = verdict.reason or "no route around the zones was found"
        return PreconditionFailed(
            "NoLegalWay", f"the system cannot fly to {target.lat:.6f}, {target.lon:.6f}: {reason}"
        )

    def _allowed(self, flight: SystemFlight, leg: GotoArgs) -> GotoArgs:
        """Return the leg with the corrections that the policies require.

        Raises:
            PreconditionFailed: The policies forbid the leg.
        """
        verdict = self._gate.judge(Call("Goto", leg), flight.constraints.grant, flight.constraints.compiled)
        if not verdict.permits or not isinstance(verdict.args, GotoArgs):
            raise PreconditionFailed("NoLegalWay", f"the system cannot fly this leg: {verdict.reason}")
        return replace(verdict.args, speed_mps=verdict.args.speed_mps or self._control.cruise_mps)
