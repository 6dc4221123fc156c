"""Indexes of where the nodes of an inventory are, kept current node by node, so that a plan looks at few of many."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from fractus_core.api.geometry import Point
from fractus_core.api.nodes import Depot, Drone, EdgeNode
from fractus_core.geo import ground_point
from fractus_core.planning.index import SpatialIndex


class NodeLocations:
    """Indexes of an inventory: edge nodes by place, drones by depot and by where they stand, which hosts are cloud.

    The operator, which keeps an inventory for long, keeps one of these beside it and tells it of every node that
    appears, moves or goes, in microseconds; a plan made from manifests builds its own.
    """

    def __init__(self) -> None:
        self.edge_nodes = SpatialIndex()
        self.stands = SpatialIndex()
        self.depots = SpatialIndex()
        self.homeless: set[str] = set()
        self.cloud: set[str] = set()
        self.widest_depot_m = 0.0
        self._kept_in: dict[str, set[str]] = {}
        self._drones: dict[str, tuple[str | None, Point | None]] = {}

    @classmethod
    def of(
        cls,
        *,
        edge_nodes: Mapping[str, EdgeNode],
        drones: Mapping[str, Drone],
        depots: Mapping[str, Depot],
        cloud: Iterable[str],
    ) -> NodeLocations:
        """The indexes of whole collections, faster than one by one."""
        known = cls()
        known.edge_nodes = SpatialIndex.of(
            (n.name, n.spec.location.lat, n.spec.location.lon) for n in edge_nodes.values()
        )
        for depot in depots.values():
            known._note_depot(depot)
        stands = []
        for drone in drones.values():
            stand = known._note_drone(drone)
            if stand is not None:
                stands.append((drone.name, stand.lat, stand.lon))
        known.stands = SpatialIndex.of(stands)
        known.cloud = set(cloud)
        return known

    # -- changing --

    def upsert_edge_node(self, node: EdgeNode) -> None:
        """Note where an edge node is."""
        self.edge_nodes.upsert(node.name, node.spec.location.lat, node.spec.location.lon)

    def remove_edge_node(self, name: str) -> None:
        """Forget an edge node."""
        self.edge_nodes.remove(name)

    def upsert_drone(self, drone: Drone) -> None:
        """Note where a drone is kept."""
        self._forget_drone(drone.name)
        self._place(drone.name, self._note_drone(drone))

    def remove_drone(self, name: str) -> None:
        """Forget a drone."""
        self._forget_drone(name)
        self._drones.pop(name, None)
        self.stands.remove(name)
        self.homeless.discard(name)

    def upsert_depot(self, depot: Depot) -> None:
        """Note where a depot is; drones without a home of their own stand there."""
        self._note_depot(depot)
        self._place_all(depot.name)

    def remove_depot(self, name: str) -> None:
        """Forget a depot."""
        self.depots.remove(name)
        self._place_all(name)

    def upsert_host(self, name: str, is_cloud: bool) -> None:
        """Note whether a Kubernetes Node takes the cloud's pods."""
        if is_cloud:
            self.cloud.add(name)
        else:
            self.cloud.discard(name)

    def remove_host(self, name: str) -> None:
        """Forget a Kubernetes Node."""
        self.cloud.discard(name)

    # -- asking --

    def kept_in(self, depot: str) -> frozenset[str]:
        """The drones whose spec names a depot."""
        return frozenset(self._kept_in.get(depot, ()))

    def _note_depot(self, depot: Depot) -> None:
        self.depots.upsert(depot.name, depot.spec.location.lat, depot.spec.location.lon)
        self.widest_depot_m = max(self.widest_depot_m, depot.spec.radius)

    def _note_drone(self, drone: Drone) -> Point | None:
        home = ground_point(drone.spec.home) if drone.spec.home is not None else None
        self._drones[drone.name] = (drone.spec.depot, home)
        if drone.spec.depot is not None:
            self._kept_in.setdefault(drone.spec.depot, set()).add(drone.name)
        stand = self._stand(drone.name)
        if stand is None:
            self.homeless.add(drone.name)
        return stand

    def _forget_drone(self, name: str) -> None:
        depot, _ = self._drones.get(name, (None, None))
        if depot is not None:
            self._kept_in[depot].discard(name)

    def _place_all(self, depot: str) -> None:
        for name in self._kept_in.get(depot, ()):
            self._place(name, self._stand(name))

    def _place(self, name: str, stand: Point | None) -> None:
        if stand is None:
            self.stands.remove(name)
            self.homeless.add(name)
        else:
            self.stands.upsert(name, stand.lat, stand.lon)
            self.homeless.discard(name)

    def _stand(self, name: str) -> Point | None:
        depot, home = self._drones[name]
        if home is not None:
            return home
        return self.depots.position(depot) if depot is not None and depot in self.depots else None
