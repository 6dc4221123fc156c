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
from fractus_core.planning.plan_builder import Draft
from fractus_core.planning.spatial_index import Near


@dataclass(eq=False, slots=True)
class Location:
    """A location of a static component while its nodes are chosen.

    Attributes:
        index: which of the component's locations.
        nodes: the edge nodes in it: those that host the component for it already, then the nearest first.
        hosts: those chosen.
        seen: how many of the nodes were looked at; none of these is free.
    """

    component: Component
    index: int
    nodes: tuple[str, ...]
    hosts: list[str] = field(default_factory=list)
    seen: int = 0

    @property
    def spot(self) -> EdgeLocation:
        """Where it is, and how many instances it asks for."""
        return self.component.locations[self.index]


def find_static(draft: Draft, component: Component) -> list[Location]:
    """A component's locations with the edge nodes in them; notes the nearest nodes that are in none."""
    located, known = draft.located.edge_nodes, draft.inventory.edge_nodes
    before = {(p.location, p.node) for p in draft.before if p.component == component.name}
    found = []
    for i, spot in enumerate(component.locations):
        near = [(name, distance) for name, distance in located.within(spot.center, spot.radius) if name in known]
        found.append(Location(component, i, tuple(_staying_first(draft, component, i, near, before))))
    inside = {name for location in found for name in location.nodes}
    draft.consider(component, inside, len(located))
    for i, spot in enumerate(component.locations):
        for name, distance in located.nearest(
            spot.center, draft.settings.near_misses, spot.radius, draft.settings.near_miss_m
        ):
            if name not in inside and name in known:
                message = f"{name} is {distance:.0f} m from the centre of locations[{i}], more than {spot.radius:.0f} m"
                draft.reject(component, name, Check("OutsideLocation", message), far=True)
    return found


def place_static(draft: Draft, locations: Sequence[Location]) -> None:
    """Fill the locations of all static components, each with the nearest nodes that suit.

    A node hosts a component once. Where the nearest are not enough for all locations that need instances, some of these
    yield: see `_Seating`. Locations that take every suitable node get what the others leave.

    Raises:
        Infeasible: a location that needs instances gets none.
    """
    seating = _Seating(draft)
    numbered = [location for location in locations if location.spot.instances != "*"]
    seating.fill(numbered)
    starved = _first_without(numbered)
    if starved is not None:
        # One for each before a second for any.
        seating.clear(numbered)
        seating.fill(numbered, at_most=1)
        starved = _first_without(numbered)
        seating.fill(numbered)
    seating.sweep(locations)
    seating.clear_bookings()
    for location in locations:
        chosen = set(location.hosts)
        for name in location.nodes[: location.seen]:
            if name in chosen:
                draft.place(location.component, "static", name, location=location.index)
    _note_rejected(draft, locations)
    if starved is not None:
        raise _nowhere(draft, starved, locations)


class _Seating:
    """Who hosts what so far.

    A location that finds no free node takes one from another location that finds a new one itself, and so on: an
    augmenting path of bipartite matching (H. W. Kuhn 1955). So as many of the wanted instances have a node as can have
    one, where instances ask for equal resources; the choice depends on the order of components, locations and nodes only.
    What runs already yields to the first instance of a location, not to further ones.
    """

    def __init__(self, draft: Draft) -> None:
        self._draft = draft
        self._holders: dict[str, list[Location]] = {}

    def fill(self, locations: Iterable[Location], at_most: int | None = None) -> None:
        """Bring locations to the instances that they ask for, in their order."""
        for location in locations:
            wanted = at_most or int(location.spot.instances)
            while len(location.hosts) < wanted and self._seat(location, {location}, first=not location.hosts):
                pass

    def sweep(self, locations: Iterable[Location]) -> None:
        """Give free nodes to locations that have too few."""
        for location in locations:
            for name in location.nodes:
                if location.spot.instances != "*" and len(location.hosts) >= location.spot.instances:
                    break
                location.seen = len(location.nodes)
                if self._fits(location, name):
                    self._take(location, name)

    def clear(self, locations: Iterable[Location]) -> None:
        """Begin again."""
        self.clear_bookings()
        for location in locations:
            location.hosts.clear()
            location.seen = 0
        self._holders.clear()

    def clear_bookings(self) -> None:
        """Book nothing any more."""
        for name, holders in self._holders.items():
            for location in holders:
                self._draft.ledger.release(name, location.component)

    def _seat(self, location: Location, asked: set[Location], *, first: bool) -> bool:
        """Find one more node for a location; True if there is one."""
        while location.seen < len(location.nodes):
            name = location.nodes[location.seen]
            location.seen += 1
            if self._fits(location, name):
                self._take(location, name)
                return True
        for name in location.nodes:
            for other in tuple(self._holders.get(name, ())):
                if other in asked or (not first and self._draft.had(other.component, name)):
                    continue
                self._release(other, name)
                if self._fits(location, name):
                    asked.add(other)
                    self._take(location, name)
                    if self._seat(other, asked, first=first):
                        return True
                    self._release(location, name)
                self._take(other, name)
        return False

    def _fits(self, location: Location, name: str) -> bool:
        if any(other.component is location.component for other in self._holders.get(name, ())):
            return False
        return bool(self._draft.check_edge(self._draft.inventory.edge_nodes[name], location.component))

    def _take(self, location: Location, name: str) -> None:
        location.hosts.append(name)
        self._holders.setdefault(name, []).append(location)
        self._draft.ledger.take(name, location.component)

    def _release(self, location: Location, name: str) -> None:
        location.hosts.remove(name)
        self._holders[name].remove(location)
        self._draft.ledger.release(name, location.component)


def _first_without(locations: Iterable[Location]) -> Location | None:
    return next((location for location in locations if not location.hosts), None)


def _note_rejected(draft: Draft, locations: Iterable[Location]) -> None:
    """Note why the nodes that were looked at host nothing."""
    for location in locations:
        for name in location.nodes[: location.seen]:
            if not draft.placed(location.component, name):
                check = draft.check_edge(draft.inventory.edge_nodes[name], location.component)
                if not check:
                    draft.reject(location.component, name, check)


def _nowhere(draft: Draft, starved: Location, locations: Iterable[Location]) -> Exception:
    """The refusal of a location without any node."""
    component, spot = starved.component, starved.spot
    for other in locations:
        for name in other.hosts:
            if other.component is component and name in starved.nodes:
                message = f"{name} hosts {component.name} for locations[{other.index}], which has no other node"
                draft.reject(component, name, Check("NeededElsewhere", message))
    where = f"{spot.radius:.0f} m of {spot.center.lat:.6f}, {spot.center.lon:.6f}"
    problem = f"no node can host {component.name} at locations[{starved.index}]"
    return draft.infeasible(component, "NoEdgeNode", problem, f"there is no edge node within {where}")


def _staying_first(
    draft: Draft,
    component: Component,
    location: int,
    nodes: Sequence[Near],
    before: set[tuple[int | None, str | None]],
) -> list[str]:
    """Nodes that host the component for this location first, those that do for another one last."""

    def rank(name: str) -> int:
        if (location, name) in before or (None, name) in before:
            return 0
        return 2 if draft.had(component, name) else 1

    names = [name for name, _ in nodes]
    return sorted(names, key=rank) if before else names


# -- beside static components --


@dataclass(slots=True)
class HybridHosts:
    """Where a hybrid component has instances so far, in the order they were placed."""

    nodes: dict[str, None] = field(default_factory=dict)


def place_beside(draft: Draft, component: Component, static: PlannedInstance, hosts: HybridHosts) -> None:
    """Host a hybrid component for one static instance: on its own node, or the nearest that it can talk to directly.

    A node that hosts the component already serves this one too. Without any, the cloud base does.
    """
    here = draft.inventory.edge_nodes[static.node or ""]
    served = [
        p.node
        for p in draft.before
        if p.component == component.name
        and p.role == "hybrid-edge"
        and p.serves == Serves(component=static.component, node=here.name)
    ]
    # Neighbours are only looked for when the node itself will not do: it comes first, and mostly suits.
    for names in (served, [here.name], None):
        nodes = _beside(draft, component, here) if names is None else names
        for name in nodes:
            if name in hosts.nodes:
                return
            node = draft.inventory.edge_nodes.get(name or "")
            if node is None or (names is served and not _reaches(here, node)):
                continue
            check = draft.check_edge(node, component)
            if check:
                hosts.nodes[node.name] = None
                serves = Serves(component=static.component, node=here.name)
                draft.place(component, "hybrid-edge", node.name, serves=serves)
                return
            draft.reject(component, node.name, check)


def _beside(draft: Draft, component: Component, here: EdgeNode) -> list[str]:
    """Nodes around one, nearest first, that it can talk to directly; notes those that it cannot."""
    ours = direct_range_m(here.spec.interfaces)
    found = []
    if ours is None:
        return []
    for name, distance in draft.located.edge_nodes.within(ground_point(here.spec.location), ours):
        if name == here.name or name not in draft.inventory.edge_nodes:
            continue
        reach = direct_reach_m(here.spec.interfaces, draft.inventory.edge_nodes[name].spec.interfaces)
        if reach is None:
            message = f"{name} has no interface that pairs with {here.name}'s"
            draft.reject(component, name, Check("NoDirectInterface", message))
        elif distance > reach:
            message = f"{name} is {distance:.0f} m from {here.name}, beyond their direct reach of {reach:.0f} m"
            draft.reject(component, name, Check("OutOfReach", message))
        else:
            found.append(name)
    return found


def _reaches(here: EdgeNode, node: EdgeNode) -> bool:
    if here.name == node.name:
        return True
    reach = direct_reach_m(here.spec.interfaces, node.spec.interfaces)
    return reach is not None and distance_m(ground_point(here.spec.location), ground_point(node.spec.location)) <= reach


# -- along the drone's way --


@dataclass(frozen=True, slots=True)
class AlongTheWay:
    """Edge nodes that can talk directly to a drone somewhere in the operation area: names, places, reaches."""

    drone: Drone
    area: OperationArea
    names: list[str]
    xy: np.ndarray[tuple[int, int], np.dtype[np.float64]]
    reach_m: np.ndarray[tuple[int], np.dtype[np.float64]]


def find_along(draft: Draft, component: Component, drone: Drone, area: OperationArea) -> AlongTheWay:
    """The candidates by place and interface; notes who is in the drone's range without a match, and who is just out."""
    ours = direct_range_m(drone.spec.interfaces)
    names: list[str] = []
    xy = np.empty((0, 2))
    if ours is not None:
        names, xy = draft.located.edge_nodes.near_area(area.frame, area.shape, ours)
    reaches = _Reaches(drone.spec.interfaces)
    found: list[int] = []
    reach_m: list[float] = []
    for i, name in enumerate(names):
        node = draft.inventory.edge_nodes.get(name)
        reach = reaches.to(node.spec.interfaces) if node is not None else None
        if node is not None and reach is None:
            message = f"{name} has no interface that pairs with {drone.name}'s"
            draft.reject(component, name, Check("NoDirectInterface", message))
        elif reach is not None:
            found.append(i)
            reach_m.append(reach)
    draft.consider(component, names, len(draft.located.edge_nodes))
    _note_far(draft, component, drone, area, set(names))
    return AlongTheWay(drone, area, [names[i] for i in found], xy[found], np.array(reach_m, dtype=np.float64))


def place_along(draft: Draft, component: Component, other: Component, along: AlongTheWay, hosts: HybridHosts) -> None:
    """Choose among the nodes along the way, and place the component on them."""
    there = np.array([name in hosts.nodes for name in along.names], dtype=bool)
    kept = np.array([draft.had(component, name) for name in along.names], dtype=bool)
    free = np.flatnonzero(~there)
    discs = np.column_stack((along.xy, along.reach_m))
    scene = CoverScene(
        samples=Samples(along.area.shape),
        names=[along.names[i] for i in free.tolist()],
        xy=along.xy[free],
        reach_m=along.reach_m[free],
        share=draft.settings.coverage_share,
        kept=frozenset(along.names[i] for i in np.flatnonzero(kept).tolist()),
        covered_by=discs[there & kept],
        newly_covered_by=discs[there & ~kept],
    )

    def fits(name: str) -> bool:
        check = draft.check_edge(draft.inventory.edge_nodes[name], component)
        if not check:
            draft.reject(component, name, check)
        return bool(check)

    for pick in (draft.settings.cover or greedy_cover)(scene, fits):
        hosts.nodes[pick.name] = None
        serves = Serves(component=other.name, node=along.drone.name)
        draft.place(component, "hybrid-drone", pick.name, serves=serves, coverage=round(pick.share, 6))
    _note_useless(draft, component, scene, hosts)


def _note_useless(draft: Draft, component: Component, scene: CoverScene, hosts: HybridHosts) -> None:
    """Note candidates whose own reach falls short of the area, though the drone's would not."""
    node, first, end = scene.samples.runs(scene.xy, scene.reach_m)
    useful = np.zeros(len(scene.names), dtype=bool)
    useful[node[end > first]] = True
    for i in np.flatnonzero(~useful).tolist():
        name = scene.names[i]
        if name not in hosts.nodes:
            message = f"{name} reaches {scene.reach_m[i]:.0f} m and covers nothing of the operation area"
            draft.reject(component, name, Check("NoCoverage", message))


def _note_far(draft: Draft, component: Component, drone: Drone, area: OperationArea, near: set[str]) -> None:
    """Note the nodes that are nearest to the middle of the area, but out of the drone's range anywhere in it."""
    lat, lon = area.frame.latlon(*(float(v) for v in area.shape.centroid.coords[0]))
    wanted = draft.settings.near_misses
    reaches = _Reaches(drone.spec.interfaces)
    closest = draft.located.edge_nodes.nearest(
        Point(lat=lat, lon=lon), wanted + min(len(near), wanted), within_m=draft.settings.near_miss_m
    )
    for name, _ in closest:
        node = draft.inventory.edge_nodes.get(name)
        if node is None or name in near:
            continue
        reach = reaches.to(node.spec.interfaces)
        check = Check("NoDirectInterface", f"{name} has no interface that pairs with {drone.name}'s")
        if reach is not None:
            check = Check("NoCoverage", f"{name} reaches {reach:.0f} m and covers nothing of the operation area")
        draft.reject(component, name, check, far=True)


class _Reaches:
    """Direct reaches from one node's interfaces; the many nodes of one make share their answer."""

    def __init__(self, ours: Sequence[Interface]) -> None:
        self._ours = ours
        self._known: dict[tuple[object, ...], float | None] = {}

    def to(self, theirs: Sequence[Interface]) -> float | None:
        """How far the nodes can be apart and still talk directly; None when no interfaces match."""
        found = direct_interface(theirs)
        key = (found.technology, found.range, found.pairing and found.pairing.mode) if found is not None else ()
        if key not in self._known:
            self._known[key] = direct_reach_m(self._ours, theirs)
        return self._known[key]
