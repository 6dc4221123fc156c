"""Search for nodes that could host additional instances of an existing plan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from fractus_core.api.applications import Application
from fractus_core.api.components import Component, EdgeLocation
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import INSUFFICIENT, Check
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.plan_builder import PlanBuilder


def underfilled_locations(
    application: Application, current: DeploymentPlanSpec
) -> Iterator[tuple[Component, EdgeLocation]]:
    """Return the locations that could have more instances than in the plan, each with its component.

    They have fewer instances than requested, or request an instance on every suitable node (`instances: "*"`).
    """
    counts = Counter((placed.component, placed.location) for placed in current.placements)
    for component in application.spec.on("edge"):
        for i, location in enumerate(component.locations):
            if location.instances == "*" or counts[component.name, i] < location.instances:
                yield component, location


def next_free_node(
    application: Application, inventory: Inventory, settings: Settings, current: DeploymentPlanSpec
) -> str | None:
    """Return a node that could host another instance of an underfilled location, or None.

    Only the nodes in these locations are checked.
    """
    return next((name for name, check in _check_candidates(application, inventory, settings, current) if check), None)


def full_nodes(
    application: Application, inventory: Inventory, settings: Settings, current: DeploymentPlanSpec
) -> frozenset[str]:
    """Return the nodes that could run another instance of an underfilled location if they had enough free resources."""
    checks = _check_candidates(application, inventory, settings, current)
    return frozenset(name for name, check in checks if check.reason == INSUFFICIENT)


def _check_candidates(
    application: Application, inventory: Inventory, settings: Settings, current: DeploymentPlanSpec
) -> Iterator[tuple[str, Check]]:
    """Check each node in an underfilled location that does not host the component yet."""
    builder: PlanBuilder | None = None
    for component, location in underfilled_locations(application, current):
        builder = builder or PlanBuilder(application, inventory, settings, current)
        for name, _ in builder.located.edge_nodes.within(location.center, location.radius):
            node = inventory.edge_nodes.get(name)
            if node is not None and not builder.was_placed(component, name):
                yield name, builder.check_edge(node, component)
