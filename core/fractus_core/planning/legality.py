"""Legality of a mission's route before takeoff, judged by the policy engine that also judges the flight."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Literal

from fractus_core.api.applications import Application
from fractus_core.api.nodes import Drone
from fractus_core.api.plans import DeploymentPlanSpec, DroneChoice, LegLegality
from fractus_core.planning.grant_compiler import flight_grant
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.mission import Estimate, MissionEstimator, MissionLeg, home_of, mission_legs, stay_minutes
from fractus_core.planning.operation_area import OperationArea, operation_area
from fractus_core.policy.compiled_grant import CompiledGrant, altitude_above_home_m, compile_grant
from fractus_core.policy.decision_types import (
    Airframe,
    Call,
    GotoArgs,
    Home,
    Situation,
    TakeoffArgs,
    UncertainTime,
    Verdict,
    distinct,
)
from fractus_core.policy.engine import judge
from fractus_core.policy.route_check import arrived
from fractus_core.policy.route_search import quick_route
from fractus_core.policy.selectors import application_reference, node_attributes, policy_applies

MAX_LISTED = 50
"""Maximum number of legs that a plan lists."""

TAKEOFF_ALTITUDE_M = 10.0
"""Takeoff altitude, in metres above home, if the first position has no altitude. The mobility service uses the same altitude."""

MAX_ROUTES = 10
"""Maximum number of routes that are judged for one plan."""

MAX_SEARCHES = 20
"""Maximum number of searches for detours around zones for one plan. Each search blocks the operator for up to 80 ms."""

MAX_SKIP_TARGETS = 100
"""Maximum number of waypoints that are judged as the next target of a driver that skips a denied waypoint."""

_MAX_DENIED = 5
"""Number of denied legs after which the rest of a route is not judged."""


@dataclass(frozen=True, slots=True)
class MissionRoute:
    """The route of a mission as the policies allow it.

    Attributes:
        legs: Legs that are not flown as requested, in order.
        distance_m: Ground distance including detours.
        needed_min: Flight time in minutes with detours and limits of speed and altitude. If legs are denied, time and distance
            may be too low, because later legs may not have been judged.
    """

    legs: tuple[LegLegality, ...]
    distance_m: float
    needed_min: float

    @property
    def denied(self) -> LegLegality | None:
        """The first denied leg."""
        return next((leg for leg in self.legs if leg.outcome == "Denied"), None)

    def conflict(self, available_min: float | None) -> str | None:
        """Return why the route cannot be flown as planned, or None if it can.

        Args:
            available_min: Available flight time of the drone in minutes, or None to ignore it.
        """
        denied = self.denied
        if denied is not None:
            leg = f"the leg to {denied.end.lat:.6f}, {denied.end.lon:.6f}"
            return f"policies do not allow {leg}: {denied.message}"
        if available_min is None or not self.legs or self.needed_min <= available_min:
            return None
        names = ", ".join(distinct(name for leg in self.legs for name in leg.policies)) or "the drone's limits"
        return (
            f"under {names} the mission takes {self.needed_min:.1f} min for {self.distance_m:.0f} m, but the drone can fly only"
            f" {max(available_min, 0):.1f} min without its battery reserve"
        )

    def add_to(self, choice: DroneChoice, conflict: str | None) -> DroneChoice:
        """Return the choice of a drone with the legality of its route."""
        return choice.model_copy(
            update={
                "legality": self.legs[:MAX_LISTED],
                "legality_omitted": max(len(self.legs) - MAX_LISTED, 0) or None,
                "policy_conflict": conflict,
            }
        )


class RouteJudge:
    """Judges the route of an application for several drones. Drones with the same home and limits share the result."""

    def __init__(
        self,
        application: Application,
        area: OperationArea,
        inventory: Inventory,
        settings: Settings,
        *,
        throughout: bool = False,
    ) -> None:
        self._application = application
        self._area = area
        self._inventory = inventory
        self._settings = settings
        self._throughout = throughout
        self._known: dict[tuple[object, ...], MissionRoute] = {}
        self._searches = MAX_SEARCHES

    @property
    def exhausted(self) -> bool:
        """True if no further route should be judged."""
        return len(self._known) >= MAX_ROUTES or self._searches <= 0

    def route(self, drone: Drone, mission: Estimate | None) -> MissionRoute | None:
        """Return the route that a drone would fly, or None without a start time or if the application shares a flight.

        Args:
            drone: Drone that flies.
            mission: Estimated flight, or None if the application shares the flight of another application.
        """
        home = home_of(drone, self._inventory.depots)
        leader = self._application.spec.leader
        mobility = drone.spec.services.mobility
        time_s = self._settings.time_s
        if time_s is None or home is None or mobility is None or leader is None or mission is None:
            return None
        owner = application_reference(self._application)
        attributes = node_attributes(drone)
        held = tuple(
            p.name for p in self._inventory.policies.values() if policy_applies(p.spec, owner, leader.name, attributes)
        )
        base = drone.spec.home.alt if drone.spec.home is not None else None
        key = (home, base, drone.spec.depot, mobility.max_altitude, mobility.max_speed, held)
        if key not in self._known and not held:
            self._known[key] = MissionRoute((), mission.distance_m, mission.needed_min)
        elif key not in self._known:
            # The time of each leg is unknown, so a policy counts if it applies at any time of the mission.
            end_s = time_s + mission.needed_min * 60
            if self._throughout and self._settings.until_s is not None:
                end_s = max(end_s, self._settings.until_s)
            during = UncertainTime(end_s, time_s)
            airframe = Airframe(retraces=True)
            cruise_mps = min(self._settings.cruise_speed_mps, airframe.highest_command_mps(mobility.max_speed))
            now = Situation(
                during,
                home.lat,
                home.lon,
                home=Home(home.lat, home.lon, base or 0.0),
                armed=True,
                speed_setpoint_mps=cruise_mps,
                airframe=airframe,
            )
            granted = flight_grant(self._application, drone, self._inventory, self._area)
            grant = compile_grant(granted, home, self._settings.flat_terrain)
            # The system may use the whole corridor. A driver with partial control must stay in the operation area.
            system = replace(grant, operation_area=grant.flight_area, operation_area_border=grant.flight_area_border)
            driver = grant
            if leader.control == "partial":
                driver = replace(
                    grant, flight_area=grant.operation_area, flight_area_border=grant.operation_area_border
                )
            flight = _Flight(now, system, driver, self._searches)
            flight.fly(list(mission_legs(self._application.spec, self._area, home, self._inventory.depots)))
            self._searches = flight.searches
            self._known[key] = flight.route(self._settings.climb_speed_mps, stay_minutes(self._application.spec))
        return self._known[key]


def with_legality(
    application: Application,
    plan: DeploymentPlanSpec,
    inventory: Inventory,
    settings: Settings,
    *,
    throughout: bool = False,
) -> DeploymentPlanSpec:
    """Return a plan with the legality of its route under the current policies. Return the same object if nothing changed.

    Args:
        application: The application.
        plan: Its plan.
        inventory: Current inventory.
        settings: Settings of planning. `time_s` is the start of the mission.
        throughout: True to count a policy that applies at any time from `time_s` to `until_s`, because the mission may fly then.

    Raises:
        InvalidObject: The application names an unknown depot, or its geometry is invalid.
    """
    choice = plan.drone
    drone = inventory.drones.get(choice.node) if choice is not None and choice.shared_with is None else None
    area = operation_area(application.spec, inventory.depots, settings.safety_radius_m) if drone is not None else None
    home = home_of(drone, inventory.depots) if drone is not None else None
    if choice is None or drone is None or area is None or home is None:
        return plan
    mission = MissionEstimator(application.spec, area, settings).estimate(home, drone)
    route = RouteJudge(application, area, inventory, settings, throughout=throughout).route(drone, mission)
    if route is None:
        return plan
    recorded = route.add_to(choice, route.conflict(choice.mission.available if choice.mission is not None else None))
    return plan if recorded == choice else plan.model_copy(update={"drone": recorded})


@dataclass(slots=True)
class _Flight:
    """Simulated flight of a mission, leg by leg, as the policy engine permits it.

    Attributes:
        now: State of the drone after the legs so far.
        grant: Grant of the system.
        driver: Grant of the driver.
        searches: Number of detour searches that are left.
        recorded: Legs that are not flown as requested.
    """

    now: Situation
    grant: CompiledGrant
    driver: CompiledGrant
    searches: int
    recorded: list[LegLegality] = field(default_factory=list)
    distance_m: float = 0.0
    flown_s: float = 0.0
    climbed_m: float = 0.0

    def fly(self, legs: list[MissionLeg]) -> None:
        """Simulate the takeoff and the legs until too many are denied."""
        self._take_off(legs)
        for index, leg in enumerate(legs):
            # The route is not legal, so further expensive searches would be useless.
            if [n.outcome for n in self.recorded].count("Denied") >= _MAX_DENIED:
                return
            if (leg.start.lat, leg.start.lon) != (leg.end.lat, leg.end.lon) or leg.end.alt is not None:
                self._fly(leg, legs[index + 1 :])

    def route(self, climb_speed_mps: float, stay_min: float) -> MissionRoute:
        """Return the flown route, including the landing."""
        climbed_m = self.climbed_m + self.now.altitude_m
        needed_min = (self.flown_s + climbed_m / climb_speed_mps) / 60 + stay_min
        return MissionRoute(tuple(self.recorded), self.distance_m, needed_min)

    def _take_off(self, legs: list[MissionLeg]) -> None:
        first = legs[0].end
        height: float | None = TAKEOFF_ALTITUDE_M
        if first.alt is not None:
            height = altitude_above_home_m(first.alt, first.altitude_reference, self.now.home, self.grant.flat_terrain)
        height = TAKEOFF_ALTITUDE_M if height is None else max(height, 0.5)
        verdict = judge(Call("Takeoff", TakeoffArgs(height)), self.now, self.grant)
        if verdict.action != "allow":
            by = legs[0].flown_by
            self._note(
                MissionLeg(legs[0].start, legs[0].start, by), "Corrected" if verdict.permits else "Denied", verdict
            )
        if isinstance(verdict.args, TakeoffArgs):
            height = verdict.args.altitude_m
        self.climbed_m += height
        self.now = replace(self.now, altitude_m=height, in_air=True)

    def _fly(self, leg: MissionLeg, following: list[MissionLeg]) -> None:
        request = GotoArgs(leg.end.lat, leg.end.lon, leg.end.alt, leg.end.altitude_reference)
        verdict = judge(Call("Goto", request), self.now, self.driver if leg.flown_by == "driver" else self.grant)
        if isinstance(verdict.args, GotoArgs) and _same_position(verdict.args, request):
            if verdict.action != "allow":
                self._note(leg, "Corrected", verdict)
            self._arrive(verdict.args)
            return
        if leg.free:
            self._arrive(request)
            return
        detour = self._detour(request) if leg.flown_by == "system" else None
        if detour is not None:
            before_m = self.distance_m
            for part in detour:
                self._arrive(part)
            self._note(leg, "Detour", verdict, f"the system flies a detour of {self.distance_m - before_m:.0f} m: ")
            return
        given_up = leg.flown_by == "system" and self.searches <= 0
        after = self._stranded(following) if leg.flown_by == "driver" else ""
        self._note(leg, "Denied", verdict, "no further detour is searched: " if given_up else "", after)
        self._arrive(request)

    def _stranded(self, following: list[MissionLeg]) -> str:
        """Return a note if a driver that skips a denied waypoint cannot reach any of the following waypoints either."""
        left = list(takewhile(lambda leg: leg.flown_by == "driver", following))[:MAX_SKIP_TARGETS]
        ends = [GotoArgs(leg.end.lat, leg.end.lon, leg.end.alt, leg.end.altitude_reference) for leg in left]
        if not ends or any(judge(Call("Goto", end), self.now, self.driver).permits for end in ends):
            return ""
        targets = f"any of the {len(ends)} waypoints after it" if len(ends) > 1 else "the waypoint after it"
        return f"; a driver that skips it cannot reach {targets}: move the path, or use regionBased navigation"

    def _detour(self, request: GotoArgs) -> list[GotoArgs] | None:
        """Return the permitted legs of a detour to a position, or None if a short search finds none."""
        grant = self.grant
        begin = grant.locate(self.now)
        present_m = self.now.altitude_m
        target_m = (
            present_m
            if request.alt is None
            else altitude_above_home_m(request.alt, request.reference, self.now.home, grant.flat_terrain)
        )
        goal = grant.frame.xy(request.lat, request.lon)
        for height in dict.fromkeys((present_m if target_m is None else target_m, present_m)):
            if begin is None or self.searches <= 0:
                return None
            self.searches -= 1
            route = quick_route(begin, goal, self.now, grant, height, from_m=present_m)
            parts = self._permitted([GotoArgs(*grant.frame.latlon(*point), height) for point in route or ()])
            if parts:
                return parts
        return None

    def _permitted(self, parts: list[GotoArgs]) -> list[GotoArgs]:
        """Return the legs of a route as the engine permits them, or an empty list if the engine denies a leg."""
        now = self.now
        permitted = []
        for part in parts:
            verdict = judge(Call("Goto", part), now, self.grant)
            if not isinstance(verdict.args, GotoArgs) or not _same_position(verdict.args, part):
                return []
            permitted.append(verdict.args)
            height = now.altitude_m if verdict.args.alt is None else verdict.args.alt
            now = replace(now, lat=part.lat, lon=part.lon, altitude_m=height)
        return permitted

    def _arrive(self, flown: GotoArgs) -> None:
        now = self.now
        frame = self.grant.frame
        self.now = arrived(flown, now, self.grant)
        distance_m = math.dist(frame.xy(now.lat or 0.0, now.lon or 0.0), frame.xy(flown.lat, flown.lon))
        self.distance_m += distance_m
        self.flown_s += distance_m / (flown.speed_mps or now.speed_setpoint_mps)
        self.climbed_m += abs(self.now.altitude_m - now.altitude_m)

    def _note(
        self,
        leg: MissionLeg,
        outcome: Literal["Detour", "Corrected", "Denied"],
        verdict: Verdict,
        prefix: str = "",
        suffix: str = "",
    ) -> None:
        self.recorded.append(
            LegLegality(
                start=leg.start,
                end=leg.end,
                flown_by=leg.flown_by,
                outcome=outcome,
                reason=verdict.code,
                message=prefix + verdict.reason + suffix,
                policies=verdict.policies,
            )
        )


def _same_position(a: GotoArgs, b: GotoArgs) -> bool:
    return (a.lat, a.lon) == (b.lat, b.lon)
