"""Which application has which drone: by uid, so that one that is created again under an old name inherits nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from fractus_core.api import Application, Drone, Grant
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.reading import Copies, OwnedPlan, Submitted

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


class Fleet:
    """The drones: which fly, and which application has each, also while they come home.

    Args:
        drones: All Drones.
        applications: All Applications.
    """

    def __init__(self, drones: Copies[Drone | None], applications: Copies[Submitted]) -> None:
        self._drones = drones
        self._applications = applications
        self._last_claims: dict[str, Claim] = {}
        self._in_flight: set[str] = set()

    def changed(self, drone: Drone) -> None:
        """Follow a drone's flight state."""
        (self._in_flight.add if drone.in_air else self._in_flight.discard)(drone.name)

    def is_in_flight(self, node: str) -> bool:
        """Whether a drone flies; one whose object went while it flew still does, for all that is known."""
        drone = self._drones.get(("", node))
        return drone.in_air if drone is not None else node in self._in_flight

    def in_flight(self, plan: DeploymentPlanSpec | None) -> str | None:
        """The drone of a plan, while it flies."""
        drone = plan.drone.node if plan is not None and plan.drone is not None else None
        return drone if drone is not None and self.is_in_flight(drone) else None

    def claims(self, plans: Mapping[Key, OwnedPlan], grants: Iterable[Grant]) -> dict[str, Claim]:
        """Which application has which drone: from the plan on, until its grants are gone and the drone has come home."""
        found = claims(plans, grants)
        for drone in self._drones.values():
            if drone is not None and drone.name not in found and drone.in_air:
                last = self._last_claims.get(drone.name) or self._claim_on_record(drone.name)
                found[drone.name] = replace(last, over=True)
        self._last_claims.update(found)
        return found

    def flown(self, plans: Mapping[Key, OwnedPlan], held: Mapping[str, Claim]) -> Iterator[Flown]:
        """The applications that have a drone of their own, each by a plan in force."""
        owners = {(claim.uid, node) for node, claim in held.items() if not claim.over}
        for key, plan in plans.items():
            submitted, choice = self._applications.get(key), plan.spec.drone
            if choice is None or choice.shared_with is not None or (plan.uid, choice.node) not in owners:
                continue
            drone = self._drones.get(("", choice.node))
            if drone is not None and submitted is not None and submitted.application is not None:
                yield Flown(submitted.application, plan.spec, drone, drone.in_air)

    def _claim_on_record(self, drone: str) -> Claim:
        """The application that flew the drone last, from the applications' statuses: an operator that restarted has no other."""
        for key, submitted in sorted(self._applications.items()):
            if (submitted.body.get("status") or {}).get("drone") == drone:
                return Claim(key, submitted.uid)
        return Claim(("fractus-system", "flight-home"), "")
