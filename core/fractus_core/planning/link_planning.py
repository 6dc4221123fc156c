"""Which direct links a plan makes possible: between its drone and the edge nodes with instances the drone can use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fractus_core.api.applications import Application, ApplicationSpec
from fractus_core.api.components import Component, Heuristic
from fractus_core.api.geometry import Position
from fractus_core.api.nodes import Depot, Drone, EdgeNode, Pairing, Technology, direct_interface
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance
from fractus_core.planning.candidates import direct_reach_m
from fractus_core.planning.operation_area import route_of

MAX_WAYPOINTS = 1000
"""A longer path is not told: it would be repeated in every link, and agents judge by the velocity instead."""

DEFAULT_HEURISTIC = Heuristic(kind="preferDirect")


@dataclass(frozen=True, slots=True)
class PlannedLink:
    """A direct link that a drone may have.

    Attributes:
        drone: the node that asks.
        node: the node that is asked.
        technology: of the two interfaces.
        pairing: of the interface of the node that is asked: the drone joins its network.
        range_m: the lesser reach of the two interfaces.
        bandwidth_mbps: the lesser bandwidth of the two interfaces.
        position: of the node that is asked.
        heuristic: of the first of the components in the manifest.
        instances: what the drone's components can use on that node, in the order of the manifest.
    """

    drone: str
    node: str
    technology: Technology
    pairing: Pairing
    range_m: float
    bandwidth_mbps: float
    position: Position
    heuristic: Heuristic
    instances: tuple[PlannedInstance, ...]


def plan_links(
    application: Application, plan: DeploymentPlanSpec, drone: Drone | None, edge_nodes: Mapping[str, EdgeNode]
) -> tuple[PlannedLink, ...]:
    """The direct links of a plan by node: one to each edge node that hosts a hybrid component which the drone's use.

    Args:
        application: Whose plan it is.
        plan: Where its instances run.
        drone: The drone of the plan; None where there is none, or none any more.
        edge_nodes: By name. One that is gone, or has no interface that pairs with the drone's, gets no link.
    """
    if drone is None:
        return ()
    used = [component for component in application.spec.components if _is_used_aboard(application.spec, component)]
    hosted: dict[str, list[tuple[Component, PlannedInstance]]] = {}
    for component in used:
        for placed in plan.placements:
            if placed.component == component.name and placed.node in edge_nodes:
                hosted.setdefault(placed.node or "", []).append((component, placed))
    links = (_link(drone, edge_nodes[name], hosted[name]) for name in sorted(hosted))
    return tuple(link for link in links if link is not None)


def _link(drone: Drone, node: EdgeNode, hosted: Sequence[tuple[Component, PlannedInstance]]) -> PlannedLink | None:
    ours, theirs = direct_interface(drone.spec.interfaces), direct_interface(node.spec.interfaces)
    reach_m = direct_reach_m([ours], [theirs]) if ours is not None and theirs is not None else None
    if ours is None or theirs is None or theirs.pairing is None or reach_m is None:
        return None
    return PlannedLink(
        drone=drone.name,
        node=node.name,
        technology=theirs.technology,
        pairing=theirs.pairing,
        range_m=reach_m,
        bandwidth_mbps=min(ours.bandwidth_mbps, theirs.bandwidth_mbps),
        position=node.spec.location,
        heuristic=hosted[0][0].heuristic or DEFAULT_HEURISTIC,
        instances=tuple(placed for _, placed in hosted),
    )


def flown_path(spec: ApplicationSpec, depots: Mapping[str, Depot]) -> tuple[Position, ...]:
    """The waypoints that a drone flies for an application, in order; empty where part of its way is not known before.

    Raises:
        InvalidObject: a control point names an unknown depot.
    """
    points = spec.driver.control_points if spec.driver is not None else ()
    path = () if any(point.region is not None for point in points) else tuple(route_of(spec, depots))
    return path if len(path) <= MAX_WAYPOINTS else ()


def _is_used_aboard(spec: ApplicationSpec, component: Component) -> bool:
    """Whether a component is hybrid, can be called, and a component on the drone calls it or draws it near."""
    if component.placement != "hybrid" or not component.container.ports:
        return False
    named = {*component.hybrid_to, *component.ingress}
    return any(c.placement == "drone" and (c.name in named or component.name in c.egress) for c in spec.components)
