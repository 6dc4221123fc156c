"""Selection of the drone of an application (thesis Algorithms 6 and 9)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from fractus_core.api.components import Component
from fractus_core.api.geometry import Point
from fractus_core.api.model import timestamp
from fractus_core.api.nodes import Drone
from fractus_core.api.plans import Alternative, DroneChoice, PlannedMission
from fractus_core.geo import ground_point
from fractus_core.planning.candidates import SUITABLE, Check, check_host, check_resources, check_services, readiness
from fractus_core.planning.inventory import DroneFacts
from fractus_core.planning.landing_places import check_landing_places
from fractus_core.planning.legality import MAX_ROUTES, MissionRoute, RouteJudge
from fractus_core.planning.mission import (
    Estimate,
    MissionEstimator,
    altitude_limit_m,
    first_missed,
    home_of,
    remaining_minutes,
    transit_legs,
)
from fractus_core.planning.operation_area import OperationArea, start_of
from fractus_core.planning.plan_builder import PlanBuilder
from fractus_core.planning.spatial_index import Near

_DAY_MIN = 1440.0
_ALTERNATIVES = 10
_TAKEN = frozenset({"Claimed", "Reserved"})
"""Reasons for the rejection of a drone that may be free later."""


@dataclass(frozen=True, slots=True)
class DroneCandidates:
    """Drones in range of the start of an application, sorted by name.

    Attributes:
        idle: Drones whose depot or home is in range.
        flying: Drones of other applications whose flights visit all points of interest.
    """

    idle: tuple[Drone, ...]
    flying: tuple[Drone, ...]


@dataclass(frozen=True, slots=True)
class _Ranked:
    drone: Drone
    score: float
    used: bool
    mission: Estimate | None


def default_score(facts: DroneFacts) -> float:
    """Score a drone by readiness, then by energy.

    The score is 2 for a shared flight, 1 for a drone that is not charging, and 0 otherwise, plus the remaining flight time
    as a share of a day. A shared flight saves a takeoff, a landing and a drone in the air (thesis 8.5).
    """
    ready = 0.0 if facts.charging else 1.0
    if facts.used:
        ready = 2.0
    return ready + min(facts.remaining_min / _DAY_MIN, 0.999)


def find_drones(builder: PlanBuilder, area: OperationArea) -> DroneCandidates:
    """Return the drones in range of the start. Without a driver, include airborne drones that visit all points of interest."""
    leader = builder.spec.driver or next(builder.spec.on("drone"))
    flying = _flying_past(builder, leader) if builder.spec.driver is None else []
    names = set(_parked_in_range(builder, area, leader, flying))
    builder.set_candidates(leader, [*names, *flying], len(builder.located.stands) + len(builder.located.homeless))
    idle = [builder.inventory.drones[name] for name in sorted(names - set(flying)) if name in builder.inventory.drones]
    return DroneCandidates(tuple(idle), tuple(builder.inventory.drones[name] for name in flying))


def choose_drone(builder: PlanBuilder, area: OperationArea, candidates: DroneCandidates) -> DroneChoice:
    """Place all drone components on the best candidate. A suitable drone of the previous plan is kept.

    Raises:
        Infeasible: No candidate is suitable. The reason is DroneBusy if another application or a flight plan has a suitable drone.
    """
    components = list(builder.spec.on("drone"))
    leader = builder.spec.driver or components[0]
    mission = MissionEstimator(builder.spec, area, builder.settings)
    ranked = [
        candidate
        for drones, used in ((candidates.flying, True), (candidates.idle, False))
        for drone in drones
        if (candidate := _rank(builder, mission, drone, components, used=used)) is not None
    ]
    if not ranked:
        busy = any(r.reason in _TAKEN for r in builder.rejections(leader))
        reason = "DroneBusy" if busy else "NoDrone"
        known = len(builder.inventory.drones)
        fallback = f"none of the {known} known drones is near the start" if known else "no Drone exists"
        raise builder.infeasible(leader, reason, f"no drone can fly {leader.name}", fallback)
    ranked.sort(key=lambda r: (not builder.was_selected(r.drone.name, shared=r.used), -r.score, r.drone.name))
    best, route, conflict = _legal_first(builder, area, ranked, leader)
    for component in components:
        builder.place(component, "drone", best.drone.name)
    home = home_of(best.drone, builder.inventory.depots)
    legs = (
        transit_legs(builder.spec, area, home, builder.inventory.depots) if home is not None and not best.used else []
    )
    others = [r for r in ranked if r is not best and not builder.is_rejected(leader, r.drone.name)]
    choice = DroneChoice(
        node=best.drone.name,
        score=round(best.score, 6),
        shared_with="/".join(builder.inventory.flights[best.drone.name].holder) if best.used else None,
        mission=_mission(best.mission, route) if best.mission is not None else None,
        transit=tuple(legs),
        alternatives=tuple(Alternative(node=r.drone.name, score=round(r.score, 6)) for r in others[:_ALTERNATIVES]),
    )
    return route.add_to(choice, conflict) if route is not None else choice


def _legal_first(
    builder: PlanBuilder, area: OperationArea, ranked: Sequence[_Ranked], leader: Component
) -> tuple[_Ranked, MissionRoute | None, str | None]:
    """Select the first drone whose route the policies allow, and reject the drones before it.

    If the policies allow no route, select the first drone, with the conflict. A drone of the previous plan is kept in spite
    of a conflict, unless conflicts are forbidden.

    Returns:
        The drone, its route, and the policy conflict if there is one.

    Raises:
        Infeasible: The policies allow no route, and conflicts are forbidden.
    """
    judge = RouteJudge(builder.application, area, builder.inventory, builder.settings)
    forbids = builder.settings.policy_conflicts == "forbid"
    ranked = _with_legal_landings(builder, area, ranked, leader)
    tried: list[tuple[_Ranked, MissionRoute | None, str | None]] = []
    for candidate in ranked:
        if judge.exhausted:
            break
        kept = builder.was_selected(candidate.drone.name, shared=candidate.used)
        route = judge.route(candidate.drone, candidate.mission)
        available = candidate.mission.available_min if candidate.mission is not None and not kept else None
        conflict = route.conflict(available) if route is not None else None
        tried.append((candidate, route, conflict))
        if conflict is None or (kept and not forbids):
            break
    legal = tried[-1][2] is None
    if not legal and not forbids:
        return tried[0]
    for candidate, _, conflict in tried:
        if conflict is not None:
            builder.reject(leader, candidate.drone.name, Check("PolicyConflict", conflict))
    if legal:
        return tried[-1]
    for candidate in ranked[len(tried) :]:
        message = f"it was not checked because policies do not allow the routes of {len(tried)} other drones"
        builder.reject(leader, candidate.drone.name, Check("NotJudged", message))
    raise builder.infeasible(leader, "PolicyConflict", f"no drone may fly {leader.name}", "")


def _with_legal_landings(
    builder: PlanBuilder, area: OperationArea, ranked: Sequence[_Ranked], leader: Component
) -> list[_Ranked]:
    """Return the drones that could land at every landing place of the application, and reject the others.

    Further drones are not checked when `MAX_ROUTES` were found. A drone of the previous plan is kept, because it may be in
    flight: without a legal landing place, it returns home.

    Raises:
        Infeasible: No drone could land there.
    """
    suitable: list[_Ranked] = []
    for candidate in ranked:
        problem = ""
        if not candidate.used and not builder.was_selected(candidate.drone.name, shared=False):
            problem = check_landing_places(
                builder.application, candidate.drone, area, builder.inventory, builder.settings
            )
        if problem:
            builder.reject(leader, candidate.drone.name, Check("LandingPlaceIllegal", problem))
            continue
        suitable.append(candidate)
        if len(suitable) == MAX_ROUTES:
            break
    if not suitable:
        raise builder.infeasible(leader, "LandingPlaceIllegal", f"no drone may fly {leader.name}", "")
    return suitable


# -- drones in range --


def _parked_in_range(builder: PlanBuilder, area: OperationArea, leader: Component, flying: Sequence[str]) -> list[str]:
    """Return the drones parked in range of the start, and reject the nearest drones out of range."""
    located = builder.located
    settings = builder.settings
    first = leader.control_points[0] if leader.control_points else None
    start = start_of(first, builder.inventory.depots) if first is not None else None
    named = first.point.depot if first is not None and first.point is not None else None
    centre = ground_point(start) if start is not None else area.start
    inside = builder.inventory.depots[named].spec.radius if named is not None else settings.safety_radius_m
    kept = located.kept_in(named) if named is not None else frozenset()
    if start is None or leader.control == "partial":
        limit = max(settings.depot_radius_m, inside)
        reason = "TooFar"
    else:
        limit = inside
        reason = "TooFar" if named is None else "OtherDepot"
        if named is None:
            kept = frozenset().union(*(located.kept_in(name) for name in _depots_around(builder, centre)))
    requirement = f"not in {named}" if reason == "OtherDepot" else f"more than {limit:.0f} m"
    in_range = {name for name, _ in located.stands.within(centre, limit)} | kept
    for name, distance in located.stands.nearest(centre, settings.near_misses, limit, settings.near_miss_m):
        if name not in in_range and name in builder.inventory.drones:
            relation = "is"
            if reason == "OtherDepot":
                relation = f"is kept in {builder.inventory.drones[name].spec.depot or 'no depot'},"
            message = f"it {relation} {distance:.0f} m from the start, {requirement}"
            builder.reject(leader, name, Check(reason, message), far=True)
    for name in sorted(located.homeless - kept - set(flying))[: settings.near_misses]:
        depot = builder.inventory.drones[name].spec.depot
        missing = f"its Depot {depot} does not exist" if depot else "it has no depot"
        message = f"{missing}, and it has no home; set spec.depot to an existing Depot, or set spec.home"
        builder.reject(leader, name, Check("NoHome", message))
    return sorted(in_range)


def _depots_around(builder: PlanBuilder, center: Point) -> Iterable[str]:
    near: list[Near] = builder.located.depots.within(center, builder.located.widest_depot_m)
    return [n for n, m in near if n in builder.inventory.depots and m <= builder.inventory.depots[n].spec.radius]


def _flying_past(builder: PlanBuilder, leader: Component) -> list[str]:
    """Return the drones whose flights for other applications visit all points of interest.

    Store rejections of some other drones.
    """
    poi = builder.spec.points_of_interest
    visiting = []
    listed = 0
    for name, flight in sorted(builder.inventory.flights.items()):
        if poi is None or name not in builder.inventory.drones or flight.holder == builder.application.key:
            continue
        missed = first_missed(poi.points, flight, builder.settings.safety_radius_m, ordered=poi.ordered)
        if missed is None:
            visiting.append(name)
        elif listed < builder.settings.near_misses:
            listed += 1
            holder = "/".join(flight.holder)
            order = " in this order" if poi.ordered else ""
            message = f"it flies for {holder}, which does not visit pointsOfInterest.points[{missed}]{order}"
            builder.reject(leader, name, Check("PathMissesPoint", message), far=True)
    return visiting


# -- requirements on a drone --


def _rank(
    builder: PlanBuilder, estimator: MissionEstimator, drone: Drone, components: list[Component], *, used: bool
) -> _Ranked | None:
    """Return the drone with its score. If the drone fails a requirement, store the rejection and return None."""
    leader = builder.spec.driver or components[0]
    kept = builder.was_selected(drone.name, shared=used)
    home = home_of(drone, builder.inventory.depots)
    mission = estimator.estimate(home, drone) if home is not None and not used else None
    check = _check_permanent(builder, drone, components, mission, kept=kept) and (
        _check_temporary(builder, drone, components, mission, kept=kept, used=used)
    )
    if not check:
        builder.reject(leader, drone.name, check)
        return None
    facts = DroneFacts(
        drone=drone,
        used=used,
        charging=drone.status is not None and drone.status.flight_state == "charging",
        remaining_min=remaining_minutes(drone),
        needed_min=mission.needed_min if mission is not None else 0.0,
        distance_m=mission.approach_m if mission is not None else 0.0,
    )
    score = (builder.settings.score_drone or default_score)(facts)
    return _Ranked(drone, score, used, mission)


def _check_permanent(
    builder: PlanBuilder, drone: Drone, components: list[Component], mission: Estimate | None, *, kept: bool
) -> Check:
    """Check permanent requirements: services, altitude, flight time with a full battery."""
    check = check_services(drone.spec.services, components)
    mobility = drone.spec.services.mobility
    if not check or mission is None:
        return check
    if mobility is None:
        # Components may not request the service: without a driver, the system flies the drone.
        return SUITABLE if kept else Check("ServiceMissing", "it has no mobility service, which every flight requires")
    highest_m = altitude_limit_m(builder.spec, mobility)
    if mission.top_m > highest_m:
        message = f"it climbs to {highest_m:g} m; the path goes up to {mission.top_m:g} m"
        return Check("TooHigh", message)
    full = (1 - builder.settings.battery_reserve) * mobility.max_flight_time
    if not kept and mission.needed_min > full:
        return _too_long(drone, mission, full, "even with a full battery")
    return SUITABLE


def _check_temporary(
    builder: PlanBuilder, drone: Drone, components: list[Component], mission: Estimate | None, *, kept: bool, used: bool
) -> Check:
    """Check temporary requirements: other applications, host, state, battery, free resources.

    A drone of the previous plan (`kept`) is not replaced because of temporary problems or of effects of the mission, such
    as a lost link, a restarted service or a battery that the flight has drained.
    """
    owner = builder.inventory.claimed.get(drone.name)
    if owner is not None and owner != builder.application.key and not used:
        leader = builder.spec.driver or components[0]
        note = builder.range_message(leader, drone.name)
        return Check("Claimed", f"{owner[0]}/{owner[1]} uses it" + (f", and {note}" if note else ""))
    later = builder.settings.begins_later
    host = check_host(builder.inventory.hosts, drone.name, builder.settings, kept=kept or later)
    if kept:
        return host
    if not used:
        host = host and _check_reservations(builder, drone, mission)
    if later:
        return host and check_resources(builder.ledger, drone.name, components)
    energy = SUITABLE
    if mission is not None and mission.needed_min > mission.available_min:
        battery = drone.status.battery if drone.status is not None else None
        share = battery.remaining if battery is not None else 1.0
        energy = _too_long(drone, mission, mission.available_min, f"with its battery at {share:.0%}")
    return host and _check_state(drone) and energy and check_resources(builder.ledger, drone.name, components)


def _check_reservations(builder: PlanBuilder, drone: Drone, mission: Estimate | None) -> Check:
    """Check that no flight plan has reserved the drone for the time of the mission."""
    begin_s = builder.settings.time_s
    if begin_s is None:
        return SUITABLE
    end_s = builder.settings.until_s
    if end_s is None:
        end_s = begin_s + (mission.needed_min if mission is not None else 0.0) * 60
    for reserved in builder.inventory.reservations.get(drone.name, ()):
        if reserved.begin_s <= end_s and reserved.end_s >= begin_s:
            begin = timestamp(datetime.fromtimestamp(reserved.begin_s, UTC))
            end = timestamp(datetime.fromtimestamp(reserved.end_s, UTC))
            return Check("Reserved", f"flight plan {reserved.holder} has reserved it from {begin} to {end}")
    return SUITABLE


def _too_long(drone: Drone, mission: Estimate, available_min: float, when: str) -> Check:
    return Check(
        "FlightTooLong",
        f"it can fly {max(available_min, 0):.1f} min with its reserve kept, {when};"
        f" the mission takes {mission.needed_min:.1f} min for {mission.distance_m:.0f} m",
    )


def _mission(estimate: Estimate, route: MissionRoute | None) -> PlannedMission:
    flown = route if route is not None and route.legs and route.denied is None else estimate
    return PlannedMission(
        distance=round(flown.distance_m, 1),
        duration=round(flown.needed_min, 3),
        available=round(estimate.available_min, 3),
    )


def _check_state(drone: Drone) -> Check:
    ready = readiness(drone.status)
    if ready is None:
        return Check("DroneUnknown", "it has not reported yet")
    if ready.status != "True":
        return Check("DroneNotReady", ready.message or f"it is not Ready ({ready.reason})")
    return SUITABLE
