"""Which nodes can host a component, and why the others cannot (thesis Algorithms 6 to 8)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from fractus_core.api.components import Component
from fractus_core.api.model import Condition, quantity
from fractus_core.api.nodes import DroneStatus, EdgeNodeStatus, Interface, NodeServices, direct_interface
from fractus_core.api.plans import Rejection
from fractus_core.planning.inventory import Host, Settings

INSUFFICIENT = "InsufficientResources"
"""Why a node is rejected that would do, once others leave enough room on it."""


class Ledger:
    """What hosts have left while a plan is made: allocatable minus requested minus what the plan already placed.

    What a component had on a node in the plan before is kept for it until it is placed again, so that nothing that comes
    first in the manifest drives out what runs there.
    """

    def __init__(self, hosts: Mapping[str, Host], kept: Iterable[tuple[Component, str]] = ()) -> None:
        self._hosts = hosts
        self._placed: dict[str, dict[str, Mapping[str, float]]] = {}
        self._kept: dict[str, dict[str, Mapping[str, float]]] = {}
        for component, node in kept:
            self._kept.setdefault(node, {})[component.name] = requests(component)

    def shortage(self, node: str, wanted: Mapping[str, float], asking: Collection[str]) -> str | None:
        """The first resource of which there is too little, with figures; None when all of it is there.

        Args:
            node: Name of the host.
            wanted: What is asked for in all, resource name to quantity.
            asking: Names of the components that ask: what is kept for them is theirs.
        """
        host = self._hosts[node]
        placed = self._placed.get(node, {})
        kept = [
            amounts for name, amounts in self._kept.get(node, {}).items() if name not in asking and name not in placed
        ]
        for resource, amount in wanted.items():
            free = host.allocatable.get(resource, 0.0) - host.requested.get(resource, 0.0)
            free -= sum(amounts.get(resource, 0.0) for amounts in (*placed.values(), *kept))
            if amount > free + 1e-9:
                return f"{resource}: {amount:g} asked, {max(free, 0.0):g} free"
        return None

    def take(self, node: str, component: Component) -> None:
        """Book the component's requests on the node."""
        self._placed.setdefault(node, {})[component.name] = requests(component)

    def release(self, node: str, component: Component) -> None:
        """Undo the booking of a component; what was kept for it is kept again."""
        self._placed[node].pop(component.name)


def requests(component: Component) -> dict[str, float]:
    """What a pod of the component asks for: requests, with limits where requests say nothing, as Kubernetes does."""
    resources = component.container.resources
    return {name: quantity(q) for name, q in {**resources.limits, **resources.requests}.items()}


@dataclass(frozen=True, slots=True)
class Check:
    """The outcome of looking at one node: suitable, or the first rule it fails."""

    reason: str = ""
    message: str = ""

    def __bool__(self) -> bool:
        """Whether the node is suitable."""
        return not self.reason

    def rejection(self, component: Component | str, node: str) -> Rejection:
        """The failed check as the plan reports it."""
        name = component if isinstance(component, str) else component.name
        return Rejection(component=name, node=node, reason=self.reason, message=self.message)


SUITABLE = Check()


def check_host(hosts: Mapping[str, Host], node: str, settings: Settings, *, kept: bool = False) -> Check:
    """Whether the Kubernetes Node behind a drone or edge node takes pods.

    A node that already hosts the instance (kept) may be out of reach: its pods run on, and it comes back.
    """
    host = hosts.get(node)
    if host is None:
        return Check("NodeMissing", f"no Kubernetes Node is called {node}")
    if node in settings.excluded:
        return Check("Excluded", settings.excluded[node])
    if not host.ready and not kept:
        return Check("NodeNotReady", f"the Kubernetes Node {node} is not Ready")
    if not host.schedulable:
        return Check("NodeUnschedulable", f"the Kubernetes Node {node} is cordoned")
    return SUITABLE


def readiness(status: DroneStatus | EdgeNodeStatus | None) -> Condition | None:
    """The Ready condition that a node's agent reports; None while it has reported none."""
    return next((c for c in status.conditions if c.type == "Ready"), None) if status is not None else None


def check_services(offered: NodeServices, components: Iterable[Component]) -> Check:
    """Whether a node offers every service and method that the components ask for."""
    for component in components:
        for request in component.services:
            service = getattr(offered, request.service)
            if service is None:
                return Check("ServiceMissing", f"it has no {request.service} service, which {component.name} needs")
            missing = sorted(set(request.methods) - set(service.methods) - {"GetControl", "ReturnControl"})
            if missing:
                return Check(
                    "MethodMissing",
                    f"its {request.service} service has no {', '.join(missing)}, which {component.name} needs",
                )
    return SUITABLE


def check_resources(ledger: Ledger, node: str, components: Iterable[Component]) -> Check:
    """Whether the components fit, all of them together, into what the node has left."""
    wanted: dict[str, float] = {}
    asking: list[str] = []
    for component in components:
        asking.append(component.name)
        for resource, amount in requests(component).items():
            wanted[resource] = wanted.get(resource, 0.0) + amount
        shortage = ledger.shortage(node, wanted, asking)
        if shortage is not None:
            fit = "does not fit" if len(asking) == 1 else "do not fit together"
            return Check(INSUFFICIENT, f"{', '.join(asking)} {fit} ({shortage})")
    return SUITABLE


def direct_reach_m(ours: Iterable[Interface], theirs: Iterable[Interface]) -> float | None:
    """How far two nodes can be apart and still talk directly, in metres; None when no interfaces match.

    The interfaces that their agents make links over match in technology and pairing mode; the lesser range counts.
    """
    a, b = direct_interface(ours), direct_interface(theirs)
    if a is None or b is None or a.technology != b.technology:
        return None
    if a.range is None or b.range is None or a.pairing is None or b.pairing is None or a.pairing.mode != b.pairing.mode:
        return None
    return min(a.range, b.range)


def direct_range_m(interfaces: Iterable[Interface]) -> float | None:
    """The range of the interface that a node makes direct links over; None when it has none: no direct link is longer."""
    found = direct_interface(interfaces)
    return found.range if found is not None else None
