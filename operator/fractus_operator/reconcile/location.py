"""Location labels of Nodes: where a node is kept, roughly where it is, and how it can be reached directly."""

from __future__ import annotations

import logging

from fractus_core.api import Drone, EdgeNode
from fractus_core.api.geometry import Point

from fractus_operator.cluster.kinds import NODE, Key
from fractus_operator.cluster.labels import (
    DEPOT_LABEL,
    GEOHASH_LABEL,
    GUARDED_LABEL,
    INTERFACE_LABEL,
    is_location_label,
)
from fractus_operator.cluster.store import NotFound, Store
from fractus_operator.inventory.live import LiveInventory

logger = logging.getLogger(__name__)

_ALPHABET = "0123456789bcdefghjkmnpqrstuvwxyz"
GEOHASH_LENGTH = 6
"""Characters of a node's geohash: a cell of about 1.2 km by 0.6 km."""


def geohash(lat: float, lon: float, length: int = GEOHASH_LENGTH) -> str:
    """The geohash cell of a place (WGS 84 degrees)."""
    south, north, west, east = -90.0, 90.0, -180.0, 180.0
    bits = 0
    for i in range(length * 5):
        bits <<= 1
        if i % 2 == 0:
            middle = (west + east) / 2
            if lon >= middle:
                bits, west = bits | 1, middle
            else:
                east = middle
        else:
            middle = (south + north) / 2
            if lat >= middle:
                bits, south = bits | 1, middle
            else:
                north = middle
    return "".join(_ALPHABET[bits >> 5 * i & 31] for i in reversed(range(length)))


def location_labels(node: Drone | EdgeNode, home: Point | None = None) -> dict[str, str]:
    """The labels of the Node behind a drone or edge node.

    A drone in the air has the cell it was last seen in.

    Args:
        node: The drone or edge node.
        home: Where a drone stands that has reported no position and has no home of its own.
    """
    labels = {f"{INTERFACE_LABEL}{i.technology.lower()}": "true" for i in node.spec.interfaces}
    place: Point | None
    if isinstance(node, Drone):
        place = (node.status.position if node.status is not None else None) or node.spec.home or home
        if node.spec.depot is not None:
            labels[DEPOT_LABEL] = node.spec.depot
    else:
        place = node.spec.location
    if place is not None:
        labels[GEOHASH_LABEL] = geohash(place.lat, place.lon)
    return labels


class Locations:
    """Keeps the location labels of Nodes current; agents may not write Nodes."""

    def __init__(self, store: Store, live: LiveInventory) -> None:
        self._store = store
        self._live = live

    async def reconcile(self, key: Key) -> None:
        """Label one Node as its Drone or EdgeNode and its taint say; with none, take these labels away."""
        name = key[1]
        host = self._live.hosts.get(key)
        if host is None:
            return
        node = self._live.drones.get(key) or self._live.edge_nodes.get(key)
        home = None
        if isinstance(node, Drone) and node.spec.depot is not None:
            depot = self._live.depots.get(("", node.spec.depot))
            home = depot.spec.location if depot is not None else None
        wanted = location_labels(node, home) if node is not None else {}
        if host.guarded:
            wanted[GUARDED_LABEL] = "true"
        present = {label: value for label, value in host.labels.items() if is_location_label(label)}
        if present == wanted:
            return
        stale = dict.fromkeys(present.keys() - wanted.keys())
        try:
            await self._store.label(NODE, name, {**wanted, **stale})
        except NotFound:
            return
