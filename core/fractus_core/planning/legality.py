"""What the policies say of a mission's way before takeoff: by the engine that judges it in flight."""

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
from fractus_core.policy.altitude import altitude_above_home_m
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
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
from fractus_core.policy.route_search import quick_route
from fractus_core.policy.selectors import application_reference, node_attributes, policy_applies

MAX_LISTED = 50
"""Legs that a plan lists at most."""

TAKEOFF_ALTITUDE_M = 10.0
"""How high a mission is taken to begin where its first place gives no altitude; the mobility service does so."""

MAX_WAYS, MAX_SEARCHES = 10, 20
"""Ways that are judged for one plan, and ways around zones that are looked for: each of these takes up to 80 ms, while the
operator does nothing else."""

MAX_LEFT = 100
"""Waypoints after a denied one that are judged from before it."""

_MAX_DENIED = 5
"""Denied legs after which a way is not judged any further."""


@dataclass(frozen=True, slots=True)
class Way:
    """A mission's way as the policies let it be flown.

    Attributes:
        legs: those not flown as asked for, in order.
        distance_m: over ground, with the ways around zones.
        needed_min: minutes of flight, with these and the limits of speed and altitude. Like the distance it may be too low
            where legs are denied: what comes after some is not judged.
    """

    legs: tuple[LegLegality, ...]
    distance_m: float
    needed_min: float

    @property
    def denied(self) -> LegLegality | None:
        """The first leg that is not flown."""
        return next((leg for leg in self.legs if leg.outcome == "Denied"), None)

    def conflict(self, available_min: float | None) -> str | None:
        """Why it is not flown as planned, as a sentence; None if it is.

        Args:
            available_min: minutes that the drone can fly with its reserve kept; None: they do not matter.
        """
        denied = self.denied
        if denied is not None:
            where = f"the leg to {denied.end.lat:.6f}, {denied.end.lon:.6f}"
            return f"policies do not let {where} be flown: {denied.message}"
        if available_min is None or not self.legs or self.needed_min <= available_min:
            return None
        names = ", ".join(distinct(name for leg in self.legs for name in leg.policies)) or "the drone's limits"
        return (
            f"with what {names} ask for the mission takes {self.needed_min:.1f} min for {self.distance_m:.0f} m; the drone"
            f" can fly {max(available_min, 0):.1f} min with its reserve kept"
        )

    def noted(self, choice: DroneChoice, conflict: str | None) -> DroneChoice:
        """The choice of a drone with what is known of its way."""
        return choice.model_copy(
            update={
                "legality": self.legs[:MAX_LISTED],
                "legality_omitted": max(len(self.legs) - MAX_LISTED, 0) or None,
                "policy_conflict": conflict,
            }
        )


class WayJudge:
    """Judges an application's way for one drone after another; drones that stand together share the answer."""

    def __init__(self, application: Application, area: OperationArea, inventory: Inventory, settings: Settings) -> None:
        self._application = application
        self._area = area
        self._inventory = inventory
        self._settings = settings
        self._known: dict[tuple[object, ...], Way] = {}
        self._searches = MAX_SEARCHES

    @property
    def exhausted(self) -> bool:
        """Whether no further way should be judged."""
        return len(self._known) >= MAX_WAYS or self._searches <= 0

    def way(self, drone: Drone, mission: Estimate | None) -> Way | None:
        """The way that a drone would fly; None where it is not asked for, or the drone is not flown for it.

        Args:
            drone: Whose way.
            mission: What the mission takes of it; None when the application comes along.
        """
        home, leader = home_of(drone, self._inventory.depots), self._application.spec.leader
        mobility, time_s = drone.spec.services.mobility, self._settings.time_s
        if time_s is None or home is None or mobility is None or leader is None or mission is None:
            return None
        owner, attributes = application_reference(self._application), node_attributes(drone)
        held = tuple(
            p.name for p in self._inventory.policies.values() if policy_applies(p.spec, owner, leader.name, attributes)
        )
        base = drone.spec.home.alt if drone.spec.home is not None else None
        key = (home, base, drone.spec.depot, mobility.max_altitude, mobility.max_speed, held)
        if key not in self._known and not held:
            self._known[key] = Way((), mission.distance_m, mission.needed_min)
        elif key not in self._known:
            # What holds when it begins or when it ends may hold when the drone is there.
            during = UncertainTime(time_s + mission.needed_min * 60, time_s)
            cruise_mps = min(self._settings.cruise_speed_mps, mobility.max_speed)
            now = Situation(
                during,
                home.lat,
                home.lon,
                home=Home(home.lat, home.lon, base or 0.0),
                armed=True,
                speed_setpoint_mps=cruise_mps,
                airframe=Airframe(retraces=True),
            )
            granted = flight_grant(self._application, drone, self._inventory, self._area)
            own = compile_grant(granted, home, self._settings.flat_terrain)
            # The system flies wherever the application's drone may be; a driver with partial control stays where it works.
            system = replace(own, operation_area=own.flight_area, operation_area_border=own.flight_area_border)
            stays = replace(own, flight_area=own.operation_area, flight_area_border=own.operation_area_border)
            flight = _Flight(now, system, stays if leader.control == "partial" else own, self._searches)
            flight.fly(list(mission_legs(self._application.spec, self._area, home, self._inventory.depots)))
            self._searches = flight.searches
            self._known[key] = flight.way(self._settings.climb_speed_mps, stay_minutes(self._application.spec))
        return self._known[key]


def with_legality(
    application: Application, plan: DeploymentPlanSpec, inventory: Inventory, settings: Settings
) -> DeploymentPlanSpec:
    """A plan with what the policies of now say of its drone's way; the same object if that is no news.

    Raises:
        InvalidObject: the application names an unknown depot or its geometry is broken.
    """
    choice = plan.drone
    drone = inventory.drones.get(choice.node) if choice is not None and choice.shared_with is None else None
    area = operation_area(application.spec, inventory.depots, settings.safety_radius_m) if drone is not None else None
    home = home_of(drone, inventory.depots) if drone is not None else None
    if choice is None or drone is None or area is None or home is None:
        return plan
    mission = MissionEstimator(application.spec, area, settings).estimate(home, drone)
    way = WayJudge(application, area, inventory, settings).way(drone, mission)
    if way is None:
        return plan
    noted = way.noted(choice, way.conflict(choice.mission.available if choice.mission is not None else None))
    return plan if noted == choice else plan.model_copy(update={"drone": noted})


@dataclass(slots=True)
class _Flight:
    """A mission that is flown leg by leg as the engine permits it."""

    now: Situation
    grant: CompiledGrant
    driver: CompiledGrant
    searches: int
    noted: list[LegLegality] = field(default_factory=list)
    distance_m: float = 0.0
    flown_s: float = 0.0
    climbed_m: float = 0.0

    def fly(self, legs: list[MissionLeg]) -> None:
        """Take off and fly the legs, until too many are denied."""
        self._take_off(legs)
        for index, leg in enumerate(legs):
            # An answer that costs a search need not be found twice: the way is not legal.
            if [n.outcome for n in self.noted].count("Denied") >= _MAX_DENIED:
                return
            if (leg.start.lat, leg.start.lon) != (leg.end.lat, leg.end.lon) or leg.end.alt is not None:
                self._fly(leg, legs[index + 1 :])

    def way(self, climb_speed_mps: float, stay_min: float) -> Way:
        """What was flown, with the landing."""
        climbed_m = self.climbed_m + self.now.altitude_m
        needed_min = (self.flown_s + climbed_m / climb_speed_mps) / 60 + stay_min
        return Way(tuple(self.noted), self.distance_m, needed_min)

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
        asked = GotoArgs(leg.end.lat, leg.end.lon, leg.end.alt, leg.end.altitude_reference)
        verdict = judge(Call("Goto", asked), self.now, self.driver if leg.flown_by == "driver" else self.grant)
        if isinstance(verdict.args, GotoArgs) and _same_place(verdict.args, asked):
            if verdict.action != "allow":
                self._note(leg, "Corrected", verdict)
            self._arrive(verdict.args)
            return
        if leg.free:
            self._arrive(asked)
            return
        around = self._around(asked) if leg.flown_by == "system" else None
        if around is not None:
            before_m = self.distance_m
            for part in around:
                self._arrive(part)
            self._note(leg, "Detour", verdict, f"the system flies around, {self.distance_m - before_m:.0f} m: ")
            return
        given_up = leg.flown_by == "system" and self.searches <= 0
        after = self._stranded(following) if leg.flown_by == "driver" else ""
        self._note(leg, "Denied", verdict, "no more ways around are looked for: " if given_up else "", after)
        self._arrive(asked)

    def _stranded(self, following: list[MissionLeg]) -> str:
        """What a driver should know that passes over a denied waypoint: from before it no other one may be legal."""
        left = list(takewhile(lambda leg: leg.flown_by == "driver", following))[:MAX_LEFT]
        ends = [GotoArgs(leg.end.lat, leg.end.lon, leg.end.alt, leg.end.altitude_reference) for leg in left]
        if not ends or any(judge(Call("Goto", end), self.now, self.driver).permits for end in ends):
            return ""
        count = f"none of the {len(ends)} waypoints after it" if len(ends) > 1 else "the waypoint after it neither"
        return f"; a driver that passes over it reaches {count}: move the path, or use regionBased navigation"

    def _around(self, asked: GotoArgs) -> list[GotoArgs] | None:
        """The legs of a legal way to a place, as they are permitted; None if no short search finds one."""
        grant = self.grant
        begin = grant.locate(self.now)
        present_m = self.now.altitude_m
        wanted = (
            present_m
            if asked.alt is None
            else altitude_above_home_m(asked.alt, asked.reference, self.now.home, grant.flat_terrain)
        )
        goal = grant.frame.xy(asked.lat, asked.lon)
        for height in dict.fromkeys((present_m if wanted is None else wanted, present_m)):
            if begin is None or self.searches <= 0:
                return None
            self.searches -= 1
            way = quick_route(begin, goal, self.now, grant, height, from_m=present_m)
            parts = self._permitted([GotoArgs(*grant.frame.latlon(*place), height) for place in way or ()])
            if parts:
                return parts
        return None

    def _permitted(self, parts: list[GotoArgs]) -> list[GotoArgs]:
        """The parts of a way as the engine permits them, one after the other; empty if it denies one."""
        now, found = self.now, []
        for part in parts:
            verdict = judge(Call("Goto", part), now, self.grant)
            if not isinstance(verdict.args, GotoArgs) or not _same_place(verdict.args, part):
                return []
            found.append(verdict.args)
            height = now.altitude_m if verdict.args.alt is None else verdict.args.alt
            now = replace(now, lat=part.lat, lon=part.lon, altitude_m=height)
        return found

    def _arrive(self, flown: GotoArgs) -> None:
        now, frame = self.now, self.grant.frame
        height = None
        if flown.alt is not None:
            height = altitude_above_home_m(flown.alt, flown.reference, now.home, self.grant.flat_terrain)
        height = now.altitude_m if height is None else height
        distance_m = math.dist(frame.xy(now.lat or 0.0, now.lon or 0.0), frame.xy(flown.lat, flown.lon))
        self.distance_m += distance_m
        self.flown_s += distance_m / (flown.speed_mps or now.speed_setpoint_mps)
        self.climbed_m += abs(height - now.altitude_m)
        self.now = replace(now, lat=flown.lat, lon=flown.lon, altitude_m=height)

    def _note(
        self,
        leg: MissionLeg,
        outcome: Literal["Detour", "Corrected", "Denied"],
        verdict: Verdict,
        how: str = "",
        after: str = "",
    ) -> None:
        self.noted.append(
            LegLegality(
                start=leg.start,
                end=leg.end,
                flown_by=leg.flown_by,
                outcome=outcome,
                reason=verdict.code,
                message=how + verdict.reason + after,
                policies=verdict.policies,
            )
        )


def _same_place(a: GotoArgs, b: GotoArgs) -> bool:
    return (a.lat, a.lon) == (b.lat, b.lon)
