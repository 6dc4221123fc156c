"""A plan in the making: the inputs, what is booked and placed so far, and what was rejected."""

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
"""Leaves room for a suffix, such as -tls of its Secret, within the 63 characters of a DNS label."""


class Infeasible(Exception):
    """No plan exists for the application; says which component has no host and why each node was dropped.

    Attributes:
        omitted: how many nodes that were too far away are not among those rejected.
        full: nodes that would do, were there room on them.
    """

    def __init__(
        self, component: str, reason: str, message: str, rejected: Iterable[Rejection] = (), omitted: int = 0
    ) -> None:
        self.component = component
        self.reason = reason
        self.message = message
        self.rejected = tuple(rejected)
        self.omitted = omitted
        self.full = frozenset(each.node for each in self.rejected if each.reason == INSUFFICIENT)
        super().__init__(message)


def instance_name(application: str, component: Component, node: str | None = None) -> str:
    """Name of an instance, unique in the namespace: a DNS label with room for a suffix."""
    return object_name(application, component.slug, node, limit=_MAX_INSTANCE_NAME)


class Draft:
    """One run of the planner: its inputs, and what it has decided so far."""

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
        self.ledger = Ledger(inventory.hosts, _running(application, previous) if reserving else ())
        self.drone_before = previous.drone.node if previous is not None and previous.drone is not None else None
        self.shared_before = self.drone_before is not None and previous is not None and _shares(previous)
        self.before = previous.placements if previous is not None else ()
        self._used_before = {(p.component, p.node) for p in self.before}
        self._placed: set[tuple[str, str | None]] = set()
        self._rejected: dict[tuple[str, str], Rejection] = {}
        self._far: dict[tuple[str, str], Rejection] = {}
        self._candidates: dict[str, tuple[set[str], int]] = {}

    def had(self, component: Component, node: str) -> bool:
        """Whether the plan before had the component on the node."""
        return (component.name, node) in self._used_before

    def placed(self, component: Component, node: str) -> bool:
        """Whether this plan has the component on the node."""
        return (component.name, node) in self._placed

    def flew(self, drone: str, *, shared: bool) -> bool:
        """Whether the plan before had the drone, and in the same way: for itself alone, or coming along."""
        return drone == self.drone_before and shared == self.shared_before

    # -- judging --

    def check_edge(self, node: EdgeNode, component: Component) -> Check:
        """Whether an edge node can host the component, or the first rule it fails."""
        kept = self.had(component, node.name)
        return (
            check_host(self.inventory.hosts, node.name, self.settings, kept=kept)
            and (SUITABLE if kept else _check_state(node))
            and check_services(node.spec.services, [component])
            and check_resources(self.ledger, node.name, [component])
        )

    def reject(self, component: Component, node: str, check: Check, *, far: bool = False) -> None:
        """Note that a node is not a host for a component; `far` says that it was not a candidate by place."""
        notes = self._far if far else self._rejected
        notes.setdefault((component.name, node), check.rejection(component, node))

    def consider(self, component: Component, names: Iterable[str], known: int) -> None:
        """Note which nodes are candidates for a component by place, of how many that are known: the others are too far."""
        self._candidates[component.name] = (set(names), known)

    def rejected(self, component: Component, node: str) -> bool:
        """Whether a node that was a candidate by place is rejected for a component."""
        return (component.name, node) in self._rejected

    def far_note(self, component: Component, node: str) -> str:
        """Why a node was not a candidate by place; empty if that was not noted."""
        found = self._far.get((component.name, node))
        return found.message if found is not None else ""

    def rejections(self, component: Component) -> list[Rejection]:
        """What was rejected for one component: first what was there, then what was too far; each by name."""
        here = sorted((r for r in self._rejected.values() if r.component == component.name), key=lambda r: r.node)
        nodes = {r.node for r in here}
        far = (r for r in self._far.values() if r.component == component.name and r.node not in nodes)
        return here + sorted(far, key=lambda r: r.node)

    def infeasible(self, component: Component, reason: str, problem: str, nothing: str) -> Infeasible:
        """The refusal of a component: the problem, the first few reasons, and all rejected nodes."""
        rejected = self.rejections(component)
        why = "; ".join(r.message for r in rejected[:5]) or nothing
        more = f"; and {len(rejected) - 5} more" if len(rejected) > 5 else ""
        omitted = self._unlisted(component.name, {r.node for r in rejected})
        return Infeasible(component.name, reason, f"{problem}: {why}{more}", rejected, omitted)

    # -- deciding --

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
        """Put an instance of a component on a node (None: any cloud node), and book what it asks for."""
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

    def listed(self) -> tuple[tuple[Rejection, ...], int]:
        """The rejected nodes that the plan lists, in the order of components and nodes, and how many it leaves out.

        A node that hosts the component after all is not rejected. What was a candidate by place goes before what was
        too far away.
        """
        notes = {**self._rejected}
        for key, rejection in self._far.items():
            notes.setdefault(key, rejection)
        wanted = [r for key, r in notes.items() if key not in self._placed]
        kept = wanted[: self.settings.rejections_listed]
        order = {c.name: i for i, c in enumerate(self.spec.components)}
        kept.sort(key=lambda r: (order[r.component], r.node))
        mentioned: dict[str, set[str]] = {}
        for name, node in (*notes, *self._placed):
            if node is not None:
                mentioned.setdefault(name, set()).add(node)
        far = sum(self._unlisted(name, mentioned.get(name, set())) for name in self._candidates)
        return tuple(kept), len(wanted) - len(kept) + far

    def _unlisted(self, component: str, mentioned: set[str]) -> int:
        """How many nodes were too far away for a component, and are not mentioned."""
        candidates, known = self._candidates.get(component, (set(), 0))
        return max(known - len(candidates | mentioned), 0)


def _check_state(node: EdgeNode) -> Check:
    """Whether an edge node is Ready, as far as its agent says: one without an agent that reports takes pods all the same."""
    ready = readiness(node.status)
    if ready is not None and ready.status != "True":
        return Check("EdgeNodeNotReady", ready.message or f"{node.name} is not Ready ({ready.reason})")
    return SUITABLE


def _shares(plan: DeploymentPlanSpec) -> bool:
    return plan.drone is not None and plan.drone.shared_with is not None


def _running(application: Application, previous: DeploymentPlanSpec | None) -> Iterator[tuple[Component, str]]:
    """What of the application the plan before has on which node."""
    components: dict[str, Component] = {c.name: c for c in application.spec.components}
    for placed in previous.placements if previous is not None else ():
        if placed.node is not None and placed.component in components:
            yield components[placed.component], placed.node
