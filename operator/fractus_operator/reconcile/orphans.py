"""Removes Grants and DirectLinks whose Application was removed without a teardown (its finalizer was taken off by hand)."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from fractus_core.api.plans import ApplicationReference
from pydantic import ValidationError

from fractus_operator.cluster.kinds import APPLICATION, Body, Key, Kind
from fractus_operator.cluster.store import NotFound, Store
from fractus_operator.inventory.live import LiveInventory

logger = logging.getLogger(__name__)


class Orphans:
    """Watches over objects of a kind that nothing owns: they are cluster-scoped, their Applications are not."""

    def __init__(self, store: Store, live: LiveInventory, kind: Kind) -> None:
        self._store = store
        self._live = live
        self._kind = kind

    def of(self, application: Key) -> Iterator[Key]:
        """What was made for an application."""
        for key, body in self._live.children[self._kind].items():
            owner = _owner(body)
            if owner is not None and (owner.namespace, owner.name) == application:
                yield key

    async def reconcile(self, key: Key) -> None:
        """Delete an object whose Application does not exist."""
        body = self._live.children[self._kind].get(key)
        if body is None:
            return
        owner = _owner(body)
        if owner is None:
            logger.warning("orphans: %s names no application (name=%s)", self._kind.name, key[1])
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
            "orphans: removing %s without Application (name=%s application=%s/%s)",
            self._kind.name,
            key[1],
            owner.namespace,
            owner.name,
        )
        await self._store.delete(self._kind, key, body["metadata"]["uid"])


def _owner(body: Body) -> ApplicationReference | None:
    try:
        return ApplicationReference.model_validate(body["spec"].get("application"))
    except ValidationError:
        return None
