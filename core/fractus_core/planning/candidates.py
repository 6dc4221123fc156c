"""Requirements of components on nodes: host state, services, resources, direct links (thesis Algorithms 6 to 8)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from fractus_core.api.components import Component
from fractus_core.api.model import Condition, quantity
from fractus_core.api.nodes import DroneStatus, EdgeNodeStatus, Interface, NodeServices, direct_interface
from fractus_core.api.plans import Rejection
from fractus_core.planning.inventory import Host, Settings

INSUFFICIENT = "InsufficientResources"
"""Reason for the rejection of a node that would be suitable with more free resources."""


class Ledger:
    """Free resources of hosts during planning: allocatable minus requested minus placed by the plan.

    The resources of a component on its node in the previous plan stay reserved until the component is placed again.
    Otherwise, a component that comes earlier in the manifest could displace a running one.
    """

    def __init__(self, hosts: Mapping[str, Host], kept: Iterable[tuple[Component, str]] = ()) -> None:
        self._hosts = hosts
        self._placed: dict[str, dict[str, Mapping[str, float]]] = {}
        self._kept: dict[str, dict[str, Mapping[str, float]]] = {}
        for component, node in kept:
            self._kept.setdefault(node, {})[component.name] = requests(component)

    def shortage(self, node: str, requested: Mapping[str, float], requesters: Collection[str]) -> str | None:
        """Return the first insufficient resource with its amounts, or None if all are available.

        Args:
            node: Name of the host.
            requested: Total requests by resource name.
            requesters: Names of the requesting components, whose own reservations are available to them.
        """
        host = self._hosts[node]
        placed = self._placed.get(node, {})
        kept = [
            amounts
            for name, amounts in self._kept.get(node, {}).items()
            if name not in requesters and name not in placed
        ]
        for resource, amount in requested.items():
            free = host.allocatable.get(resource, 0.0) - host.requested.get(resource, 0.0)
            free -= sum(amounts.get(resource, 0.0) for amounts in (*placed.values(), *kept))
            if amount > free + 1e-9:
                return f"{resource}: {amount:g} requested, {max(free, 0.0):g} free"
        return None

    def take(self, node: str, component: Component) -> None:
        """Book the resource requests of a component on a node."""
        self._placed.setdefault(node, {})[component.name] = requests(component)

    def release(self, node: str, component: Component) -> None:
        """Cancel the booking of a component. Its reservation from the previous plan applies again."""
        self._placed[node].pop(component.name)


def requests(component: Component) -> dict[str, float]:
    """Return the resource requests of a component's pod. Missing requests default to the limits, as in Kubernetes."""
    resources = component.container.resources
    return {name: quantity(q) for name, q in {**resources.limits, **resources.requests}.items()}


@dataclass(frozen=True, slots=True)
class Check:
    """Result of checking a node: suitable, or the first failed requirement.

    The message calls the node "it", because it is printed after the name of the node.
    """

    reason: str = ""
    message: str = ""

    def __bool__(self) -> bool:
        """True if the node is suitable."""
        return not self.reason

    def rejection(self, component: Component | str, node: str) -> Rejection:
        """Return the failed check as an entry for the plan's list of rejected nodes."""
        name = component if isinstance(component, str) else component.name
        return Rejection(component=name, node=node, reason=self.reason, message=self.message)


SUITABLE = Check()


def check_host(hosts: Mapping[str, Host], node: str, settings: Settings, *, kept: bool = False) -> Check:
    """Check that the Kubernetes Node of a drone or edge node accepts pods.

    A node that already hosts the instance (`kept`) may be unreachable: its pods keep running.
    """
    host = hosts.get(node)
    if host is None:
        return Check("NodeMissing", "no Kubernetes Node has its name")
    if node in settings.excluded:
        return Check("Excluded", settings.excluded[node])
    if not host.ready and not kept:
        return Check("NodeNotReady", "its Kubernetes Node is not Ready")
    if not host.schedulable:
        return Check("NodeUnschedulable", "its Kubernetes Node is cordoned")
    return SUITABLE


def readiness(status: DroneStatus | EdgeNodeStatus | None) -> Condition | None:
    """Return the Ready condition that the agent of a node reported, or None."""
    return next((c for c in status.conditions if c.type == "Ready"), None) if status is not None else None


def check_services(offered: NodeServices, components: Iterable[Component]) -> Check:
    """Check that a node offers all services and methods that the components request."""
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
    """Check that all components together fit into the free resources of a node."""
    requested: dict[str, float] = {}
    names: list[str] = []
    for component in components:
        names.append(component.name)
        for resource, amount in requests(component).items():
            requested[resource] = requested.get(resource, 0.0) + amount
        shortage = ledger.shortage(node, requested, names)
        if shortage is not None:
            fit = "does not fit" if len(names) == 1 else "do not fit together"
            return Check(INSUFFICIENT, f"{', '.join(names)} {fit} ({shortage})")
    return SUITABLE


def direct_reach_m(interfaces: Iterable[Interface], peer_interfaces: Iterable[Interface]) -> float | None:
    """Return the maximum distance of a direct link between two nodes in metres, or None if no interfaces match.

    The interfaces for direct links must have the same technology and pairing mode. The smaller range applies.
    """
    a = direct_interface(interfaces)
    b = direct_interface(peer_interfaces)
    if a is None or b is None or a.technology != b.technology:
        return None
    if a.range is None or b.range is None or a.pairing is None or b.pairing is None or a.pairing.mode != b.pairing.mode:
        return None
    return min(a.range, b.range)


def direct_range_m(interfaces: Iterable[Interface]) -> float | None:
    """Return the range of the interface for direct links in metres, or None if the node has none."""
    interface = direct_interface(interfaces)
    return interface.range if interface is not None else None
