"""Removes what an Application that is gone has left: cluster-scoped objects, which it owned not, and pods that lost their owners."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from fractus_core.api.grants import ApplicationReference
from pydantic import ValidationError

from fractus_operator.cluster.kinds import APPLICATION, DEPLOYMENT, POD, REPLICA_SET, Body, Key, Kind, key_of
from fractus_operator.cluster.labels import labelled
from fractus_operator.cluster.pods import PodView, read_pod
from fractus_operator.cluster.store import NotFound, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.finished_pods import made_for, owned_by

logger = logging.getLogger(__name__)

LOST_PODS_PERIOD_S = 30.0
"""How often pods are looked through, and how long the garbage collector has at least."""


class Orphans:
    """Watches over objects of a kind that nothing owns: they are cluster-scoped, their Applications are not.

    They are left where an Application was removed without a teardown (its finalizer was taken off by hand).
    """

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


class LostPods:
    """Removes pods of Applications that are gone, once the garbage collector had its time and did not come to them.

    A teardown lists what there is, but a request that had no answer may be carried out after it, and the controllers of Kubernetes
    replace what their caches still show. What such a request takes from its owner meanwhile, to be kept, no one else removes.
    """

    def __init__(self, store: Store, live: LiveInventory) -> None:
        self._store = store
        self._live = live
        self._found: frozenset[Key] = frozenset()

    async def step(self) -> None:
        """Look once; what is there the second time is removed.

        Raises:
            KubeError: the API server refused something, or cannot be reached.
        """
        await self._live.synced()
        known = {labelled(key) for key, _ in self._live.applications.items()}
        found = frozenset(self._owners()) - known
        lasting, self._found = sorted(found & self._found), found
        for key in lasting:
            # The watch of Applications may be behind that of pods: ask before destroying.
            present = (await self._store.list_whole(APPLICATION, namespace=key[0])).items
            if all(labelled(key_of(body)) != key for body in present):
                await self._remove(key)

    def _owners(self) -> Iterator[Key]:
        """The applications of all pods, as their labels say."""
        for pod in self._live.pods.values():
            if pod.application is not None and _is_made(pod):
                yield pod.namespace, pod.application

    async def _remove(self, key: Key) -> None:
        logger.info("orphans: removing pods without Application (application=%s/%s)", *key)
        kept: set[str] = set()
        for body in await made_for(self._store, DEPLOYMENT, key):
            # One without an owner is a copy that someone made.
            if body["metadata"].get("ownerReferences"):
                await self._store.delete(DEPLOYMENT, key_of(body), body["metadata"]["uid"])
            else:
                kept.add(body["metadata"]["uid"])
        runs: set[str] = set()
        for body in await made_for(self._store, REPLICA_SET, key):
            if owned_by(kept, body):
                runs.add(body["metadata"]["uid"])
            else:
                await self._store.delete(REPLICA_SET, key_of(body), body["metadata"]["uid"])
        for body in await made_for(self._store, POD, key):
            if _is_made(read_pod(body)) and not owned_by(runs, body):
                await self._store.delete(POD, key_of(body), body["metadata"]["uid"])


def _is_made(pod: PodView) -> bool:
    return pod.ours and not pod.terminating


def _owner(body: Body) -> ApplicationReference | None:
    try:
        return ApplicationReference.model_validate(body["spec"].get("application"))
    except ValidationError:
        return None
