"""State of a planning run: inputs, reserved resources, placements and rejected nodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fractus_core.api.applications import Application
from fractus_core.api.components import Component
from fractus_core.api.names import object_name
from fractus_core.api.nodes import EdgeNode
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance, Rejection, Role, Serves
from fractus_core.planning.candidates import (
    INSUFFICIENT,
    SUITABLE,
    Check,
    Ledger,
    check_host,
    check_resources,
    check_services,
    readiness,
)
from fractus_core.planning.inventory import Inventory, Settings

_MAX_INSTANCE_NAME = 57
"""Maximum length of instance names. A suffix such as -tls of a Secret still fits into a DNS label of 63 characters."""


class Infeasible(Exception):
    """No plan exists for the application.

    Attributes:
        component: Component without a suitable node.
        reason: Machine-readable CamelCase reason.
        rejected: Rejected nodes with the failed requirements.
        omitted: Number of out-of-range nodes that are not listed in `rejected`.
        full: Nodes that would be suitable with more free resources.
    """

    def __init__(
        self, component: str, reason: str, message: str, rejected: Iterable[Rejection] = (), omitted: int = 0
    ) -> None:
        self.component = component
        self.reason = reason
        self.message = message
        self.rejected = tuple(rejected)
        self.omitted = omitted
        self.full = frozenset(rejection.node for rejection in self.rejected if rejection.reason == INSUFFICIENT)
        super().__init__(message)


def instance_name(application: str, component: Component, node: str | None = None) -> str:
    """Return the name of an instance: a DNS label, unique in the namespace, with room for a suffix."""
    return object_name(application, component.slug, node, limit=_MAX_INSTANCE_NAME)


class PlanBuilder:
    """Builds a plan step by step: checks nodes, and stores placements, bookings and rejections."""

    def __init__(
        self,
        application: Application,
        inventory: Inventory,
        settings: Settings,
        previous: DeploymentPlanSpec | None,
        *,
        reserving: bool = True,
    ) -> None:
        self.application = application
        self.spec = application.spec
        self.inventory = inventory
        self.settings = settings
        self.located = inventory.located()
        self.placements: list[PlannedInstance] = []
        self.ledger = Ledger(inventory.hosts, _previously_placed(application, previous) if reserving else ())
        self.previous_drone = previous.drone.node if previous is not None and previous.drone is not None else None
        self.previous_shared = previous is not None and _is_shared(previous)
        self.previous_placements = previous.placements if previous is not None else ()
        self._previously_used = {(p.component, p.node) for p in self.previous_placements}
        self._placed: set[tuple[str, str | None]] = set()
        self._rejected: dict[tuple[str, str], Rejection] = {}
        self._far: dict[tuple[str, str], Rejection] = {}
        self._candidates: dict[str, tuple[set[str], int]] = {}

    def was_placed(self, component: Component, node: str) -> bool:
        """Return True if the previous plan has the component on the node."""
        return (component.name, node) in self._previously_used

    def is_placed(self, component: Component, node: str) -> bool:
        """Return True if this plan has the component on the node."""
        return (component.name, node) in self._placed

    def was_selected(self, drone: str, *, shared: bool) -> bool:
        """Return True if the previous plan has the drone, with the same kind of flight (own or shared)."""
        return drone == self.previous_drone and shared == self.previous_shared

    # -- checks --

    def check_edge(self, node: EdgeNode, component: Component) -> Check:
        """Check if an edge node can host the component. The result contains the first failed requirement, if any."""
        kept = self.was_placed(component, node.name) or self.settings.begins_later
        return (
            check_host(self.inventory.hosts, node.name, self.settings, kept=kept)
            and (SUITABLE if kept else _check_state(node))
            and check_services(node.spec.services, [component])
            and check_resources(self.ledger, node.name, [component])
        )

    def reject(self, component: Component, node: str, check: Check, *, far: bool = False) -> None:
        """Store why a node cannot host a component. `far` means that the node is out of range."""
        rejections = self._far if far else self._rejected
        rejections.setdefault((component.name, node), check.rejection(component, node))

    def set_candidates(self, component: Component, names: Iterable[str], known: int) -> None:
        """Store the nodes in range for a component, and the number of known nodes. The remaining nodes are out of range."""
        self._candidates[component.name] = (set(names), known)

    def is_rejected(self, component: Component, node: str) -> bool:
        """Return True if a node in range is rejected for a component."""
        return (component.name, node) in self._rejected

    def range_message(self, component: Component, node: str) -> str:
        """Return why a node is out of range for a component, or an empty string."""
        rejection = self._far.get((component.name, node))
        return rejection.message if rejection is not None else ""

    def rejections(self, component: Component) -> list[Rejection]:
        """Return the rejected nodes of a component: nodes in range first, then nodes out of range, each sorted by name."""
        near = sorted((r for r in self._rejected.values() if r.component == component.name), key=lambda r: r.node)
        nodes = {r.node for r in near}
        far = (r for r in self._far.values() if r.component == component.name and r.node not in nodes)
        return near + sorted(far, key=lambda r: r.node)

    def infeasible(self, component: Component, reason: str, problem: str, fallback: str) -> Infeasible:
        """Return the error for a component without a host.

        Args:
            component: Component that cannot be placed.
            reason: Machine-readable CamelCase reason.
            problem: First part of the message.
            fallback: Explanation if no node was rejected.
        """
        rejected = self.rejections(component)
        explanation = "; ".join(f"{r.node}: {r.message}" for r in rejected[:5]) or fallback
        more = f"; and {len(rejected) - 5} more" if len(rejected) > 5 else ""
        omitted = self._unlisted(component.name, {r.node for r in rejected})
        return Infeasible(component.name, reason, f"{problem}: {explanation}{more}", rejected, omitted)

    # -- placement --

    def place(
        self,
        component: Component,
        role: Role,
        node: str | None,
        *,
        replicas: int = 1,
        serves: Serves | None = None,
        coverage: float | None = None,
        location: int | None = None,
    ) -> None:
        """Place an instance of a component on a node (None: any cloud node), and book its resource requests."""
        if node is not None:
            self.ledger.take(node, component)
        self._placed.add((component.name, node))
        self.placements.append(
            PlannedInstance(
                component=component.name,
                instance=instance_name(self.application.name, component, node if role != "drone" else None),
                node=node,
                placement=component.placement,
                role=role,
                replicas=replicas,
                serves=serves,
                coverage=coverage,
                location=location,
            )
        )

    def listed_rejections(self) -> tuple[tuple[Rejection, ...], int]:
        """Return the rejections for the plan, and the number of rejected nodes that are omitted.

        The list is sorted by component and node. A node that finally hosts the component is not listed. If the list is too
        long, nodes out of range are omitted first.
        """
        rejections = {**self._rejected}
        for key, rejection in self._far.items():
            rejections.setdefault(key, rejection)
        listable = [r for key, r in rejections.items() if key not in self._placed]
        listed = listable[: self.settings.rejections_listed]
        order = {c.name: i for i, c in enumerate(self.spec.components)}
        listed.sort(key=lambda r: (order[r.component], r.node))
        mentioned: dict[str, set[str]] = {}
        for name, node in (*rejections, *self._placed):
            if node is not None:
                mentioned.setdefault(name, set()).add(node)
        far = sum(self._unlisted(name, mentioned.get(name, set())) for name in self._candidates)
        return tuple(listed), len(listable) - len(listed) + far

    def _unlisted(self, component: str, mentioned: set[str]) -> int:
        """Return the number of nodes that are out of range for a component and not listed in the plan."""
        candidates, known = self._candidates.get(component, (set(), 0))
        return max(known - len(candidates | mentioned), 0)


def _check_state(node: EdgeNode) -> Check:
    """Check that an edge node is Ready. A node whose agent has not reported is accepted."""
    ready = readiness(node.status)
    if ready is not None and ready.status != "True":
        return Check("EdgeNodeNotReady", ready.message or f"it is not Ready ({ready.reason})")
    return SUITABLE


def _is_shared(plan: DeploymentPlanSpec) -> bool:
    return plan.drone is not None and plan.drone.shared_with is not None


def _previously_placed(
    application: Application, previous: DeploymentPlanSpec | None
) -> Iterator[tuple[Component, str]]:
    """Return the components of the application that the previous plan placed, with their nodes."""
    components: dict[str, Component] = {c.name: c for c in application.spec.components}
    for placed in previous.placements if previous is not None else ():
        if placed.node is not None and placed.component in components:
            yield components[placed.component], placed.node
