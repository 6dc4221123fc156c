"""The pods of a mission that is over: stopped at once, so that their nodes are free, and kept for a time for their logs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from datetime import datetime, timedelta

from fractus_core.api import API_VERSION, Application
from fractus_core.api.applications import ApplicationSpec

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, Kind, key_of
from fractus_operator.cluster.labels import (
    APPLICATION_LABEL,
    FINISHED_FORMAT,
    FINISHED_LABEL,
    MANAGED_SELECTOR,
    label_value,
)
from fractus_operator.cluster.pods import FINISHED_DEADLINE_S, PodView, read_pod
from fractus_operator.cluster.reading import Submitted
from fractus_operator.cluster.store import ContentType, NotFound, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.children import Children

_DEFAULT_TTL_S: int = ApplicationSpec.model_fields["ttl_after_finished"].default


_CLOCKS_DIFFER = timedelta(minutes=2)
"""How far ahead the clock of an operator that acted before may have been."""


class FinishedPods:
    """Keeps the pods of missions that are over, as a Job keeps its own: stopped, with their logs, until they are removed.

    A Deployment replaces each pod that ends, so it goes first, and its ReplicaSet, both without what they own. A deadline that
    has passed then has the kubelet stop the pod, which takes nothing of its node any more.
    """

    def __init__(self, store: Store, live: LiveInventory, children: Children, clock: Callable[[], datetime]) -> None:
        self._store = store
        self._live = live
        self._children = children
        self._clock = clock

    async def stop(self, submitted: Submitted) -> bool:
        """Stop the pods of an application and let nothing start them again; True if there was anything to do.

        Raises:
            KubeError: the API server refuses a change, or cannot be reached.
        """
        key = submitted.key
        if _ttl(submitted) == timedelta(0):
            return await self._children.remove(key, kinds.DEPLOYMENT) | await self.remove(key)
        removed = await self._children.remove(key, kinds.DEPLOYMENT, orphan=True)
        pods = _present(self._live.pods_of(key))
        if removed or pods:
            await self._remove_replica_sets(key)
        for pod in pods:
            if pod.node is None:
                await self._store.delete(kinds.POD, (pod.namespace, pod.name))
            else:
                await self._stop_one(pod, submitted)
        return removed or bool(pods)

    async def expire(self, submitted: Submitted) -> float:
        """Remove the pods of an application that were kept long enough.

        Returns:
            In how many seconds the next one is; infinite where none is kept.

        Raises:
            KubeError: the API server refuses it, or cannot be reached.
        """
        next_s = float("inf")
        now = self._clock()
        kept_since = now - _ttl(submitted)
        for pod in _present(self._live.pods_of(submitted.key, kept=True)):
            assert pod.finished_at is not None
            left_s = (pod.finished_at - kept_since).total_seconds()
            # Who may write the label of a pod does not keep it longer by a time that has not come.
            if left_s <= 0 or pod.finished_at > now + _CLOCKS_DIFFER:
                await self._store.delete(kinds.POD, (pod.namespace, pod.name))
            else:
                next_s = min(next_s, left_s)
        return next_s

    async def remove(self, key: Key) -> bool:
        """Remove all pods of an application without Deployments, kept or not; True if there were any.

        Raises:
            KubeError: the API server refuses it, or cannot be reached.
        """
        running = _present(self._live.pods_of(key))
        if running:
            # An operator that was killed while it stopped them has left what would start them again.
            await self._remove_replica_sets(key)
        pods = [*running, *_present(self._live.pods_of(key, kept=True))]
        for pod in pods:
            await self._store.delete(kinds.POD, (pod.namespace, pod.name))
        return bool(pods)

    async def tear_down(self, key: Key) -> None:
        """Remove all that was made for an application that is being deleted: also pods that nothing owns any more.

        Who deletes an application as soon as its mission is over interrupts `stop`. What that has taken from its owners, and
        given no other, no garbage collector finds, and the watch may not show it yet: so the API server is asked.

        Args:
            key: The application.

        Raises:
            KubeError: the API server refuses a delete, or cannot be reached.
        """
        submitted = self._live.applications.get(key)
        interrupted = submitted is None or submitted.settled_generation is not None
        # One that another's finalizer keeps takes nothing with it: its answer says so, whatever labels it has by now.
        owners = await self._children.remove_at_once(key, kinds.DEPLOYMENT)
        await self._children.remove(key, *(kind for kind in reversed(kinds.CHILDREN) if kind is not kinds.DEPLOYMENT))
        collected: set[str] = set()
        for body in await made_for(self._store, kinds.REPLICA_SET, key):
            if not interrupted and owned_by(owners, body) and "deletionTimestamp" not in body["metadata"]:
                collected.add(body["metadata"]["uid"])
            else:
                await self._store.delete(kinds.REPLICA_SET, key_of(body), body["metadata"]["uid"])
        for body in await made_for(self._store, kinds.POD, key):
            # Also those that were kept, which the application owns: the garbage collector comes to them late, or not at all.
            if _present([read_pod(body)]) and not owned_by(collected, body):
                await self._store.delete(kinds.POD, key_of(body), body["metadata"]["uid"])

    async def _remove_replica_sets(self, key: Key) -> None:
        for body in await made_for(self._store, kinds.REPLICA_SET, key):
            await self._store.delete(kinds.REPLICA_SET, key_of(body), body["metadata"]["uid"], orphan=True)

    async def _stop_one(self, pod: PodView, submitted: Submitted) -> None:
        owner = {"apiVersion": API_VERSION, "kind": Application.KIND, "name": submitted.key[1], "uid": submitted.uid}
        changes: Body = {
            "metadata": {
                # Without the hash, no ReplicaSet of a later mission takes it for its own.
                "labels": {FINISHED_LABEL: self._clock().strftime(FINISHED_FORMAT), "pod-template-hash": None},
                "ownerReferences": [owner],
            },
            "spec": {"activeDeadlineSeconds": FINISHED_DEADLINE_S},
        }
        try:
            await self._store.patch(kinds.POD, (pod.namespace, pod.name), changes, ContentType.MERGE)
        except NotFound:
            return


def _ttl(submitted: Submitted) -> timedelta:
    application = submitted.application
    ttl_s = application.spec.ttl_after_finished if application is not None else _DEFAULT_TTL_S
    return timedelta(seconds=ttl_s)


def _present(pods: Iterable[PodView]) -> list[PodView]:
    return [pod for pod in pods if pod.ours and not pod.terminating]


async def made_for(store: Store, kind: Kind, key: Key) -> list[Body]:
    """What there is of a kind for an application, as the API server has it."""
    namespace, name = key
    selectors = {"labelSelector": f"{MANAGED_SELECTOR},{APPLICATION_LABEL}={label_value(name)}"}
    return (await store.list_whole(kind, namespace=namespace, selectors=selectors)).items


def owned_by(uids: Collection[str], body: Body) -> bool:
    """Whether one of some objects owns another."""
    return any(owner["uid"] in uids for owner in body["metadata"].get("ownerReferences") or ())
