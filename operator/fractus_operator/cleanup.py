"""Cleanup after missions and Applications: stopped pods, orphaned cluster-scoped objects, and orphaned pods."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Iterator
from datetime import datetime, timedelta

from fractus_core.api import API_VERSION, Application
from fractus_core.api.applications import ApplicationSpec
from fractus_core.api.grants import ApplicationReference
from pydantic import ValidationError

from fractus_operator import kinds
from fractus_operator.cache import ClusterCache
from fractus_operator.child_objects import ChildObjects
from fractus_operator.kinds import APPLICATION, DEPLOYMENT, POD, REPLICA_SET, Body, Key, Kind, key_of
from fractus_operator.labels import (
    APPLICATION_LABEL,
    FINISHED_FORMAT,
    FINISHED_LABEL,
    INSTANCE_LABEL,
    MANAGED_SELECTOR,
    label_key,
    label_value,
)
from fractus_operator.parsing import Submitted
from fractus_operator.pods import FINISHED_DEADLINE_S, PodView, parse_pod
from fractus_operator.store import ContentType, NotFound, Store

log = logging.getLogger(__name__)

ORPHANED_PODS_PERIOD_S = 30.0
"""Period of the search for orphaned pods, in seconds. The garbage collector has at least this time to delete them."""
_DEFAULT_TTL_S: int = ApplicationSpec.model_fields["ttl_after_finished"].default
_MAX_CLOCK_DIFFERENCE = timedelta(minutes=2)
"""Maximum time by which the clock of an earlier operator may have been ahead of the clock of this operator."""


class FinishedPods:
    """Stops the pods of a finished mission, and keeps them with their logs for a while, as a Job does.

    A Deployment replaces each pod that ends. So the Deployment and its ReplicaSet are deleted first, without the objects that
    they own. Then an expired deadline makes the kubelet stop the pod, which frees the resources of the node.
    """

    def __init__(self, store: Store, cache: ClusterCache, objects: ChildObjects, clock: Callable[[], datetime]) -> None:
        self._store = store
        self._cache = cache
        self._objects = objects
        self._clock = clock

    async def stop(self, submitted: Submitted, running: Collection[str] = ()) -> bool:
        """Stop the pods of an Application permanently. Return True if anything was changed.

        Args:
            submitted: The Application.
            running: Names of the instances that continue to run.

        Raises:
            KubeError: The API server refused a change, or could not be reached.
        """
        key = submitted.key
        if _ttl(submitted) == timedelta(0):
            deployments = await self._objects.remove(key, kinds.DEPLOYMENT, keeps=_of_instances(running))
            return await self.remove(key, running) or deployments
        removed = await self._objects.remove(key, kinds.DEPLOYMENT, orphan=True, keeps=_of_instances(running))
        pods = [pod for pod in _managed_pods(self._cache.pods_of(key)) if pod.instance not in running]
        if removed or pods:
            await self._remove_replica_sets(key, running)
        for pod in pods:
            if pod.node is None:
                await self._store.delete(kinds.POD, (pod.namespace, pod.name))
            else:
                await self._stop_pod(pod, submitted)
        return removed or bool(pods)

    async def expire(self, submitted: Submitted) -> float:
        """Delete the kept pods of an Application whose time is over.

        Returns:
            Seconds until the next pod expires. Infinite if no pod is kept.

        Raises:
            KubeError: The API server refused a deletion, or could not be reached.
        """
        next_s = float("inf")
        now = self._clock()
        kept_since = now - _ttl(submitted)
        for pod in _managed_pods(self._cache.pods_of(submitted.key, kept=True)):
            assert pod.finished_at is not None
            remaining_s = (pod.finished_at - kept_since).total_seconds()
            # Users may write a label with a future time. Such a label does not keep a pod longer.
            if remaining_s <= 0 or pod.finished_at > now + _MAX_CLOCK_DIFFERENCE:
                await self._store.delete(kinds.POD, (pod.namespace, pod.name))
            else:
                next_s = min(next_s, remaining_s)
        return next_s

    async def remove(self, key: Key, running: Collection[str] = ()) -> bool:
        """Delete the pods of an Application that have no Deployment, including kept pods. Return True if there were any.

        Args:
            key: The Application.
            running: Names of the instances that continue to run.

        Raises:
            KubeError: The API server refused a deletion, or could not be reached.
        """
        ending = [pod for pod in _managed_pods(self._cache.pods_of(key)) if pod.instance not in running]
        if ending:
            # An operator that was killed in `stop` has left ReplicaSets that would start the pods again.
            await self._remove_replica_sets(key, running)
        pods = [*ending, *_managed_pods(self._cache.pods_of(key, kept=True))]
        for pod in pods:
            await self._store.delete(kinds.POD, (pod.namespace, pod.name))
        return bool(pods)

    def run_on(self, key: Key, node: str) -> bool:
        """Return True if a pod of an Application still runs on a node that is ready, even if it is being stopped."""
        host = self._cache.hosts.get(("", node))
        pods = [*self._cache.pods_of(key), *self._cache.pods_of(key, kept=True)]
        return host is not None and host.ready and any(p.managed and p.node == node and not p.finished for p in pods)

    async def tear_down(self, key: Key) -> None:
        """Delete all objects of an Application that is being deleted, including pods without an owner.

        A deletion of the Application directly after its mission interrupts `stop`. Pods that have lost their owner, and have
        no new one yet, are not garbage collected, and may be missing in the cache. So they are listed at the API server.

        Args:
            key: The Application.

        Raises:
            KubeError: The API server refused a deletion, or could not be reached.
        """
        submitted = self._cache.applications.get(key)
        plan = self._cache.plans.latest(key, submitted.uid) if submitted is not None else None
        interrupted = plan is None or plan.is_over
        # A Deployment with a finalizer of another controller does not take its pods with it.
        deleted = await self._objects.remove_at_once(key, kinds.DEPLOYMENT)
        await self._objects.remove(key, *(kind for kind in reversed(kinds.CHILDREN) if kind is not kinds.DEPLOYMENT))
        collected: set[str] = set()
        for body in await list_objects(self._store, kinds.REPLICA_SET, key):
            if not interrupted and owned_by(deleted, body) and "deletionTimestamp" not in body["metadata"]:
                collected.add(body["metadata"]["uid"])
            else:
                await self._store.delete(kinds.REPLICA_SET, key_of(body), body["metadata"]["uid"])
        for body in await list_objects(self._store, kinds.POD, key):
            # Kept pods are deleted here as well. Their owner is the Application, but the garbage collector may miss them.
            if _managed_pods([parse_pod(body)]) and not owned_by(collected, body):
                await self._store.delete(kinds.POD, key_of(body), body["metadata"]["uid"])

    async def _remove_replica_sets(self, key: Key, running: Collection[str]) -> None:
        keeps = _of_instances(running)
        for body in await list_objects(self._store, kinds.REPLICA_SET, key):
            if keeps(body):
                continue
            await self._store.delete(kinds.REPLICA_SET, key_of(body), body["metadata"]["uid"], orphan=True)

    async def _stop_pod(self, pod: PodView, submitted: Submitted) -> None:
        owner = {"apiVersion": API_VERSION, "kind": Application.KIND, "name": submitted.key[1], "uid": submitted.uid}
        changes: Body = {
            "metadata": {
                # Without the hash, no ReplicaSet of a later mission adopts the pod.
                "labels": {FINISHED_LABEL: self._clock().strftime(FINISHED_FORMAT), "pod-template-hash": None},
                "ownerReferences": [owner],
            },
            "spec": {"activeDeadlineSeconds": FINISHED_DEADLINE_S},
        }
        try:
            await self._store.patch(kinds.POD, (pod.namespace, pod.name), changes, ContentType.MERGE)
        except NotFound:
            return


class OrphanedObjects:
    """Deletes cluster-scoped objects of one kind whose Application does not exist.

    Such objects cannot have a namespaced owner. They remain if the finalizer of the Application was removed by hand, so
    that there was no teardown.
    """

    def __init__(self, store: Store, cache: ClusterCache, kind: Kind) -> None:
        self._store = store
        self._cache = cache
        self._kind = kind

    def of(self, application: Key) -> Iterator[Key]:
        """Iterate over the objects of an Application."""
        for key, body in self._cache.children[self._kind].items():
            owner = _application_reference(body)
            if owner is not None and (owner.namespace, owner.name) == application:
                yield key

    async def reconcile(self, key: Key) -> None:
        """Delete an object if its Application does not exist."""
        body = self._cache.children[self._kind].get(key)
        if body is None:
            return
        owner = _application_reference(body)
        if owner is None:
            log.warning("cleanup: object names no Application (kind=%s name=%s)", self._kind.name, key[1])
            return
        submitted = self._cache.applications.get((owner.namespace, owner.name))
        if submitted is not None and submitted.metadata.uid == owner.uid:
            return
        try:
            # The watch of Applications may be behind, so the API server decides.
            current = await self._store.get(APPLICATION, owner.name, owner.namespace)
            if current["metadata"]["uid"] == owner.uid:
                return
        except NotFound:
            pass
        log.info(
            "cleanup: orphaned object deleted (kind=%s name=%s application=%s/%s)",
            self._kind.name,
            key[1],
            owner.namespace,
            owner.name,
        )
        await self._store.delete(self._kind, key, body["metadata"]["uid"])


class OrphanedPods:
    """Deletes pods of Applications that do not exist, if the garbage collector has not deleted them.

    A teardown lists the existing objects. But a request without a response may take effect after it, and the controllers of
    Kubernetes replace pods from their caches. Pods that lose their owner in this way are deleted only here.
    """

    def __init__(self, store: Store, cache: ClusterCache) -> None:
        self._store = store
        self._cache = cache
        self._orphaned: frozenset[Key] = frozenset()

    async def step(self) -> None:
        """Search once. Pods that are orphaned in two successive searches are deleted.

        Raises:
            KubeError: The API server refused a request, or could not be reached.
        """
        await self._cache.synced()
        existing = {label_key(key) for key, _ in self._cache.applications.items()}
        orphaned = frozenset(self._owners()) - existing
        twice = sorted(orphaned & self._orphaned)
        self._orphaned = orphaned
        for key in twice:
            # The watch of Applications may be behind the watch of pods, so the API server decides.
            present = (await self._store.list_whole(APPLICATION, namespace=key[0])).items
            if all(label_key(key_of(body)) != key for body in present):
                await self._remove(key)

    def _owners(self) -> Iterator[Key]:
        """Iterate over the label keys of the Applications of all pods."""
        for pod in self._cache.pods.values():
            if pod.application is not None and pod.managed and not pod.terminating:
                yield pod.namespace, pod.application

    async def _remove(self, key: Key) -> None:
        log.info("cleanup: orphaned pods deleted (application=%s/%s)", *key)
        kept: set[str] = set()
        for body in await list_objects(self._store, DEPLOYMENT, key):
            # A Deployment without an owner is a copy that a user created.
            if body["metadata"].get("ownerReferences"):
                await self._store.delete(DEPLOYMENT, key_of(body), body["metadata"]["uid"])
            else:
                kept.add(body["metadata"]["uid"])
        kept_replica_sets: set[str] = set()
        for body in await list_objects(self._store, REPLICA_SET, key):
            if owned_by(kept, body):
                kept_replica_sets.add(body["metadata"]["uid"])
            else:
                await self._store.delete(REPLICA_SET, key_of(body), body["metadata"]["uid"])
        for body in await list_objects(self._store, POD, key):
            if _managed_pods([parse_pod(body)]) and not owned_by(kept_replica_sets, body):
                await self._store.delete(POD, key_of(body), body["metadata"]["uid"])


async def list_objects(store: Store, kind: Kind, key: Key) -> list[Body]:
    """Return the objects of a kind that belong to an Application, from the API server."""
    namespace, name = key
    selectors = {"labelSelector": f"{MANAGED_SELECTOR},{APPLICATION_LABEL}={label_value(name)}"}
    return (await store.list_whole(kind, namespace=namespace, selectors=selectors)).items


def owned_by(uids: Collection[str], body: Body) -> bool:
    """Return True if an object has an owner with one of the uids."""
    return any(owner["uid"] in uids for owner in body["metadata"].get("ownerReferences") or ())


def _of_instances(instances: Collection[str]) -> Callable[[Body], bool]:
    """Return a function that returns True if an object belongs to one of the instances."""
    return lambda body: body["metadata"]["labels"].get(INSTANCE_LABEL) in instances


def _ttl(submitted: Submitted) -> timedelta:
    application = submitted.application
    ttl_s = application.spec.ttl_after_finished if application is not None else _DEFAULT_TTL_S
    return timedelta(seconds=ttl_s)


def _managed_pods(pods: Iterable[PodView]) -> list[PodView]:
    return [pod for pod in pods if pod.managed and not pod.terminating]


def _application_reference(body: Body) -> ApplicationReference | None:
    try:
        return ApplicationReference.model_validate(body["spec"].get("application"))
    except ValidationError:
        return None
