"""Return flights: the system flies home, or to a landing place, on legal legs. The autopilot's own return is the last resort."""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import replace

from fractus_core.control.state import FlightMode, ModeKind, TaskKind
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.geofences import RTL_CONE_SLOPE, check_straight_return
from fractus_core.policy.return_route import (
    descent_enters_fence,
    landing_problem,
    may_change_altitude,
    return_altitudes_m,
)

from fractus_services.errors import AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.effects import Motion
from fractus_services.mobility.flight.authorization import PolicyGate
from fractus_services.mobility.flight.motions import Step, has_settled
from fractus_services.mobility.flight.route_following import (
    REPLAN_CODES,
    NextLeg,
    RouteFollower,
    SystemFlight,
    first_leg,
    limited_mps,
)
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)


class ReturnFlight:
    """Flies the drone home, or to the landing place of a mission that a policy has aborted.

    Args:
        control: Control state.
        gate: Policy engine.
        routes: Follows the legs of a route.

    Attributes:
        given_up: Grant under which the last search found no legal return. The drone then flies the autopilot's own
            return.
    """

    def __init__(self, control: ControlStore, gate: PolicyGate, routes: RouteFollower) -> None:
        self._control = control
        self._gate = gate
        self._routes = routes
        self.given_up: ActiveGrant | None = None

    async def approach(self, kind: TaskKind, is_current: Callable[[], bool], attempts: int) -> FlightMode:
        """Fly home for the system until only the descent is left.

        A drone with the task to land lands at its position, unless it would descend into a zone. A drone whose position is not
        trusted waits in the air, because the autopilot's own return would follow the wrong position. If it waits too long, it lands. Above
        a zone into which it would descend, it waits longer.

        Args:
            kind: Task of the system: land, return, or land at the landing place of the mission.
            is_current: Returns True while the task is current.
            attempts: Number of attempts that failed.

        Returns:
            The mode for the rest of the return. If no legal route is known, that is SMART_RTL if the autopilot recorded its
            path, else RTL. The drone then returns even through a zone, because a drone that stays in the air until its battery
            is empty comes down at an arbitrary place.

        Raises:
            AutopilotError: The autopilot refused, or the link broke.
        """
        control = self._control
        vehicle = control.autopilot.vehicle
        stack = control.autopilot.stack
        self.given_up = None
        if kind is not TaskKind.LAND and attempts < SETTINGS.max_route_attempts:
            await self._restore_home()
        # A landing in progress was chosen by a failsafe or a pilot. The battery may be too low for any other flight.
        landing = vehicle.mode.kind is ModeKind.LANDING
        if kind is TaskKind.LAND and (landing or not self._lands_in_zone()):
            return stack.land
        if not vehicle.mode.comes_down and not await self._trusts_position(is_current):
            if is_current() and vehicle.in_air:
                control.note("land", f"the position is not trusted: {vehicle.position_problem}", "PositionUnknown")
            return stack.land
        if (
            vehicle.in_air
            and not vehicle.mode.comes_down
            and attempts <= SETTINGS.max_route_attempts
            and self._path_is_home()
        ):
            control.note("returnToLaunch", "home was moved; the drone returns on the path it flew", "HomeMoved")
            return stack.return_retracing
        grant = control.last_grant  # Not earlier: the Grant may have changed while the drone waited.
        if grant is None or not vehicle.in_air or vehicle.mode.comes_down or self._blind():
            return await self._return_unplanned(is_current, attempts)
        place = control.landing_place if kind is TaskKind.LAND_AT and attempts < SETTINGS.max_route_attempts else None
        if place is not None and await self._fly_to_landing(grant, is_current, place):
            return stack.land
        return await self._return_home(control.last_grant or grant, is_current, attempts)

    async def _return_home(self, grant: ActiveGrant, is_current: Callable[[], bool], attempts: int) -> FlightMode:
        """Fly home, and return the mode for the rest of the return, as `approach` does."""
        control = self._control
        try:
            if attempts < SETTINGS.max_route_attempts:
                problem = await self._fly_back(grant, is_current)
            elif self._straight_return_legal(control.for_transit(grant)):
                problem = ""
            else:
                problem = f"the autopilot refused {attempts} times"
        except AutopilotError:
            raise
        except Exception:
            log.exception("return: route planner failed")
            problem = "the route planner failed"
        if not problem:
            return self.descent(grant)
        return self._return_without_route(problem, attempts)

    async def _return_unplanned(self, is_current: Callable[[], bool], attempts: int) -> FlightMode:
        """Return the mode of the autopilot's own return, because no route can be planned.

        If the Grant of a mission is missing, zones may be in the way. The drone then hovers, at most
        `failsafe_status_timeout_s`, until it is known if the autopilot records its path.
        """
        control = self._control
        autopilot = control.autopilot
        vehicle = autopilot.vehicle
        if control.state.mission is None or not vehicle.in_air or vehicle.mode.comes_down or self._blind():
            return autopilot.stack.return_straight
        deadline = autopilot.now + SETTINGS.failsafe_status_timeout_s
        while control.failsafe_status is None and is_current() and autopilot.now < deadline:
            if autopilot.vehicle.mode.commanded:
                autopilot.stop()
            await autopilot.update(SETTINGS.brake_resend_s / autopilot.pace)
        return self._return_without_route("the Grant of the flight is missing", attempts)

    def _return_without_route(self, problem: str, attempts: int) -> FlightMode:
        """Record that no legal route home is known, and return the mode of the autopilot's own return."""
        control = self._control
        stack = control.autopilot.stack
        retraces = control.retraces and attempts <= SETTINGS.max_route_attempts
        path = "on the path it flew" if retraces else "straight"
        control.note(
            "returnToLaunch", f"no legal route home is known ({problem}); the drone returns {path}", "NoLegalWay"
        )
        log.error("return: no legal route home is known, the drone returns %s (reason=%s)", path, problem)
        self.given_up = control.last_grant
        return stack.return_retracing if retraces else stack.return_straight

    async def _trusts_position(self, is_current: Callable[[], bool]) -> bool:
        """Wait until the position is trusted; the drone hovers. Return False after a timeout, or if the task or flight has ended."""
        autopilot = self._control.autopilot
        vehicle = autopilot.vehicle
        above_zone = False
        while vehicle.position_problem:
            waited_s = (autopilot.now - vehicle.position_problem_at) * autopilot.pace
            if waited_s >= SETTINGS.position_problem_timeout_s:
                if waited_s >= SETTINGS.position_problem_above_zone_timeout_s or not self._lands_in_zone():
                    break
                if not above_zone:
                    reason = f"a zone lies below, and the position is not trusted: {vehicle.position_problem}"
                    self._control.note("hover", reason, "PositionUnknown")
                above_zone = True
            if not is_current() or not vehicle.in_air:
                break
            if vehicle.mode.commanded:
                autopilot.stop()
            await autopilot.update(SETTINGS.brake_resend_s / autopilot.pace)
        return not vehicle.position_problem

    def _require_trusted_position(self) -> None:
        problem = self._control.autopilot.vehicle.position_problem
        if problem:
            raise Unavailable("PositionUnknown", f"the drone's position is not trusted: {problem}")

    async def _restore_home(self) -> None:
        """Restore home if it was moved, because the autopilot's own return ends at home.

        Raises:
            AutopilotError: Home was not restored. While the autopilot is connected, this counts as a refused attempt, so that
                a station that moves home repeatedly cannot keep the drone in the air.
        """
        control = self._control
        try:
            await control.restore_home()
        except AutopilotError as error:
            raise AutopilotError(str(error), link=not control.autopilot.connected) from error

    def _path_is_home(self) -> bool:
        """Return True if home was moved and the autopilot recorded its path.

        The path then ends where the mission armed.
        """
        return self._control.retraces and self._control.home_moved

    async def _fly_to_landing(
        self, grant: ActiveGrant, is_current: Callable[[], bool], place: tuple[float, float]
    ) -> bool:
        """Fly to a landing place. Return False, and record the reason, if the drone cannot land there.

        Raises:
            AutopilotError: The drone did not follow its commands.
        """
        try:
            problem = await self._fly_back(grant, is_current, place)
        except AutopilotError:
            raise
        except Exception:
            log.exception("return: route planner failed")
            problem = "the route planner failed"
        if not problem and (
            self._blind() or self._control.autopilot.vehicle.distance_m(*place) > 2 * SETTINGS.reached_m
        ):
            problem = "the drone did not arrive"
        if problem:
            lat, lon = place
            reason = f"the drone cannot land at {lat:.6f}, {lon:.6f} and returns home: {problem}"
            self._control.note("returnToLaunch", reason, "NoLegalWay")
        return not problem

    async def _fly_back(
        self, grant: ActiveGrant, is_current: Callable[[], bool], place: tuple[float, float] | None = None
    ) -> str:
        """Fly home, or to a landing place. Return the reason if that is impossible, or an empty string.

        Raises:
            AutopilotError: The drone did not follow its commands.
        """
        control = self._control
        constraints = control.begin_system_flight(grant)

        def permit() -> None:
            if not is_current() or control.constraints is not constraints:
                raise AutopilotError("the system has lost control of the drone")

        flight = SystemFlight(constraints, "Homeward", lambda motion: _both(permit, motion))
        try:
            await control.modes.change_mode(control.autopilot.stack.guided, permit)
            async for _ in self._routes.follow(flight, lambda: self._next_leg(flight, place)):
                pass
        except Refused as refusal:
            if place is None and self._cannot_rest(refusal, flight):
                return ""
            if refusal.verdict.code == "NoLegalWay" or refusal.verdict.code in REPLAN_CODES:
                return str(refusal)
            moved = control.home_moved
            raise AutopilotError(str(refusal), link=isinstance(refusal, Unavailable) and not moved) from refusal
        finally:
            control.end_system_flight(constraints)
        return ""

    async def attempt(self, flight: SystemFlight, motion: Motion) -> AsyncGenerator[Step, None]:
        """Fly home for a driver, as one motion. The drone is in GUIDED.

        Raises:
            Refused: There is no legal route and the autopilot has recorded no path, the position is not trusted, or the motion was
                stopped.
            AutopilotError: The autopilot refused.
        """
        self.given_up = None
        await self._control.restore_home()
        self._require_trusted_position()
        if self._blind():
            return
        try:
            async with aclosing(self._routes.legs(flight, motion, lambda: self._next_leg(flight))) as steps:
                async for step in steps:
                    yield replace(step, complete=False)  # The landing follows.
        except Refused as refusal:
            if refusal.verdict.code == "NoLegalWay" and self._control.retraces:
                self.given_up = flight.constraints.grant
            elif not self._cannot_rest(refusal, flight):
                raise

    def descent(self, grant: ActiveGrant) -> FlightMode:
        """Return the mode for the rest of the return flight.

        If no legal return was found, it is the autopilot's return along the recorded path. Otherwise it is landing if
        the drone is at home, and the autopilot's straight return if it is not.
        """
        autopilot = self._control.autopilot
        stack = autopilot.stack
        if grant is self.given_up:
            return stack.return_retracing
        at_home = autopilot.vehicle.position_fresh(autopilot.now) and self._home_distance_m() <= 2 * SETTINGS.reached_m
        return stack.land if at_home else stack.return_straight

    def _cannot_rest(self, refusal: Refused, flight: SystemFlight) -> bool:
        """Return True if the drone does not come to rest because of wind, and the straight return is legal from its position."""
        return refusal.verdict.code == "NotStopping" and self._straight_return_legal(flight.constraints.compiled)

    def _lands_in_zone(self) -> bool:
        """Return True if the drone is above a zone into which it would descend. Without a Grant, no zones are known.

        While the position is not trusted, the drone counts as being where it is expected.
        """
        grant = self._control.last_grant
        if grant is None:
            return False
        now = self._gate.situation()
        vehicle = self._control.autopilot.vehicle
        if now.lat is None and vehicle.expected_place is not None:
            lat, lon = vehicle.expected_place
            error_m = vehicle.position_error_m + vehicle.expected_error_m
            now = replace(now, lat=lat, lon=lon, position_error_m=error_m, latency_s=0.0)
        return descent_enters_fence(now, self._control.for_transit(grant))

    def _blind(self) -> bool:
        """Return True if position or home is unknown to the service. Only the autopilot can then navigate."""
        now = self._gate.situation()
        return now.lat is None or now.home is None

    def _straight_return_legal(self, grant: CompiledGrant) -> bool:
        """Return True if the autopilot's own straight return is legal from the current position."""
        now = self._gate.situation()
        if now.lat is None or now.lon is None or now.home is None:
            return True
        room = {"margin": now.margin_m, "slack": now.height_margin_m}
        return check_straight_return(grant.frame.xy(now.lat, now.lon), now.altitude_m, now, grant, **room) is None

    def _home_distance_m(self) -> float:
        """Return the horizontal distance to home in metres; infinite if home is unknown."""
        vehicle = self._control.autopilot.vehicle
        return vehicle.distance_m(vehicle.home.lat, vehicle.home.lon) if vehicle.home is not None else math.inf

    async def _next_leg(self, flight: SystemFlight, place: tuple[float, float] | None = None) -> NextLeg | None:
        """Return the next leg home, or None if the drone has settled at home, or if position or home is unknown.

        The last leg ends when the drone has settled, because a drone that lands while it flies past home comes down up to a
        metre away. Within a metre of home, the drone keeps its altitude, and lands where it is if there is no legal leg.

        Args:
            flight: The return flight.
            place: Latitude and longitude of a landing place to fly to instead of home.

        Raises:
            Refused: There is no legal route, the position is not trusted, or the landing place is not legal.
        """
        self._require_trusted_position()
        if self._control.home_moved:
            raise Unavailable(
                "AutopilotUnavailable", "another station moved home; a return is possible when home is restored"
            )
        now = self._gate.situation()
        if now.lat is None or now.lon is None or now.home is None:
            return None
        compiled = flight.constraints.compiled
        goal = (now.home.lat, now.home.lon) if place is None else place
        goal_xy = compiled.frame.xy(*goal)
        distance_m = self._control.autopilot.vehicle.distance_m(*goal)
        settled = has_settled(self._control.autopilot.vehicle, distance_m)
        problem = "" if place is None else landing_problem(goal_xy, now.altitude_m, now, compiled)
        if settled and not problem:
            return None
        near = distance_m <= SETTINGS.reached_m
        heights: tuple[float, ...] = (now.altitude_m,)
        if not near:
            preferring = now
            if flight.return_altitude_m is not None:
                preferring = replace(now, airframe=replace(now.airframe, return_altitude_m=flight.return_altitude_m))
            heights = return_altitudes_m(preferring, compiled, RTL_CONE_SLOPE * distance_m, goal_xy)
        for height in heights:
            if place is not None and landing_problem(goal_xy, height, now, compiled):
                continue
            vertical_first = may_change_altitude(now, compiled, height)
            # Normally the autopilot's straight return must be legal from each waypoint of a route. The system itself
            # flies this route home, so `retraces` disables that condition.
            planned = replace(
                now,
                airframe=replace(now.airframe, retraces=True),
                altitude_m=height if vertical_first else now.altitude_m,
            )
            first = await first_leg(goal, (height,), planned, flight)
            if first is None:
                continue
            leg, last, _ = first
            if vertical_first and abs(height - now.altitude_m) > SETTINGS.return_level_m:
                leg = replace(leg, lat=now.lat, lon=now.lon)
                last = False
            speed_mps = limited_mps(self._control.cruise_mps, leg, now, compiled)
            return NextLeg(
                replace(leg, speed_mps=speed_mps),
                last,
                reached_m=SETTINGS.return_last_leg_m if last else SETTINGS.reached_m,
                settles=last,
            )
        if near and not problem:
            return None
        ends = "home" if place is None else "landing place"
        raise PreconditionFailed("NoLegalWay", problem or f"zones surround the drone or its {ends}")


def _both(permit: Callable[[], None], motion: Motion) -> Callable[[], None]:
    def check() -> None:
        motion.check()
        permit()

    return check
