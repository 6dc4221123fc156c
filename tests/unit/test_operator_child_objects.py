"""Child objects of Applications, written to a fake API server: order of writes, ownership, deletion, and Secrets."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import yaml
from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec, MissionRecord
from fractus_operator import kinds
from fractus_operator.cache import ClusterCache
from fractus_operator.child_objects import ChildObjects, NameTaken
from fractus_operator.cleanup import FinishedPods, OrphanedPods
from fractus_operator.kinds import Body, Key, Kind
from fractus_operator.owned_objects import OwnedObjects
from fractus_operator.resources.deployment import owned_object
from fractus_operator.rollout import Rollout
from fractus_operator.store import Conflict, KubeError, NotFound, Store

INPUT = yaml.safe_load((Path(__file__).parents[1] / "golden" / "operator" / "input.yaml").read_text())
APPLICATION = Application.from_body(INPUT["application"])
PLAN = DeploymentPlanSpec.model_validate(INPUT["plan"])

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


PLACED = PLAN.model_copy(update={"placements": PLAN.placements[:2], "drone": None})


class Copy(dict[Key, Body]):
    """Empty cache of one kind."""

    def record_write(self, key: Key, body: Body) -> None:
        """Ignore the write."""


class Webhooks:
    """Fake API server. It never responds to writes of the kind `hanging`, as if a webhook was hanging."""

    def __init__(self, hanging: Kind | None, full: int = 0) -> None:
        self.hanging = hanging
        self.hangs = 0
        self.full = asyncio.Event()
        self.full_at = full
        self.requests: list[str] = []
        self.objects: dict[tuple[Kind, str], Body] = {}
        self.frozen = False

    async def get(self, kind: Kind, name: str, namespace: str = "") -> Body:
        self.requests.append(f"get {kind.name}")
        if (kind, name) not in self.objects:
            raise NotFound(404, "NotFound", name)
        return self.objects[kind, name]

    async def create(self, kind: Kind, body: Body) -> Body:
        if (kind, body["metadata"]["name"]) in self.objects:
            self.requests.append(f"create {kind.name} refused")
            raise Conflict(409, "AlreadyExists", "it is there")
        return await self.written("create", kind, body)

    async def apply(self, kind: Kind, body: Body) -> Body:
        self.frozen = False
        return await self.written("apply", kind, body)

    async def replace_spec(self, kind: Kind, _observed: Body, body: Body) -> Body:
        return await self.written("replace spec", kind, body)

    async def delete(self, kind: Kind, key: Key, _uid: str) -> None:
        self.requests.append(f"delete {kind.name}")
        del self.objects[kind, key[1]]

    async def take_ownership(self, kind: Kind, _key: Key) -> None:
        self.requests.append(f"own {kind.name}")
        if self.frozen:
            raise KubeError(422, "Invalid", "its image may no longer be used")

    async def written(self, how: str, kind: Kind, body: Body) -> Body:
        if kind is self.hanging:
            self.hangs += 1
            if self.hangs == self.full_at:
                self.full.set()
            await asyncio.Event().wait()
        self.requests.append(f"{how} {kind.name}")
        return body


def child_objects(store: Webhooks) -> ChildObjects:
    signer = SimpleNamespace(sign=lambda body, _=None: body, problem=lambda _grant: "unsigned")
    return ChildObjects(cast(Any, store), cast(Any, defaultdict(Copy)), cast(Any, signer))


@pytest.mark.parametrize("hanging", [kinds.SERVICE, kinds.DEPLOYMENT])
async def test_hanging_webhook_delays_neither_plans_nor_grants(hanging: Kind) -> None:
    store = Webhooks(hanging, full=16)
    children = child_objects(store)
    many = [hanging.header(f"s{i}", "city") for i in range(20)]
    stuck = asyncio.create_task(children.apply(APPLICATION, {hanging: many}))
    async with asyncio.timeout(10.0):
        await store.full.wait()
    store.requests.clear()
    desired = {kind: [kind.header("other", "city")] for kind in (kinds.DEPLOYMENT_PLAN, kinds.GRANT)}
    async with asyncio.timeout(10.0):
        await children.apply(APPLICATION, desired)
    assert store.requests == ["create DeploymentPlan", "create Grant"]
    stuck.cancel()
    await asyncio.gather(stuck, return_exceptions=True)


def standing(kind: Kind, **metadata: Any) -> Body:
    return {**kind.header("one", "city", uid="1", **metadata), "spec": {"old": True}}


async def test_object_with_taken_name_is_created_once_and_then_looked_up() -> None:
    """The operator looks up the existing object, because each failed creation counts against the quota."""
    store = Webhooks(None)
    store.objects[kinds.SERVICE, "one"] = standing(kinds.SERVICE)
    children = child_objects(store)
    for _ in range(2):
        with pytest.raises(NameTaken, match="does not belong to this Application"):
            await children.apply(APPLICATION, {kinds.SERVICE: [kinds.SERVICE.header("one", "city")]})
    assert store.requests == ["create Service refused", "get Service", "get Service"]
    store.objects.clear()
    await children.apply(APPLICATION, {kinds.SERVICE: [kinds.SERVICE.header("one", "city")]})
    assert store.requests[3:] == ["get Service", "create Service"]


async def test_inadmissible_object_is_replaced_before_ownership_changes() -> None:
    store = Webhooks(None)
    owners = [{"uid": APPLICATION.metadata.uid}]
    store.objects[kinds.DEPLOYMENT, "one"] = standing(kinds.DEPLOYMENT, ownerReferences=owners)
    store.frozen = True
    await child_objects(store).apply(APPLICATION, {kinds.DEPLOYMENT: [kinds.DEPLOYMENT.header("one", "city")]})
    assert store.requests[2:] == ["own Deployment", "apply Deployment", "own Deployment", "apply Deployment"]


async def test_refused_object_does_not_stop_later_kinds() -> None:
    store = Webhooks(None)
    store.objects[kinds.SERVICE, "one"] = standing(kinds.SERVICE)
    desired = {kind: [kind.header("one", "city")] for kind in (kinds.SERVICE, kinds.DEPLOYMENT)}
    with pytest.raises(NameTaken):
        await child_objects(store).apply(APPLICATION, desired)
    assert store.requests[2:] == ["create Deployment"]


@pytest.mark.parametrize(
    ("node", "then"), [("n1", ["replace spec Grant"]), ("n2", ["delete Grant", "create Grant"])], ids=["stays", "moved"]
)
async def test_existing_grant_is_replaced_in_place_unless_its_node_changes(node: str, then: list[str]) -> None:
    store = Webhooks(None)
    of = {"uid": APPLICATION.metadata.uid}
    store.objects[kinds.GRANT, "one"] = {
        **kinds.GRANT.header("one", uid="1"),
        "spec": {"application": of, "node": "n1"},
    }
    desired = {**kinds.GRANT.header("one", labels={}), "spec": {"application": of, "node": node}}
    await child_objects(store).apply(APPLICATION, {kinds.GRANT: [desired]})
    assert store.requests == ["create Grant refused", "get Grant", *then]


async def test_grant_of_another_application_is_not_written() -> None:
    store = Webhooks(None)
    spec = {"application": {"uid": "another"}, "node": "n1"}
    store.objects[kinds.GRANT, "one"] = {**kinds.GRANT.header("one", uid="1"), "spec": spec}
    with pytest.raises(NameTaken):
        await child_objects(store).apply(
            APPLICATION, {kinds.GRANT: [{**kinds.GRANT.header("one", labels={}), "spec": spec}]}
        )
    assert store.requests == ["create Grant refused", "get Grant"]


async def test_endpoint_slice_of_kubernetes_is_not_deleted() -> None:
    """EndpointSlices of Kubernetes have the labels of their Service, so they look like those of the operator.

    If the operator deleted such an EndpointSlice, Kubernetes would create it again.
    """
    store = Spelling(None)
    copies = {kind: OwnedObjects(cast(Any, store), kind, lambda body: body, lambda *_: None) for kind in kinds.CHILDREN}
    children = ChildObjects(cast(Any, store), copies, cast(Any, None))
    for name, owner, by in (
        ("ours", "Application", "operator.fractus.dev"),
        ("theirs", "Service", "endpointslice-controller.k8s.io"),
    ):
        body = owned_object(kinds.ENDPOINT_SLICE, APPLICATION, name, {"endpointslice.kubernetes.io/managed-by": by})
        body["metadata"]["ownerReferences"][0]["kind"] = owner
        copies[kinds.ENDPOINT_SLICE].record_write((APPLICATION.key[0], name), body)
    assert await children.remove(APPLICATION.key, kinds.ENDPOINT_SLICE)
    assert store.requests == ["delete EndpointSlice"]


async def test_addresses_are_updated_only_in_endpoint_slices_of_the_operator() -> None:
    """Kubernetes manages the EndpointSlice of a Service with a selector, and admission refuses writes by the operator."""
    store = Spelling(None)
    copies = {kind: OwnedObjects(cast(Any, store), kind, lambda body: body, lambda *_: None) for kind in kinds.CHILDREN}
    children = ChildObjects(cast(Any, store), copies, cast(Any, None))
    for name, by in (("ours", "operator.fractus.dev"), ("theirs", "endpointslice-controller.k8s.io")):
        owned = owned_object(kinds.ENDPOINT_SLICE, APPLICATION, name, {"endpointslice.kubernetes.io/managed-by": by})
        owned["endpoints"] = [{"addresses": ["10.0.0.7"]}]
        copies[kinds.ENDPOINT_SLICE].record_write((APPLICATION.key[0], name), owned)
    rollout = Rollout(children, cast(Any, None), cast(Any, None), lambda: NOW, "gateway:1")
    await rollout.update_addresses(APPLICATION.key, PLAN, [])
    assert store.requests == ["patch EndpointSlice ours"]


@pytest.mark.parametrize("owner", ["Application", "Service"])
async def test_deployment_with_changed_owner_is_deleted(owner: str) -> None:
    """Users with edit permission in a namespace can change the owner of a Deployment.

    Without explicit deletion, the Deployment would outlive its Application.
    """
    store = Spelling(None)
    copies = {kind: OwnedObjects(cast(Any, store), kind, lambda body: body, lambda *_: None) for kind in kinds.CHILDREN}
    body = owned_object(kinds.DEPLOYMENT, APPLICATION, "one", {})
    body["metadata"]["ownerReferences"][0]["kind"] = owner
    copies[kinds.DEPLOYMENT].record_write((APPLICATION.key[0], "one"), body)
    assert await ChildObjects(cast(Any, store), copies, cast(Any, None)).remove(APPLICATION.key, kinds.DEPLOYMENT)
    assert store.requests == ["delete Secret", "delete Deployment"]


def applications(*, over: bool) -> SimpleNamespace:
    """Return a cache of one Application. `over` states if its mission is over."""
    flown = MissionRecord(outcome="Complete") if over else None
    plan = DeploymentPlanSpec(application="a", flown=flown)
    return SimpleNamespace(
        applications={("city", "a"): SimpleNamespace(uid="app")}, plans=SimpleNamespace(latest=lambda *_: plan)
    )


@pytest.mark.parametrize("has_finalizer", [True, False])
async def test_pods_of_deployment_with_foreign_finalizer_are_deleted_one_by_one(has_finalizer: bool) -> None:
    """The finalizer keeps the Deployment, so the garbage collector does not delete its pods."""
    store = Spelling(None)
    labels = {"app.kubernetes.io/managed-by": "fractus", "fractus.dev/instance": "one"}

    def owned(kind: Kind, uid: str, owner: str) -> Body:
        return kind.header("one", "city", uid=uid, labels=labels, ownerReferences=[{"uid": owner}]) | {"spec": {}}

    deployment = owned(kinds.DEPLOYMENT, "d", "app")
    # The Deployment is not found by its label, because users may have removed the label.
    store.with_finalizer = frozenset({(kinds.DEPLOYMENT, "one")} if has_finalizer else ())
    listed = {
        kinds.DEPLOYMENT: [],
        kinds.REPLICA_SET: [owned(kinds.REPLICA_SET, "r", "d")],
        kinds.POD: [owned(kinds.POD, "p", "r")],
    }

    async def list_whole(kind: Kind, **_: object) -> Any:
        return SimpleNamespace(items=listed[kind])

    cast(Any, store).list_whole = list_whole
    copies = {kind: OwnedObjects(cast(Any, store), kind, lambda body: body, lambda *_: None) for kind in kinds.CHILDREN}
    deployment["metadata"]["labels"] = labels | {"fractus.dev/application": "a"}
    copies[kinds.DEPLOYMENT].record_write(("city", "one"), deployment)
    cache = applications(over=False)
    children = ChildObjects(cast(Any, store), copies, cast(Any, None))
    await FinishedPods(cast(Any, store), cast(Any, cache), children, lambda: NOW).tear_down(("city", "a"))
    assert store.requests == [
        "delete Secret",
        "delete Deployment",
        *(["delete ReplicaSet", "delete Pod"] if has_finalizer else []),
    ]


async def test_teardown_deletes_kept_pods() -> None:
    store = Spelling(None)
    labels = {"app.kubernetes.io/managed-by": "fractus", "fractus.dev/instance": "one"}
    with_finalizer = kinds.POD.header("one-x", "city", uid="p", labels=labels, ownerReferences=[{"uid": "app"}]) | {
        "spec": {}
    }

    async def list_whole(kind: Kind, **_: object) -> Any:
        return SimpleNamespace(items=[with_finalizer] if kind is kinds.POD else [])

    cast(Any, store).list_whole = list_whole
    copies = {kind: OwnedObjects(cast(Any, store), kind, lambda body: body, lambda *_: None) for kind in kinds.CHILDREN}
    cache = applications(over=True)
    children = ChildObjects(cast(Any, store), copies, cast(Any, None))
    await FinishedPods(cast(Any, store), cast(Any, cache), children, lambda: NOW).tear_down(("city", "a"))
    assert store.requests == ["delete Pod"]


class Late(Store):
    """Fake API server for requests that take effect late. A test adds the objects that controllers then create."""

    def __init__(self) -> None:
        self.objects: dict[tuple[str, Key], Body] = {}

    def put(self, kind: Kind, name: str, *owners: Body, **metadata: Any) -> Body:
        labels = {
            "app.kubernetes.io/managed-by": "fractus",
            "fractus.dev/application": "a",
            "fractus.dev/instance": "one",
        }
        owning = [{"kind": o["kind"], "apiVersion": o["apiVersion"], "name": o["metadata"]["name"]} for o in owners]
        references = [
            {**o, "uid": owner["metadata"]["uid"], "controller": True} for o, owner in zip(owning, owners, strict=True)
        ]
        known = {"uid": f"{kind.name}/{name}", "resourceVersion": "1", "labels": labels, **metadata}
        if references:
            known["ownerReferences"] = references
        body = kind.header(name, "city", **known) | {"spec": {}}
        self.objects[kind.path("city"), ("city", name)] = body
        return body

    async def request(self, method: str, path: str, body: Any = None, **_: Any) -> Body:
        collection, _, name = path.rpartition("/")
        if method == "DELETE":
            if self.objects.pop((collection, ("city", name)), None) is None:
                raise NotFound(404, "NotFound", name)
            return {"kind": "Status"}
        return {"items": [body for (of, _), body in self.objects.items() if of == path], "metadata": {}}

    def names(self) -> set[str]:
        return {f"{body['kind']}/{body['metadata']['name']}" for body in self.objects.values()}


def cache_with_pods(store: Late) -> ClusterCache:
    """Return a synchronized cache that contains the pods of the store."""
    cache = ClusterCache(store)
    for informer in cache.informers:
        informer.synced.set()
    for (_, key), body in store.objects.items():
        if body["kind"] == "Pod":
            cache.pods.record_write(key, body)
    return cache


async def test_orphaned_pods_created_after_teardown_are_deleted() -> None:
    """The deletion of a Deployment takes effect late and orphans its pods.

    A controller has created new objects in the meantime.
    """
    store = Late()
    cache = cache_with_pods(store)
    children = ChildObjects(store, cache.children, cast(Any, None))
    await FinishedPods(store, cache, children, lambda: NOW).tear_down(("city", "a"))
    owned = store.put(kinds.REPLICA_SET, "one-7f")
    store.put(kinds.POD, "one-7f-x", owned)
    orphaned_pods = OrphanedPods(store, cache := cache_with_pods(store))
    await orphaned_pods.step()
    assert store.names() == {"ReplicaSet/one-7f", "Pod/one-7f-x"}, (
        "the first step gives the garbage collector time to delete the pods"
    )
    store.put(kinds.APPLICATION, "a")
    await orphaned_pods.step()
    assert {"ReplicaSet/one-7f", "Pod/one-7f-x"} < store.names(), (
        "the pods are kept, because their Application still exists at the API server"
    )
    await store.delete(kinds.APPLICATION, ("city", "a"))
    await orphaned_pods.step()
    assert store.names() == set()


async def test_deployment_created_after_teardown_is_deleted() -> None:
    store = Late()
    deployment = store.put(kinds.DEPLOYMENT, "one", kinds.APPLICATION.header("a", "city", uid="gone"))
    store.put(kinds.POD, "one-7f-x", store.put(kinds.REPLICA_SET, "one-7f", deployment))
    orphaned_pods = OrphanedPods(store, cache_with_pods(store))
    for _ in range(2):
        await orphaned_pods.step()
    assert store.names() == set()


async def test_copy_of_deployment_without_owner_is_kept() -> None:
    store = Late()
    store.put(kinds.POD, "one-7f-x", store.put(kinds.REPLICA_SET, "one-7f", store.put(kinds.DEPLOYMENT, "one")))
    orphaned_pods = OrphanedPods(store, cache_with_pods(store))
    for _ in range(3):
        await orphaned_pods.step()
    assert len(store.objects) == 3


class Spelling(Webhooks):
    """Fake API server that normalises written objects. Objects in `with_finalizer` cannot be deleted."""

    with_finalizer: frozenset[tuple[Kind, str]] = frozenset()

    async def written(self, how: str, kind: Kind, body: Body) -> Body:
        written = await super().written(how, kind, body)
        return {**written, "spec": {"cpu": "500m"}, "metadata": {**written["metadata"], "resourceVersion": "1"}}

    async def delete(self, kind: Kind, key: Key, _uid: str | None = None, *, orphan: bool = False) -> bool:
        self.requests.append(f"delete {kind.name}")
        return (kind, key[1]) not in self.with_finalizer

    async def patch(self, kind: Kind, key: Key, changes: Body, _type: object) -> Body:
        self.requests.append(f"patch {kind.name} {key[1]}")
        return {"metadata": {"name": key[1], "namespace": key[0]}, **changes}


async def test_normalised_object_is_forgotten_when_deleted() -> None:
    store = Spelling(None)
    copies = {kind: OwnedObjects(cast(Any, store), kind, lambda body: body, lambda *_: None) for kind in kinds.CHILDREN}
    children = ChildObjects(cast(Any, store), copies, cast(Any, None))
    deployment = owned_object(kinds.DEPLOYMENT, APPLICATION, "one", {}, spec={"cpu": 0.5})
    for _ in range(2):
        await children.apply(APPLICATION, {kinds.DEPLOYMENT: [deployment]})
    assert store.requests == ["create Deployment"], "a difference caused by normalisation does not cause another write"
    nothing: dict[Kind, list[Body]] = {kind: [] for kind in kinds.CHILDREN}
    await children.prune(APPLICATION, nothing)
    assert store.requests[1:] == ["delete Secret", "delete Deployment"]
    assert not children._normalised


class Secrets:
    """A fake API server that allows writing and deleting Secrets, but not reading."""

    def __init__(self, *existing: str) -> None:
        self.objects = set(existing)
        self.requests: list[str] = []
        self.refused = False
        self.full = False

    async def create(self, kind: Kind, body: Body) -> Body:
        self.requests.append("create")
        if self.full:
            raise KubeError(403, "Forbidden", "exceeded quota")
        if body["metadata"]["name"] in self.objects:
            raise Conflict(409, "AlreadyExists", "it is there")
        self.objects.add(body["metadata"]["name"])
        return body

    async def replace(self, kind: Kind, body: Body) -> Body:
        self.requests.append("replace")
        if body["metadata"]["name"] not in self.objects:
            raise NotFound(404, "NotFound", "it is gone")
        return body

    async def delete(self, kind: Kind, key: Key, _uid: str = "", *, orphan: bool = False) -> bool:
        if kind is kinds.SECRET:
            if self.refused:
                raise KubeError(422, "Invalid", "no")
            self.objects.discard(key[1])
        self.requests.append(f"delete {kind.name}")
        return True


@pytest.mark.parametrize(
    ("reason", "existing", "requests"),
    [
        ("new", False, ["create"]),
        ("new", True, ["create", "replace"]),
        ("renewed", True, ["replace"]),
        ("renewed", False, ["replace", "create"]),
        ("lost", True, ["create"]),
        ("lost", False, ["create"]),
    ],
)
async def test_secret_is_written_without_reading_it(reason: Any, existing: bool, requests: list[str]) -> None:
    store = Secrets(*["one-tls"] * existing)
    children = child_objects(cast(Any, store))
    assert await children.write_secret(APPLICATION, "one", kinds.SECRET.header("one-tls", "city"), reason)
    assert store.requests == requests
    assert store.objects == {"one-tls"}


@pytest.mark.parametrize("reason", ["new", "renewed", "lost"])
async def test_exhausted_quota_is_reported_only_for_missing_secret(reason: Any) -> None:
    """The API server checks the quota before it checks if the object exists.

    With an exhausted quota, it therefore refuses to create even an existing Secret.
    """
    secret = kinds.SECRET.header("one-tls", "city")
    store = Secrets("one-tls")
    store.full = True
    assert await child_objects(cast(Any, store)).write_secret(APPLICATION, "one", secret, reason)
    assert store.requests[-1] == "replace"
    store.objects.clear()
    with pytest.raises(KubeError, match="exceeded quota"):
        await child_objects(cast(Any, store)).write_secret(APPLICATION, "one", secret, reason)


async def test_secret_is_not_written_for_deployment_of_another_owner() -> None:
    store = Secrets()
    copies = {kind: OwnedObjects(cast(Any, store), kind, lambda body: body, lambda *_: None) for kind in kinds.CHILDREN}
    copies[kinds.DEPLOYMENT].record_write(
        (APPLICATION.key[0], "one"), kinds.DEPLOYMENT.header("one", APPLICATION.key[0])
    )
    children = ChildObjects(cast(Any, store), copies, cast(Any, None))
    assert not await children.write_secret(APPLICATION, "one", kinds.SECRET.header("one-tls", "city"), "new")
    assert store.requests == []


async def test_secret_is_deleted_with_its_deployment_and_retried_after_refusal() -> None:
    store = Secrets("one-tls")
    copies = {kind: OwnedObjects(cast(Any, store), kind, lambda body: body, lambda *_: None) for kind in kinds.CHILDREN}
    children = ChildObjects(cast(Any, store), copies, cast(Any, None))
    copies[kinds.DEPLOYMENT].record_write(
        (APPLICATION.key[0], "one"), owned_object(kinds.DEPLOYMENT, APPLICATION, "one", {})
    )
    store.refused = True
    with pytest.raises(KubeError, match="no"):
        await children.remove(APPLICATION.key, kinds.DEPLOYMENT)
    assert store.requests == ["delete Deployment"], (
        "the Deployment is deleted although the deletion of its Secret fails"
    )
    store.refused = False
    await children.remove(APPLICATION.key, kinds.SERVICE)
    assert store.objects == set()
    store.requests.clear()
    await children.remove(APPLICATION.key, kinds.SERVICE)
    assert store.requests == []
