"""Drone claims: which Application holds which drone, and which Applications may share its flight.

Claims are by uid, so that an Application that is created again under an old name inherits nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from fractus_core.api import Application, Depot, Drone, Grant, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.planning.inventory import Flight
from fractus_core.planning.mission import flight_of, misses, remaining_flight

from fractus_operator.kinds import Key
from fractus_operator.owned_objects import GroupedObjects
from fractus_operator.parsing import CachedObjects, OwnedPlan, Submitted
from fractus_operator.replanning import mission_changed

_LATEST = datetime.max.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Claim:
    """The claim of an Application on a drone.

    Attributes:
        returning: True if the mission is over and the drone is still returning.
    """

    key: Key
    uid: str
    returning: bool = False

    def holder(self, requester: str | None) -> Key:
        """Return the key of the holder, for planning the Application with the uid `requester`.

        The key equals the requester's key only if the requester itself holds the drone and the drone is not returning.
        Otherwise the name in the key has a suffix if it could be confused with the requester's name.
        """
        namespace, name = self.key
        if requester is None:
            return self.key
        if self.returning:
            return namespace, f"{name} (returning)"
        return self.key if self.uid == requester else (namespace, f"{name} (uid {self.uid[:8]})")


@dataclass(frozen=True, slots=True)
class ActiveMission:
    """An Application whose active plan has its own drone, and does not share the flight of another Application.

    Attributes:
        in_flight: True if the drone is in flight.
    """

    application: Application
    plan: DeploymentPlanSpec
    drone: Drone
    in_flight: bool


_UNKNOWN_CLAIM = Claim(("fractus-system", "flight-home"), "")
"""Claim on a drone in the air for which there is neither a Grant nor a plan."""


def claims(plans: Mapping[Key, OwnedPlan], grants: Iterable[Grant]) -> dict[str, Claim]:
    """Return the claims by node name.

    An Application that has both a Grant for a node and a plan that flies it comes before Applications that have only a Grant.
    Among equals, the oldest Grant decides. Without any Grant, the plans decide. An Application that shares another flight claims
    no drone. Its remaining Grants do not count against the Application that flies the drone.

    Args:
        plans: Active plans.
        grants: All Grants.
    """
    planned: dict[str, Claim] = {}
    sharing: set[tuple[str, str]] = set()
    flying: set[tuple[str, str]] = set()
    for key, plan in sorted(plans.items(), key=lambda item: item[0]):
        drone = plan.spec.drone
        if drone is not None and drone.shared_with is not None:
            sharing.add((plan.uid, drone.node))
        elif drone is not None:
            flying.add((plan.uid, drone.node))
            planned.setdefault(drone.node, Claim(key, plan.uid))
    first: dict[str, tuple[bool, datetime, Key, str]] = {}
    for grant in grants:
        owner = grant.spec.application
        node = grant.spec.node
        if (owner.uid, node) in sharing:
            continue
        created = grant.metadata.creation_timestamp or _LATEST
        rank = ((owner.uid, node) not in flying, created, (owner.namespace, owner.name), owner.uid)
        first[node] = min(rank, first.get(node, rank))
    return planned | {node: Claim(key, uid) for node, (_, _, key, uid) in first.items()}


class DroneHolders(Mapping[str, Key]):
    """The holder of each claimed drone, as one Application sees it. The mapping is valid until the next change.

    Args:
        claims: Claims by drone.
        requester: Uid of the Application.
    """

    def __init__(self, claims: Mapping[str, Claim], requester: str | None) -> None:
        self._claims = claims
        self._requester = requester

    def __getitem__(self, node: str) -> Key:
        """Return the holder of a drone.

        Raises:
            KeyError: No Application holds the drone.
        """
        return self._claims[node].holder(self._requester)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the claimed drones."""
        return iter(self._claims)

    def __len__(self) -> int:
        """Return the number of claimed drones."""
        return len(self._claims)


class Fleet:
    """The flight state of all drones and their claims, which last until the drone has returned.

    Each change of a plan, Grant or drone updates only the claim of the drone concerned.

    Args:
        drones: All Drones.
        applications: All Applications.
    """

    def __init__(self, drones: CachedObjects[Drone | None], applications: CachedObjects[Submitted]) -> None:
        self._drones = drones
        self._applications = applications
        self._in_flight: set[str] = set()
        self._plans: GroupedObjects[OwnedPlan] = GroupedObjects()
        self._grants: GroupedObjects[Grant] = GroupedObjects()
        self._claims: dict[str, Claim] = {}
        self._last_claims: dict[str, Claim] = {}
        self._changed: set[str] = set()
        """Drones whose claims must be computed again."""

    def drone_changed(self, name: str, drone: Drone | None) -> None:
        """Handle a change of a drone.

        A drone whose object was deleted in flight counts as in flight until an object of its name reports a landing.
        """
        self._changed.add(name)
        if drone is None:
            return
        if drone.in_air:
            self._in_flight.add(name)
        elif drone.on_ground:
            self._in_flight.discard(name)

    def plan_changed(self, key: Key, old: OwnedPlan | None, new: OwnedPlan | None) -> None:
        """Handle a change of the active plan of an Application."""
        for plan in (old, new):
            if plan is not None and plan.spec.drone is not None:
                node = plan.spec.drone.node
                self._changed.add(node)
                if plan is new:
                    self._plans.put(("", node), key, plan)
                else:
                    self._plans.drop(("", node), key)

    def mission_returns(self, key: Key, plan: OwnedPlan) -> None:
        """Handle a plan whose drone returns. An operator that restarted knows the claim of the drone only from such a plan."""
        drone = plan.spec.drone
        if drone is not None and drone.shared_with is None and drone.node not in self._last_claims:
            self._last_claims[drone.node] = Claim(key, plan.uid)
            self._changed.add(drone.node)

    def grant_changed(self, key: Key, old: Grant | None, new: Grant | None) -> None:
        """Handle a change of a Grant."""
        for grant in (old, new):
            if grant is not None:
                node = grant.spec.node
                self._changed.add(node)
                if grant is new:
                    self._grants.put(("", node), key, grant)
                else:
                    self._grants.drop(("", node), key)

    def is_in_flight(self, node: str) -> bool:
        """Return True if a drone is in flight, or was in flight when its object was deleted and has not landed since."""
        return node in self._in_flight

    def drone_in_flight(self, plan: DeploymentPlanSpec | None) -> str | None:
        """Return the drone of a plan if it is in flight."""
        drone = plan.drone.node if plan is not None and plan.drone is not None else None
        return drone if drone is not None and self.is_in_flight(drone) else None

    def applications_on(self, node: str) -> list[Key]:
        """Return the Applications with an active plan for a drone, including Applications that share its flight."""
        return list(self._plans.members(("", node)))

    def applications_in_flight(self) -> Iterator[Key]:
        """Iterate over the Applications whose drones are in flight."""
        for node in self._in_flight:
            yield from self.applications_on(node)

    def claims(self) -> Mapping[str, Claim]:
        """Return the claims by drone. The mapping is valid until the next change.

        A claim begins with the plan, and ends when the Grants are deleted and the drone has returned.
        """
        while self._changed:
            node = next(iter(self._changed))
            claim = claims(self._plans.members(("", node)), self._grants.of(("", node))).get(node)
            drone = self._drones.get(("", node))
            if claim is None and drone is not None and self.is_in_flight(node):
                claim = replace(self._last_claims.get(node, _UNKNOWN_CLAIM), returning=True)
            if claim is None:
                self._claims.pop(node, None)
            else:
                self._claims[node] = claim
                self._last_claims[node] = claim
            self._changed.discard(node)
        return self._claims

    def active_missions(self) -> Iterator[ActiveMission]:
        """Iterate over the Applications that have their own drone."""
        for node, claim in self.claims().items():
            plan = self._plans.members(("", node)).get(claim.key)
            drone = self._drones.get(("", node))
            submitted = self._applications.get(claim.key)
            if claim.returning or plan is None or plan.uid != claim.uid or drone is None or submitted is None:
                continue
            if plan.spec.drone is None or plan.spec.drone.shared_with is not None or submitted.application is None:
                continue
            yield ActiveMission(submitted.application, plan.spec, drone, drone.in_air)


def offered_flights(
    missions: Iterable[ActiveMission], depots: Mapping[str, Depot], radius_m: float, present: DeploymentPlanSpec | None
) -> dict[str, Flight]:
    """Return the flights of claimed drones by drone, for an Application that may share one of them.

    For a drone in flight, only the part of the flight that it has not flown yet is offered. An Application that already
    shares the flight gets the whole flight. If an Application was changed since its plan, its flight is not offered,
    because its new route is not known yet.

    Args:
        missions: Applications that have a drone.
        depots: Depots by name.
        radius_m: Maximum distance of a drone from its path, in metres.
        present: Active plan of the Application that may share a flight.
    """
    choice = present.drone if present is not None else None
    shared = choice.node if choice is not None and choice.shared_with is not None else None
    flights: dict[str, Flight] = {}
    for host in missions:
        if mission_changed(host.application, host.plan):
            continue
        try:
            flight: Flight | None = flight_of(host.application, depots)
        except InvalidObject:
            continue
        if flight is not None and host.in_flight and host.drone.name != shared:
            position = host.drone.status.position if host.drone.status is not None else None
            flight = remaining_flight(flight, position, radius_m) if position is not None else None
        if flight is not None:
            flights[host.drone.name] = flight
    return flights


def shared_flight_outcome(plan: DeploymentPlanSpec | None, host_plan: DeploymentPlanSpec | None) -> Outcome | None:
    """Return the mission outcome of an Application that shares a flight, or None while the mission continues.

    The mission is complete when the mission of its host is complete.

    Args:
        plan: Plan of the Application.
        host_plan: Latest plan of the Application whose flight it shares.
    """
    if plan is None or plan.drone is None or plan.drone.shared_with is None:
        return None
    if host_plan is None or host_plan.flown is None or host_plan.flown.outcome != "Complete":
        return None
    name = plan.drone.shared_with
    return Outcome(OutcomeKind.COMPLETE, f"{name} has flown {plan.drone.node} past all points of interest")


def shared_flight_lost(
    application: Application,
    plan: DeploymentPlanSpec | None,
    host_plan: DeploymentPlanSpec | None,
    flight: Flight | None,
    radius_m: float,
) -> str | None:
    """Return why an Application can no longer share a flight, as a sentence, or None if it can.

    Args:
        application: Application that shares the flight.
        plan: Plan of the Application.
        host_plan: Latest plan of the Application whose flight it shares.
        flight: Complete flight of the host, or None if it is unknown.
        radius_m: Maximum distance of a drone from its path, in metres.
    """
    if plan is None or plan.drone is None or plan.drone.shared_with is None:
        return None
    name = plan.drone.shared_with
    node = plan.drone.node
    if host_plan is None or host_plan.is_over:
        return f"shared flight ended: {name} no longer flies {node}"
    if host_plan.drone is None or host_plan.drone.shared_with is not None:
        return f"shared flight ended: {name} no longer flies {node}"
    if host_plan.drone.node != node:
        return f"shared flight changed: {name} now flies {host_plan.drone.node}"
    missed = misses(application, flight, radius_m) if flight is not None else None
    if missed is not None:
        return f"shared flight changed: {name} no longer visits pointsOfInterest.points[{missed}]"
    return None
