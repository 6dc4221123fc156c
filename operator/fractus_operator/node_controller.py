"""Controllers of nodes: location labels of Nodes, and the NodeGrants object and account of each node."""

from __future__ import annotations

import asyncio
import logging

from fractus_core.api import Drone, EdgeNode
from fractus_core.api.geometry import Point
from fractus_core.api.grants import NODE_GRANTS_NAMESPACE, pack_oldest

from fractus_operator import kinds
from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import NODE, Body, Key, Kind
from fractus_operator.labels import (
    DEPOT_LABEL,
    GEOHASH_LABEL,
    GUARDED_LABEL,
    INTERFACE_LABEL,
    is_location_label,
)
from fractus_operator.node_objects import ACCOUNT_KINDS, account_object, header
from fractus_operator.resources.grant import reported_status
from fractus_operator.store import Conflict, ContentType, Invalid, NotFound, Store
from fractus_operator.work_queue import WorkQueue

log = logging.getLogger(__name__)

_ALPHABET = "0123456789bcdefghjkmnpqrstuvwxyz"
GEOHASH_LENGTH = 6
"""Number of characters of a node's geohash, for a cell of about 1.2 km by 0.6 km."""
_WORKERS = 4
"""Number of nodes whose Grants are written at the same time. An Application has Grants on many nodes."""


def geohash(lat: float, lon: float, length: int = GEOHASH_LENGTH) -> str:
    """Return the geohash cell of a position (WGS 84 degrees)."""
    south = -90.0
    north = 90.0
    west = -180.0
    east = 180.0
    bits = 0
    for i in range(length * 5):
        bits <<= 1
        if i % 2 == 0:
            middle = (west + east) / 2
            if lon >= middle:
                bits |= 1
                west = middle
            else:
                east = middle
        else:
            middle = (south + north) / 2
            if lat >= middle:
                bits |= 1
                south = middle
            else:
                north = middle
    return "".join(_ALPHABET[bits >> 5 * i & 31] for i in reversed(range(length)))


def location_labels(node: Drone | EdgeNode, home: Point | None = None) -> dict[str, str]:
    """Return the labels of the Node of a drone or edge node. A drone has the geohash of its last reported position.

    Args:
        node: The drone or edge node.
        home: Position of the depot, for a drone that reported no position and has no home.
    """
    labels = {f"{INTERFACE_LABEL}{i.technology.lower()}": "true" for i in node.spec.interfaces}
    position: Point | None
    if isinstance(node, Drone):
        position = (node.status.position if node.status is not None else None) or node.spec.home or home
        if node.spec.depot is not None:
            labels[DEPOT_LABEL] = node.spec.depot
    else:
        position = node.spec.location
    if position is not None:
        labels[GEOHASH_LABEL] = geohash(position.lat, position.lon)
    return labels


class NodeLabelController:
    """Updates the location labels of Nodes, because agents may not write Nodes."""

    def __init__(self, store: Store, cache: ClusterCache) -> None:
        self._store = store
        self._cache = cache

    async def reconcile(self, key: Key) -> None:
        """Set the labels of one Node from its Drone or EdgeNode and its taint, and remove stale labels."""
        name = key[1]
        host = self._cache.hosts.get(key)
        if host is None:
            return
        node = self._cache.drones.get(key) or self._cache.edge_nodes.get(key)
        home = None
        if isinstance(node, Drone) and node.spec.depot is not None:
            depot = self._cache.depots.get(("", node.spec.depot))
            home = depot.spec.location if depot is not None else None
        desired = location_labels(node, home) if node is not None else {}
        if host.guarded:
            desired[GUARDED_LABEL] = "true"
        present = {label: value for label, value in host.labels.items() if is_location_label(label)}
        if present == desired:
            return
        stale = dict.fromkeys(present.keys() - desired.keys())
        try:
            await self._store.set_labels(NODE, name, {**desired, **stale})
        except NotFound:
            return


class NodeGrantsController:
    """Maintains the objects of each node in the namespace of nodes, and the status of Grants that its agent reports.

    Nodes are the Drones, the EdgeNodes, and all nodes that a Grant names. An agent does not treat a missing NodeGrants object as
    a revocation. So a node without Grants has an empty object. The object stays while the Node exists, because an offline node
    must still receive the empty list.

    Args:
        store: The API server.
        cache: The cluster.
    """

    def __init__(self, store: Store, cache: ClusterCache) -> None:
        self._store = store
        self._cache = cache
        # Separate queues, so that the Grants of a drone in flight do not wait for the accounts of thousands of nodes.
        self._accounts = WorkQueue("node account", self._reconcile_account, after=cache.synced)
        self._grants = WorkQueue("node grants", self._reconcile_grants, after=cache.synced, workers=_WORKERS)
        self._reports = WorkQueue("grant report", self._reconcile_reports, after=cache.synced, workers=_WORKERS)
        cache.node_objects.add_listeners(
            accounts=self._check_account, grants=self._grants_changed, reports=self._reports.add
        )
        for kind in (kinds.DRONE, kinds.EDGE_NODE, kinds.NODE):
            cache.add_listener(kind, self._node_changed)

    def work_queues(self) -> list[WorkQueue]:
        """Return the queues. Run each one in its own task."""
        return [self._accounts, self._grants, self._reports]

    def _node_changed(self, key: Key) -> None:
        """Check the account of a node. Frequent reports of a node do not shorten the pause after a failure."""
        if key not in self._accounts.failures:
            self._check_account(key)

    def _check_account(self, key: Key) -> None:
        """Queue a node whose account is not in the desired state."""
        node = key[1]
        objects = self._cache.node_objects
        if self._is_node(node):
            differs = not objects.is_complete(node)
        else:
            differs = bool(objects.account_of(node)) or objects.node_grants_of(node) is not None
        if differs:
            self._accounts.add(key)

    def _grants_changed(self, key: Key) -> None:
        self._grants.add(key)
        self._check_account(key)

    def _is_node(self, name: str) -> bool:
        cache = self._cache
        if ("", name) in cache.drones or ("", name) in cache.edge_nodes or cache.node_objects.grants_of(name):
            return True
        return ("", name) in cache.hosts and cache.node_objects.node_grants_of(name) is not None

    async def _reconcile_account(self, key: Key) -> None:
        node = key[1]
        account = self._cache.node_objects.account_of(node)
        if not self._is_node(node):
            known = self._cache.node_objects.node_grants_of(node)
            if known is not None and known.count:
                # The agent must first receive an empty list of Grants.
                self._grants.add(key)
                return
            for kind in reversed(ACCOUNT_KINDS):
                if kind in account:
                    await self._delete(kind, node)
            if known is not None:
                log.info("node controller: objects of a deleted node removed (node=%s)", node)
                await self._delete(kinds.NODE_GRANTS, node)
            return
        for kind in ACCOUNT_KINDS:
            if account.get(kind) is False:
                log.warning("node controller: replacing a modified object (kind=%s node=%s)", kind.name, node)
                await self._delete(kind, node)
            if not account.get(kind):
                created = await self._store.create(kind, account_object(kind, node))
                self._cache.node_objects.accounts[kind].record_write((NODE_GRANTS_NAMESPACE, node), created)
        if self._cache.node_objects.node_grants_of(node) is None:
            self._grants.add(key)

    async def _reconcile_grants(self, key: Key) -> None:
        node = key[1]
        if not self._is_node(node) and self._cache.node_objects.node_grants_of(node) is None:
            return
        grants = self._cache.node_objects.grants_of(node)
        # Reading in a thread is safe, because the cache replaces objects and never changes them.
        packed, count = await asyncio.to_thread(pack_oldest, grants)
        known = self._cache.node_objects.node_grants_of(node)
        if known is not None and known.contains(packed, count):
            return
        if count < len(grants):
            log.error(
                "node controller: NodeGrants object is full, newest Grants omitted (node=%s grants=%d omitted=%d)",
                node,
                len(grants),
                len(grants) - count,
            )
        object_key = (NODE_GRANTS_NAMESPACE, node)
        spec = {"packed": packed, "count": count}
        if known is None:
            written = await self._store.create(kinds.NODE_GRANTS, header(kinds.NODE_GRANTS, node) | {"spec": spec})
        else:
            changes = {"metadata": {"uid": known.uid}, "spec": spec}
            written = await self._store.patch(kinds.NODE_GRANTS, object_key, changes, ContentType.MERGE)
        self._cache.node_objects.known.record_write(object_key, written)

    async def _reconcile_reports(self, key: Key) -> None:
        known = self._cache.node_objects.node_grants_of(key[1])
        # An agent may report only Grants of its node.
        grants = {body["metadata"].get("uid"): body for body in self._cache.node_objects.grants_of(key[1])}
        for report in known.reports if known is not None else ():
            grant = grants.get(report.uid)
            status = reported_status(grant, report) if grant is not None else None
            if grant is None or status is None:
                continue
            grant_key = ("", grant["metadata"]["name"])
            # A merge patch of the status ignores metadata.uid.
            changes: list[Body] = [
                {"op": "test", "path": "/metadata/uid", "value": report.uid},
                {"op": "add", "path": "/status", "value": {**(grant.get("status") or {}), **status}},
            ]
            try:
                written = await self._store.patch(
                    kinds.GRANT, grant_key, changes, ContentType.JSON_PATCH, subresource="status"
                )
            except (Conflict, Invalid, NotFound) as error:
                # The Grant was deleted, and possibly replaced by a Grant of the same name.
                log.info("node controller: report of a deleted Grant ignored (grant=%s error=%s)", grant_key[1], error)
                continue
            self._cache.children[kinds.GRANT].record_write(grant_key, written)

    async def _delete(self, kind: Kind, node: str) -> None:
        await self._store.delete(kind, (NODE_GRANTS_NAMESPACE, node))
