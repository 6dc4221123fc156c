"""Which application has which drone: by uid, so that one made anew under an old name inherits nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from fractus_core.api import Application, Drone, Grant
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator.cluster.kinds import Key

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
class OwnedPlan:
    """A plan and the uid of the Application it is for."""

    uid: str
    spec: DeploymentPlanSpec


def claims(plans: Mapping[Key, OwnedPlan], grants: Iterable[Grant]) -> dict[str, Claim]:
    """Claims by node name.

    Who has a grant on a node and a plan of its own for it has it, before others who have only a grant; among equals the
    oldest grant counts. Without any grant, plans do. An application that comes along with another one claims nothing, and
    what it leaves behind when its plan is gone takes no drone from who flies it.

    Args:
        plans: Plans of applications whose mission is not over.
        grants: All grants.
    """
    found: dict[str, Claim] = {}
    guests: set[tuple[str, str]] = set()
    flyers: set[tuple[str, str]] = set()
    for key, plan in sorted(plans.items(), key=lambda item: item[0]):
        drone = plan.spec.drone
        if drone is not None and drone.shared_with is not None:
            guests.add((plan.uid, drone.node))
        elif drone is not None:
            flyers.add((plan.uid, drone.node))
            found.setdefault(drone.node, Claim(key, plan.uid))
    first: dict[str, tuple[bool, datetime, Key, str]] = {}
    for grant in grants:
        owner, node = grant.spec.application, grant.spec.node
        if (owner.uid, node) in guests:
            continue
        created = grant.metadata.creation_timestamp or _LATEST
        rank = ((owner.uid, node) not in flyers, created, (owner.namespace, owner.name), owner.uid)
        first[node] = min(rank, first.get(node, rank))
    return found | {node: Claim(key, uid) for node, (_, _, key, uid) in first.items()}


@dataclass(frozen=True, slots=True)
class Flown:
    """An application that has a drone of its own, by a plan that stands.

    Attributes:
        aloft: whether the drone is on its way already.
    """

    application: Application
    plan: DeploymentPlanSpec
    drone: Drone
    aloft: bool


def host_key(shared_with: str) -> Key:
    """The key of the application that a plan names as the host."""
    namespace, _, name = shared_with.partition("/")
    return namespace, name
