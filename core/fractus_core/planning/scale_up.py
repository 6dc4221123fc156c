"""Where a plan that stands could have more instances, because nodes came or got room."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from fractus_core.api.applications import Application
from fractus_core.api.components import Component, EdgeLocation
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import INSUFFICIENT, Check
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.plan_builder import Draft


def with_too_few(application: Application, present: DeploymentPlanSpec) -> Iterator[tuple[Component, EdgeLocation]]:
    """The locations that could have more instances than a plan has there, if there were nodes: each with its component.

    Those are one that takes every suitable node (`instances: "*"`), and one that found fewer than it asks for.
    """
    counts = Counter((placed.component, placed.location) for placed in present.placements)
    for component in application.spec.on("edge"):
        for i, spot in enumerate(component.locations):
            if spot.instances == "*" or counts[component.name, i] < spot.instances:
                yield component, spot


def room_to_grow(
    application: Application, inventory: Inventory, settings: Settings, present: DeploymentPlanSpec
) -> str | None:
    """The first node that a location with too few instances could have beside what the plan has; None: there is none.

    Costs a look at the nodes in such locations only.
    """
    return next((name for name, check in _looked_at(application, inventory, settings, present) if check), None)


def without_room(
    application: Application, inventory: Inventory, settings: Settings, present: DeploymentPlanSpec
) -> frozenset[str]:
    """The nodes that a location with too few instances could have, were there room on them."""
    checks = _looked_at(application, inventory, settings, present)
    return frozenset(name for name, check in checks if check.reason == INSUFFICIENT)


def _looked_at(
    application: Application, inventory: Inventory, settings: Settings, present: DeploymentPlanSpec
) -> Iterator[tuple[str, Check]]:
    """Each node in a location with too few instances that has none of them, and whether it does."""
    draft: Draft | None = None
    for component, spot in with_too_few(application, present):
        draft = draft or Draft(application, inventory, settings, present)
        for name, _ in draft.located.edge_nodes.within(spot.center, spot.radius):
            node = inventory.edge_nodes.get(name)
            if node is not None and not draft.had(component, name):
                yield name, draft.check_edge(node, component)
