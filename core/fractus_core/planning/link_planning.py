"""Direct links of a plan, between its drone and the edge nodes with instances that the drone's components use."""

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
"""Maximum path length. Longer paths are omitted, because each link repeats them. Agents then predict from the velocity."""

DEFAULT_HEURISTIC = Heuristic(kind="preferDirect")


@dataclass(frozen=True, slots=True)
class PlannedLink:
    """A possible direct link of a drone.

    Attributes:
        drone: Name of the drone, which sets up the link.
        node: Name of the edge node, which accepts the link.
        technology: Network technology of both interfaces.
        pairing: Network settings of the edge node, which the drone joins.
        range_m: Smaller range of the two interfaces.
        bandwidth_mbps: Smaller bandwidth of the two interfaces.
        position: Position of the edge node.
        heuristic: Heuristic of the first component in the manifest.
        instances: Instances on the edge node that the drone's components use, in the order of the manifest.
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
    """Return the direct links of a plan.

    There is one link for each edge node with a hybrid component that the drone's components use.

    Args:
        application: Application of the plan.
        plan: Placements of its instances.
        drone: Drone of the plan, or None if the plan has no drone or the drone no longer exists.
        edge_nodes: Edge nodes by name. Missing nodes and nodes without a matching interface get no link.
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
    interface = direct_interface(drone.spec.interfaces)
    peer_interface = direct_interface(node.spec.interfaces)
    if interface is None or peer_interface is None or peer_interface.pairing is None:
        return None
    reach_m = direct_reach_m([interface], [peer_interface])
    if reach_m is None:
        return None
    return PlannedLink(
        drone=drone.name,
        node=node.name,
        technology=peer_interface.technology,
        pairing=peer_interface.pairing,
        range_m=reach_m,
        bandwidth_mbps=min(interface.bandwidth_mbps, peer_interface.bandwidth_mbps),
        position=node.spec.location,
        heuristic=hosted[0][0].heuristic or DEFAULT_HEURISTIC,
        instances=tuple(placed for _, placed in hosted),
    )


def flown_path(spec: ApplicationSpec, depots: Mapping[str, Depot]) -> tuple[Position, ...]:
    """Return the waypoints of an application's flight in order, or an empty path if part of the route is unknown.

    Raises:
        InvalidObject: A control point names an unknown depot.
    """
    points = spec.driver.control_points if spec.driver is not None else ()
    path = () if any(point.region is not None for point in points) else tuple(route_of(spec, depots))
    return path if len(path) <= MAX_WAYPOINTS else ()


def _is_used_aboard(spec: ApplicationSpec, component: Component) -> bool:
    """Return True for a hybrid component that has ports, if a drone component calls it or is one of its partners."""
    if component.placement != "hybrid" or not component.container.ports:
        return False
    named = {*component.hybrid_to, *component.ingress}
    return any(c.placement == "drone" and (c.name in named or component.name in c.egress) for c in spec.components)
