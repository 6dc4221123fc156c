"""Which application has which drone: by uid, so that one that is created again under an old name inherits nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from fractus_core.api import Application, Drone, Grant
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.reading import Copies, OwnedPlan, Submitted
from fractus_operator.inventory.grouped import Grouped

_LATEST = datetime.max.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Claim:
    """An application that has a drone.

    Attributes:
        over: its mission is over, and the drone has yet to come home.
    """

    key: Key
    uid: str
    over: bool = False

    def holder(self, asking: str | None) -> Key:
        """The holder as the application with the uid `asking` should see it: its own key is its own claim."""
        namespace, name = self.key
        if asking is None:
            return self.key
        if self.over:
            return namespace, f"{name} (on the way home)"
        return self.key if self.uid == asking else (namespace, f"{name} (uid {self.uid[:8]})")


@dataclass(frozen=True, slots=True)
class Flown:
    """An application that has a drone of its own, by a plan in force.

    Attributes:
        in_flight: whether the drone is on its way already.
    """

    application: Application
    plan: DeploymentPlanSpec
    drone: Drone
    in_flight: bool


def claims(plans: Mapping[Key, OwnedPlan], grants: Iterable[Grant]) -> dict[str, Claim]:
    """Claims by node name.

    An application with a grant on a node and a plan of its own for it has it, before others with only a grant; among
    equals the oldest grant counts. Without any grant, plans do. An application that shares another one's flight claims
    nothing, and what it leaves behind when its plan is gone takes no drone from the one that flies it.

    Args:
        plans: Plans of applications whose mission is not over.
        grants: All grants.
    """
    found: dict[str, Claim] = {}
    sharing: set[tuple[str, str]] = set()
    flyers: set[tuple[str, str]] = set()
    for key, plan in sorted(plans.items(), key=lambda item: item[0]):
        drone = plan.spec.drone
        if drone is not None and drone.shared_with is not None:
            sharing.add((plan.uid, drone.node))
        elif drone is not None:
            flyers.add((plan.uid, drone.node))
            found.setdefault(drone.node, Claim(key, plan.uid))
    first: dict[str, tuple[bool, datetime, Key, str]] = {}
    for grant in grants:
        owner, node = grant.spec.application, grant.spec.node
        if (owner.uid, node) in sharing:
            continue
        created = grant.metadata.creation_timestamp or _LATEST
        rank = ((owner.uid, node) not in flyers, created, (owner.namespace, owner.name), owner.uid)
        first[node] = min(rank, first.get(node, rank))
    return found | {node: Claim(key, uid) for node, (_, _, key, uid) in first.items()}


class HolderNames(Mapping[str, Key]):
    """Who has each drone, as the application with the uid `asking` should see it. Good until the next change."""

    def __init__(self, held: Mapping[str, Claim], asking: str | None) -> None:
        self._held = held
        self._asking = asking

    def __getitem__(self, node: str) -> Key:
        """Who has the drone.

        Raises:
            KeyError: no application has it.
        """
        return self._held[node].holder(self._asking)

    def __iter__(self) -> Iterator[str]:
        """Names of the drones that applications have."""
        return iter(self._held)

    def __len__(self) -> int:
        """How many these are."""
        return len(self._held)


class Fleet:
    """The drones: which fly, and which application has each, also while they come home.

    Kept current one plan, grant and drone at a time: who has a drone depends on the plans and grants for that drone alone.

    Args:
        drones: All Drones.
        applications: All Applications.
    """

    def __init__(self, drones: Copies[Drone | None], applications: Copies[Submitted]) -> None:
        self._drones = drones
        self._applications = applications
        self._in_flight: set[str] = set()
        self._plans: Grouped[OwnedPlan] = Grouped()
        self._grants: Grouped[Grant] = Grouped()
        self._claims: dict[str, Claim] = {}
        self._last_claims: dict[str, Claim] = {}
        self._changed: set[str] = set()
        """Drones whose claims have to be looked at again."""

    def drone_changed(self, name: str, drone: Drone | None) -> None:
        """Follow a drone's flight state; one whose object went while it flew still does, for all that is known."""
        self._changed.add(name)
        if drone is not None:
            (self._in_flight.add if drone.in_air else self._in_flight.discard)(name)

    def plan_changed(self, key: Key, old: OwnedPlan | None, new: OwnedPlan | None) -> None:
        """Follow the plan in force of an application."""
        for plan in (old, new):
            if plan is not None and plan.spec.drone is not None:
                node = plan.spec.drone.node
                self._changed.add(node)
                if plan is new:
                    self._plans.put(("", node), key, plan)
                else:
                    self._plans.drop(("", node), key)

    def grant_changed(self, key: Key, old: Grant | None, new: Grant | None) -> None:
        """Follow a grant."""
        for grant in (old, new):
            if grant is not None:
                node = grant.spec.node
                self._changed.add(node)
                if grant is new:
                    self._grants.put(("", node), key, grant)
                else:
                    self._grants.drop(("", node), key)

    def is_in_flight(self, node: str) -> bool:
        """Whether a drone flies; one whose object went while it flew still does, for all that is known."""
        drone = self._drones.get(("", node))
        return drone.in_air if drone is not None else node in self._in_flight

    def in_flight(self, plan: DeploymentPlanSpec | None) -> str | None:
        """The drone of a plan, while it flies."""
        drone = plan.drone.node if plan is not None and plan.drone is not None else None
        return drone if drone is not None and self.is_in_flight(drone) else None

    def on(self, node: str) -> list[Key]:
        """The applications with a plan in force for a drone, also those that share its flight."""
        return list(self._plans.members(("", node)))

    def flying(self) -> Iterator[Key]:
        """The applications whose drones fly."""
        for node in self._in_flight:
            yield from self.on(node)

    def claims(self) -> Mapping[str, Claim]:
        """Which application has which drone: from the plan on, until its grants are gone and the drone has come home.

        Good until the next change.
        """
        while self._changed:
            node = next(iter(self._changed))
            claim = self._claim(node)
            if claim is None:
                self._claims.pop(node, None)
            else:
                self._claims[node] = self._last_claims[node] = claim
            self._changed.discard(node)
        return self._claims

    def flown(self) -> Iterator[Flown]:
        """The applications that have a drone of their own, each by a plan in force."""
        for node, claim in self.claims().items():
            plan, drone = self._plans.members(("", node)).get(claim.key), self._drones.get(("", node))
            submitted = self._applications.get(claim.key)
            if claim.over or plan is None or plan.uid != claim.uid or drone is None or submitted is None:
                continue
            if (
                plan.spec.drone is not None
                and plan.spec.drone.shared_with is None
                and submitted.application is not None
            ):
                yield Flown(submitted.application, plan.spec, drone, drone.in_air)

    def _claim(self, node: str) -> Claim | None:
        found = claims(self._plans.members(("", node)), self._grants.of(("", node))).get(node)
        drone = self._drones.get(("", node))
        if found is not None or drone is None or not drone.in_air:
            return found
        return replace(self._last_claims.get(node) or self._claim_on_record(node), over=True)

    def _claim_on_record(self, drone: str) -> Claim:
        """The application that flew the drone last, from the applications' statuses: an operator that restarted has no other."""
        for key, submitted in sorted(self._applications.items()):
            if (submitted.body.get("status") or {}).get("drone") == drone:
                return Claim(key, submitted.uid)
        return Claim(("fractus-system", "flight-home"), "")
