"""Placement of static and hybrid components on edge nodes (thesis Algorithms 7 to 10)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from fractus_core.api.components import Component, EdgeLocation
from fractus_core.api.geometry import Point
from fractus_core.api.nodes import Drone, EdgeNode, Interface, direct_interface
from fractus_core.api.plans import PlannedInstance, Serves
from fractus_core.geo import distance_m, ground_point
from fractus_core.planning.candidates import Check, direct_range_m, direct_reach_m
from fractus_core.planning.coverage import CoverScene, Samples, greedy_cover
from fractus_core.planning.operation_area import OperationArea
from fractus_core.planning.plan_builder import PlanBuilder
from fractus_core.planning.spatial_index import Near


@dataclass(eq=False, slots=True)
class Location:
    """A location of a static component during the choice of its nodes.

    Attributes:
        index: Index of the location in the component.
        nodes: Edge nodes in the location: current hosts first, then the nearest first.
        hosts: Selected nodes.
        checked: Number of nodes at the beginning of `nodes` that were checked. None of these nodes is free any more.
    """

    component: Component
    index: int
    nodes: tuple[str, ...]
    hosts: list[str] = field(default_factory=list)
    checked: int = 0

    @property
    def spot(self) -> EdgeLocation:
        """Area and number of instances."""
        return self.component.locations[self.index]


def find_static(builder: PlanBuilder, component: Component) -> list[Location]:
    """Return each location of a component with its edge nodes. Record the nearest nodes outside all locations as rejected."""
    located = builder.located.edge_nodes
    known = builder.inventory.edge_nodes
    before = {(p.location, p.node) for p in builder.previous_placements if p.component == component.name}
    matches = []
    for i, spot in enumerate(component.locations):
        near = [(name, distance) for name, distance in located.within(spot.center, spot.radius) if name in known]
        matches.append(Location(component, i, tuple(_current_hosts_first(builder, component, i, near, before))))
    inside = {name for location in matches for name in location.nodes}
    builder.set_candidates(component, inside, len(located))
    for i, spot in enumerate(component.locations):
        for name, distance in located.nearest(
            spot.center, builder.settings.near_misses, spot.radius, builder.settings.near_miss_m
        ):
            if name not in inside and name in known:
                message = f"it is {distance:.0f} m from the centre of locations[{i}], more than {spot.radius:.0f} m"
                builder.reject(component, name, Check("OutsideLocation", message), far=True)
    return matches


def place_static(builder: PlanBuilder, locations: Sequence[Location]) -> None:
    """Fill the locations of all static components with the nearest suitable nodes.

    A node hosts a component only once. Locations that request a number of instances choose first. If several of them
    need the same node, some of them use nodes that are farther away (see `_NodeMatching`). Locations that request an
    instance on every suitable node (`instances: "*"`) then get the remaining nodes.

    Raises:
        Infeasible: A location that requests a number of instances gets none.
    """
    matching = _NodeMatching(builder)
    numbered = [location for location in locations if location.spot.instances != "*"]
    matching.fill(numbered)
    starved = _first_empty(numbered)
    if starved is not None:
        # Give each location one instance before any location gets a second one.
        matching.clear(numbered)
        matching.fill(numbered, at_most=1)
        starved = _first_empty(numbered)
        matching.fill(numbered)
    matching.sweep(locations)
    matching.clear_bookings()
    for location in locations:
        chosen = set(location.hosts)
        for name in location.nodes[: location.checked]:
            if name in chosen:
                builder.place(location.component, "static", name, location=location.index)
    _reject_unsuitable(builder, locations)
    if starved is not None:
        raise _no_node(builder, starved, locations)


class _NodeMatching:
    """Assignment of nodes to locations.

    A location without a free node takes a node from a second location. The second location then gets a replacement in
    the same way. This is an augmenting path of bipartite matching (H. W. Kuhn 1955). If all instances request equal
    resources, the result has the maximum number of instances. It depends only on the order of components, locations and
    nodes. A running instance is moved only for the first instance of a location, not for further ones.
    """

    def __init__(self, builder: PlanBuilder) -> None:
        self._builder = builder
        self._holders: dict[str, list[Location]] = {}

    def fill(self, locations: Iterable[Location], at_most: int | None = None) -> None:
        """Assign nodes to locations, in order, until each has the requested number of instances or `at_most`."""
        for location in locations:
            count = at_most or int(location.spot.instances)
            while len(location.hosts) < count and self._assign(location, {location}, first=not location.hosts):
                pass

    def sweep(self, locations: Iterable[Location]) -> None:
        """Assign free nodes to locations that have too few."""
        for location in locations:
            for name in location.nodes:
                if location.spot.instances != "*" and len(location.hosts) >= location.spot.instances:
                    break
                location.checked = len(location.nodes)
                if self._fits(location, name):
                    self._take(location, name)

    def clear(self, locations: Iterable[Location]) -> None:
        """Cancel all assignments."""
        self.clear_bookings()
        for location in locations:
            location.hosts.clear()
            location.checked = 0
        self._holders.clear()

    def clear_bookings(self) -> None:
        """Release the booked resources of all assignments."""
        for name, holders in self._holders.items():
            for location in holders:
                self._builder.ledger.release(name, location.component)

    def _assign(self, location: Location, visited: set[Location], *, first: bool) -> bool:
        """Assign another node to a location. Return False if no node is left."""
        while location.checked < len(location.nodes):
            name = location.nodes[location.checked]
            location.checked += 1
            if self._fits(location, name):
                self._take(location, name)
                return True
        for name in location.nodes:
            for other in tuple(self._holders.get(name, ())):
                if other in visited or (not first and self._builder.was_placed(other.component, name)):
                    continue
                self._release(other, name)
                if self._fits(location, name):
                    visited.add(other)
                    self._take(location, name)
                    if self._assign(other, visited, first=first):
                        return True
                    self._release(location, name)
                self._take(other, name)
        return False

    def _fits(self, location: Location, name: str) -> bool:
        if any(other.component is location.component for other in self._holders.get(name, ())):
            return False
        return bool(self._builder.check_edge(self._builder.inventory.edge_nodes[name], location.component))

    def _take(self, location: Location, name: str) -> None:
        location.hosts.append(name)
        self._holders.setdefault(name, []).append(location)
        self._builder.ledger.take(name, location.component)

    def _release(self, location: Location, name: str) -> None:
        location.hosts.remove(name)
        self._holders[name].remove(location)
        self._builder.ledger.release(name, location.component)


def _first_empty(locations: Iterable[Location]) -> Location | None:
    return next((location for location in locations if not location.hosts), None)


def _reject_unsuitable(builder: PlanBuilder, locations: Iterable[Location]) -> None:
    """Store why checked nodes do not host the component."""
    for location in locations:
        for name in location.nodes[: location.checked]:
            if not builder.is_placed(location.component, name):
                check = builder.check_edge(builder.inventory.edge_nodes[name], location.component)
                if not check:
                    builder.reject(location.component, name, check)


def _no_node(builder: PlanBuilder, starved: Location, locations: Iterable[Location]) -> Exception:
    """Return the error for a location without any node."""
    component = starved.component
    spot = starved.spot
    for other in locations:
        for name in other.hosts:
            if other.component is component and name in starved.nodes:
                message = f"it hosts {component.name} for locations[{other.index}], which has no other node"
                builder.reject(component, name, Check("NeededElsewhere", message))
    surroundings = f"{spot.radius:.0f} m of {spot.center.lat:.6f}, {spot.center.lon:.6f}"
    problem = f"no node can host {component.name} at locations[{starved.index}]"
    return builder.infeasible(component, "NoEdgeNode", problem, f"there is no edge node within {surroundings}")


def _current_hosts_first(
    builder: PlanBuilder,
    component: Component,
    location: int,
    nodes: Sequence[Near],
    before: set[tuple[int | None, str | None]],
) -> list[str]:
    """Sort nodes: current hosts for the location first, hosts for another location of the component last."""

    def rank(name: str) -> int:
        if (location, name) in before or (None, name) in before:
            return 0
        return 2 if builder.was_placed(component, name) else 1

    names = [name for name, _ in nodes]
    return sorted(names, key=rank) if before else names


# -- hybrid components near static ones --


@dataclass(slots=True)
class HybridHosts:
    """Nodes that host a hybrid component, in the order of placement."""

    nodes: dict[str, None] = field(default_factory=dict)


def place_near(builder: PlanBuilder, component: Component, static: PlannedInstance, hosts: HybridHosts) -> None:
    """Place an instance of a hybrid component for a static instance: on the same node, or on the nearest node in direct range.

    A node that already hosts the component also serves this instance. If no node is suitable, the cloud instance serves it.
    """
    origin = builder.inventory.edge_nodes[static.node or ""]
    served = [
        p.node
        for p in builder.previous_placements
        if p.component == component.name
        and p.role == "hybrid-edge"
        and p.serves == Serves(component=static.component, node=origin.name)
    ]
    # Other nodes are searched only if the node itself is not suitable, which is rare.
    for names in (served, [origin.name], None):
        nodes = _in_direct_range(builder, component, origin) if names is None else names
        for name in nodes:
            if name in hosts.nodes:
                return
            node = builder.inventory.edge_nodes.get(name or "")
            if node is None or (names is served and not _reaches(origin, node)):
                continue
            check = builder.check_edge(node, component)
            if check:
                hosts.nodes[node.name] = None
                serves = Serves(component=static.component, node=origin.name)
                builder.place(component, "hybrid-edge", node.name, serves=serves)
                return
            builder.reject(component, node.name, check)


def _in_direct_range(builder: PlanBuilder, component: Component, origin: EdgeNode) -> list[str]:
    """Return the nodes in direct range of a node, nearest first, and reject nearby nodes without a matching interface."""
    range_m = direct_range_m(origin.spec.interfaces)
    matches = []
    if range_m is None:
        return []
    for name, distance in builder.located.edge_nodes.within(ground_point(origin.spec.location), range_m):
        if name == origin.name or name not in builder.inventory.edge_nodes:
            continue
        reach = direct_reach_m(origin.spec.interfaces, builder.inventory.edge_nodes[name].spec.interfaces)
        if reach is None:
            message = f"it has no interface that pairs with {origin.name}'s"
            builder.reject(component, name, Check("NoDirectInterface", message))
        elif distance > reach:
            message = f"it is {distance:.0f} m from {origin.name}, beyond their direct reach of {reach:.0f} m"
            builder.reject(component, name, Check("OutOfReach", message))
        else:
            matches.append(name)
    return matches


def _reaches(origin: EdgeNode, node: EdgeNode) -> bool:
    if origin.name == node.name:
        return True
    reach = direct_reach_m(origin.spec.interfaces, node.spec.interfaces)
    return (
        reach is not None and distance_m(ground_point(origin.spec.location), ground_point(node.spec.location)) <= reach
    )


# -- hybrid components along the flight path --


@dataclass(frozen=True, slots=True)
class PathCandidates:
    """Edge nodes in direct range of a drone within the operation area: names, positions, ranges."""

    drone: Drone
    area: OperationArea
    names: list[str]
    xy: np.ndarray[tuple[int, int], np.dtype[np.float64]]
    reach_m: np.ndarray[tuple[int], np.dtype[np.float64]]


def find_along(builder: PlanBuilder, component: Component, drone: Drone, area: OperationArea) -> PathCandidates:
    """Return the candidates, and reject nodes in range without a matching interface and the nearest nodes out of range."""
    range_m = direct_range_m(drone.spec.interfaces)
    names: list[str] = []
    xy = np.empty((0, 2))
    if range_m is not None:
        names, xy = builder.located.edge_nodes.near_area(area.frame, area.shape, range_m)
    reaches = _Reaches(drone.spec.interfaces)
    matches: list[int] = []
    reach_m: list[float] = []
    for i, name in enumerate(names):
        node = builder.inventory.edge_nodes.get(name)
        reach = reaches.to(node.spec.interfaces) if node is not None else None
        if node is not None and reach is None:
            message = f"it has no interface that pairs with {drone.name}'s"
            builder.reject(component, name, Check("NoDirectInterface", message))
        elif reach is not None:
            matches.append(i)
            reach_m.append(reach)
    builder.set_candidates(component, names, len(builder.located.edge_nodes))
    _reject_out_of_range(builder, component, drone, area, set(names))
    return PathCandidates(drone, area, [names[i] for i in matches], xy[matches], np.array(reach_m, dtype=np.float64))


def place_along(
    builder: PlanBuilder, component: Component, other: Component, along: PathCandidates, hosts: HybridHosts
) -> None:
    """Select nodes along the flight path, and place the component on them."""
    occupied = np.array([name in hosts.nodes for name in along.names], dtype=bool)
    kept = np.array([builder.was_placed(component, name) for name in along.names], dtype=bool)
    free = np.flatnonzero(~occupied)
    discs = np.column_stack((along.xy, along.reach_m))
    scene = CoverScene(
        samples=Samples(along.area.shape),
        names=[along.names[i] for i in free.tolist()],
        xy=along.xy[free],
        reach_m=along.reach_m[free],
        share=builder.settings.coverage_share,
        kept=frozenset(along.names[i] for i in np.flatnonzero(kept).tolist()),
        covered_by=discs[occupied & kept],
        newly_covered_by=discs[occupied & ~kept],
    )

    def fits(name: str) -> bool:
        check = builder.check_edge(builder.inventory.edge_nodes[name], component)
        if not check:
            builder.reject(component, name, check)
        return bool(check)

    for pick in (builder.settings.cover or greedy_cover)(scene, fits):
        hosts.nodes[pick.name] = None
        serves = Serves(component=other.name, node=along.drone.name)
        builder.place(component, "hybrid-drone", pick.name, serves=serves, coverage=round(pick.share, 6))
    _reject_without_coverage(builder, component, scene, hosts)


def _reject_without_coverage(builder: PlanBuilder, component: Component, scene: CoverScene, hosts: HybridHosts) -> None:
    """Reject the candidates whose direct links cover no part of the operation area."""
    node, first, end = scene.samples.runs(scene.xy, scene.reach_m)
    useful = np.zeros(len(scene.names), dtype=bool)
    useful[node[end > first]] = True
    for i in np.flatnonzero(~useful).tolist():
        name = scene.names[i]
        if name not in hosts.nodes:
            message = f"it reaches {scene.reach_m[i]:.0f} m and covers nothing of the operation area"
            builder.reject(component, name, Check("NoCoverage", message))


def _reject_out_of_range(
    builder: PlanBuilder, component: Component, drone: Drone, area: OperationArea, near: set[str]
) -> None:
    """Reject the nodes nearest to the centre of the area that are out of range of the drone everywhere in it."""
    lat, lon = area.frame.latlon(*(float(v) for v in area.shape.centroid.coords[0]))
    count = builder.settings.near_misses
    reaches = _Reaches(drone.spec.interfaces)
    closest = builder.located.edge_nodes.nearest(
        Point(lat=lat, lon=lon), count + min(len(near), count), within_m=builder.settings.near_miss_m
    )
    for name, _ in closest:
        node = builder.inventory.edge_nodes.get(name)
        if node is None or name in near:
            continue
        reach = reaches.to(node.spec.interfaces)
        check = Check("NoDirectInterface", f"it has no interface that pairs with {drone.name}'s")
        if reach is not None:
            check = Check("NoCoverage", f"it reaches {reach:.0f} m and covers nothing of the operation area")
        builder.reject(component, name, check, far=True)


class _Reaches:
    """Maximum link distances from the interfaces of one node, cached by the interface of the other node."""

    def __init__(self, interfaces: Sequence[Interface]) -> None:
        self._interfaces = interfaces
        self._known: dict[tuple[object, ...], float | None] = {}

    def to(self, interfaces: Sequence[Interface]) -> float | None:
        """Return the maximum distance of a direct link in metres, or None if no interfaces match."""
        link = direct_interface(interfaces)
        key = (link.technology, link.range, link.pairing and link.pairing.mode) if link is not None else ()
        if key not in self._known:
            self._known[key] = direct_reach_m(self._interfaces, interfaces)
        return self._known[key]
