"""Detection of nodes on which an existing plan could have more instances."""

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
    """Return the locations that could have more instances than the plan has, each with its component.

    These are locations for every suitable node (`instances: "*"`) and locations with fewer instances than requested.
    """
    counts = Counter((placed.component, placed.location) for placed in current.placements)
    for component in application.spec.on("edge"):
        for i, spot in enumerate(component.locations):
            if spot.instances == "*" or counts[component.name, i] < spot.instances:
                yield component, spot


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
    """Return the nodes in underfilled locations that lack only free resources."""
    checks = _check_candidates(application, inventory, settings, current)
    return frozenset(name for name, check in checks if check.reason == INSUFFICIENT)


def _check_candidates(
    application: Application, inventory: Inventory, settings: Settings, current: DeploymentPlanSpec
) -> Iterator[tuple[str, Check]]:
    """Check each node in an underfilled location that does not host the component yet."""
    builder: PlanBuilder | None = None
    for component, spot in underfilled_locations(application, current):
        builder = builder or PlanBuilder(application, inventory, settings, current)
        for name, _ in builder.located.edge_nodes.within(spot.center, spot.radius):
            node = inventory.edge_nodes.get(name)
            if node is not None and not builder.was_placed(component, name):
                yield name, builder.check_edge(node, component)
