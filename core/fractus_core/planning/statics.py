"""Which edge nodes host static components (thesis Algorithms 7 and 9)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from fractus_core.api.components import Component, EdgeLocation
from fractus_core.planning.candidates import Check
from fractus_core.planning.draft import Draft
from fractus_core.planning.index import Near


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
