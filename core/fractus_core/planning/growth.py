"""Where a plan that stands could have more instances, because nodes came or got room."""

from __future__ import annotations

from fractus_core.api.applications import Application
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.draft import Draft
from fractus_core.planning.inventory import Inventory, Settings


def room_to_grow(
    application: Application, inventory: Inventory, settings: Settings, present: DeploymentPlanSpec
) -> str | None:
    """The first node that a location with too few instances could have beside what the plan has; None: there is none.

    Too few has a location that takes every suitable node (`instances: "*"`), or one that found fewer than it asks for.
    Costs a look at the nodes in such locations only.
    """
    draft = Draft(application, inventory, settings, present)
    counts: dict[tuple[str, int | None], int] = {}
    for placed in present.placements:
        key = (placed.component, placed.location)
        counts[key] = counts.get(key, 0) + 1
    for component in application.spec.on("edge"):
        for i, spot in enumerate(component.locations):
            if spot.instances != "*" and counts.get((component.name, i), 0) >= spot.instances:
                continue
            for name, _ in draft.located.edge_nodes.within(spot.center, spot.radius):
                node = inventory.edge_nodes.get(name)
                if node is None or draft.had(component, name):
                    continue
                if draft.check_edge(node, component):
                    return name
    return None
