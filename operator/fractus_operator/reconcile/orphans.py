"""Removes Grants whose Application was removed without a teardown (its finalizer was taken off by hand)."""

from __future__ import annotations

import logging

from fractus_core.api import Grant, InvalidObject

from fractus_operator.cluster.kinds import APPLICATION, GRANT, Key
from fractus_operator.cluster.store import NotFound, Store
from fractus_operator.inventory.live import LiveInventory

logger = logging.getLogger(__name__)


class Orphans:
    """Watches over Grants, which nothing owns: they are cluster-scoped, their Applications are not."""

    def __init__(self, store: Store, live: LiveInventory) -> None:
        self._store = store
        self._live = live

    async def reconcile(self, key: Key) -> None:
        """Delete a Grant whose Application does not exist."""
        body = self._live.children[GRANT].get(key)
        if body is None:
            return
        try:
            owner = Grant.from_body(body).spec.application
        except InvalidObject as error:
            logger.warning("orphans: Grant cannot be read (grant=%s): %s", key[1], error)
            return
        submitted = self._live.applications.get((owner.namespace, owner.name))
        if submitted is not None and submitted.metadata.uid == owner.uid:
            return
        try:
            # The watch of Applications may be behind that of Grants: ask before destroying.
            current = await self._store.get(APPLICATION, owner.name, owner.namespace)
            if current["metadata"]["uid"] == owner.uid:
                return
        except NotFound:
            pass
        logger.info(
            "orphans: removing Grant without Application (grant=%s application=%s/%s)",
            key[1],
            owner.namespace,
            owner.name,
        )
        await self._store.delete(GRANT, key, body["metadata"]["uid"])
