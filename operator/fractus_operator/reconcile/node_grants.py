"""Each node's Grants in one object, which only the node's own account may read; and what its agent reports there."""

from __future__ import annotations

import asyncio
import logging

from fractus_core.api.grants import NODE_GRANTS_NAMESPACE, pack_oldest

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, Kind
from fractus_operator.cluster.node_accounts import ACCOUNT_KINDS, account_object, header
from fractus_operator.cluster.store import Conflict, ContentType, Invalid, NotFound, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.grant_reports import reported_status
from fractus_operator.reconcile.worklist import Worklist

logger = logging.getLogger(__name__)

_AT_ONCE = 4
"""Nodes whose Grants are written at a time: an application has some on many nodes, and each node waits for its own."""


class NodeGrantsKeeper:
    """Keeps what each node has in the namespace of nodes.

    Nodes are the Drones and EdgeNodes, and what a Grant names. A node's agent takes an object that is not there for no
    revocation: one without Grants is one that says so, and stays for as long as the Node is there, which may be offline.

    Args:
        store: The API server.
        live: What is known of the cluster.
    """

    def __init__(self, store: Store, live: LiveInventory) -> None:
        self._store = store
        self._live = live
        # Apart: the Grants of a node that flies do not wait for the accounts of thousands.
        self._accounts = Worklist("node account", self._bring_account, after=live.synced)
        self._grants = Worklist("node grants", self._bring_grants, after=live.synced, at_once=_AT_ONCE)
        self._reports = Worklist("grant report", self._bring_reports, after=live.synced, at_once=_AT_ONCE)
        live.node_objects.listen(accounts=self._look, grants=self._granted, reports=self._reports.add)
        for kind in (kinds.DRONE, kinds.EDGE_NODE, kinds.NODE):
            live.listen(kind, self._seen)

    def worklists(self) -> list[Worklist]:
        """What is to be run."""
        return [self._accounts, self._grants, self._reports]

    def _seen(self, key: Key) -> None:
        """Look at a node that reports, as they do all the time: what was refused is tried again after its delay."""
        if key not in self._accounts.failures:
            self._look(key)

    def _look(self, key: Key) -> None:
        """Reconcile a node's account where it is not as it should be."""
        wanted, node = self._is_node(key[1]), key[1]
        objects = self._live.node_objects
        if not objects.is_complete(node) if wanted else objects.account_of(node) or objects.known_of(node):
            self._accounts.add(key)

    def _granted(self, key: Key) -> None:
        self._grants.add(key)
        self._look(key)

    def _is_node(self, name: str) -> bool:
        live = self._live
        there = ("", name) in live.drones or ("", name) in live.edge_nodes or bool(live.node_objects.grants_of(name))
        return there or (("", name) in live.hosts and live.node_objects.known_of(name) is not None)

    async def _bring_account(self, key: Key) -> None:
        node = key[1]
        account = self._live.node_objects.account_of(node)
        if not self._is_node(node):
            known = self._live.node_objects.known_of(node)
            if known is not None and known.count:
                # Its agent is told first that nothing is granted any more.
                self._grants.add(key)
                return
            for kind in reversed(ACCOUNT_KINDS):
                if kind in account:
                    await self._remove(kind, node)
            if known is not None:
                logger.info("node grants: removing what a node had that is gone (node=%s)", node)
                await self._remove(kinds.NODE_GRANTS, node)
            return
        for kind in ACCOUNT_KINDS:
            if account.get(kind) is False:
                logger.warning("node grants: %s was changed and is made again (node=%s)", kind.name, node)
                await self._remove(kind, node)
            if not account.get(kind):
                made = await self._store.create(kind, account_object(kind, node))
                self._live.node_objects.accounts[kind].note((NODE_GRANTS_NAMESPACE, node), made)
        if self._live.node_objects.known_of(node) is None:
            self._grants.add(key)

    async def _bring_grants(self, key: Key) -> None:
        node = key[1]
        if not self._is_node(node) and self._live.node_objects.known_of(node) is None:
            return
        grants = self._live.node_objects.grants_of(node)
        # Bodies are replaced, never changed, so that a thread may read them.
        packed, count = await asyncio.to_thread(pack_oldest, grants)
        known = self._live.node_objects.known_of(node)
        if known is not None and known.carries(packed, count):
            return
        if count < len(grants):
            logger.error(
                "node grants: one object takes no more; the newest are not granted (node=%s grants=%d left_out=%d)",
                node,
                len(grants),
                len(grants) - count,
            )
        place, spec = (NODE_GRANTS_NAMESPACE, node), {"packed": packed, "count": count}
        if known is None:
            written = await self._store.create(kinds.NODE_GRANTS, header(kinds.NODE_GRANTS, node) | {"spec": spec})
        else:
            changes = {"metadata": {"uid": known.uid}, "spec": spec}
            written = await self._store.patch(kinds.NODE_GRANTS, place, changes, ContentType.MERGE)
        self._live.node_objects.known.note(place, written)

    async def _bring_reports(self, key: Key) -> None:
        known = self._live.node_objects.known_of(key[1])
        # Of its own Grants only: an agent says nothing of those of another node.
        grants = {body["metadata"].get("uid"): body for body in self._live.node_objects.grants_of(key[1])}
        for report in known.reports if known is not None else ():
            grant = grants.get(report.uid)
            status = reported_status(grant, report) if grant is not None else None
            if grant is None or status is None:
                continue
            name = ("", grant["metadata"]["name"])
            # A merge would not look at the uid: of a status the API server takes no other field.
            changes: list[Body] = [
                {"op": "test", "path": "/metadata/uid", "value": report.uid},
                {"op": "add", "path": "/status", "value": {**(grant.get("status") or {}), **status}},
            ]
            try:
                written = await self._store.patch(
                    kinds.GRANT, name, changes, ContentType.JSON_PATCH, subresource="status"
                )
            except (Conflict, Invalid, NotFound) as error:
                # It is gone, or another has its name by now, of which nothing was reported yet.
                logger.info("node grants: a report is of no Grant any more (grant=%s): %s", name[1], error)
                continue
            self._live.children[kinds.GRANT].note(name, written)

    async def _remove(self, kind: Kind, node: str) -> None:
        await self._store.delete(kind, (NODE_GRANTS_NAMESPACE, node))
