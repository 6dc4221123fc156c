"""Operator objects of each node: NodeGrants, service account, and reports of the agent."""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import AsyncIterator
from typing import Any

import pytest
from fractus_core.api import grants
from fractus_core.api.grants import NODE_GRANTS_NAMESPACE, ReportedGrant, ReportedPictures, unpack
from fractus_operator import kinds
from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import Body, Kind
from fractus_operator.node_controller import NodeGrantsController
from fractus_operator.node_objects import ACCOUNT_KINDS, account_object, is_unmodified
from fractus_operator.resources.grant import reported_status
from fractus_operator.store import Store
from fractus_runtime.kubernetes import Conflict, Invalid, KubeError, NotFound


def report(phase: Any, message: str = "", generation: int = 1, uid: str = "u") -> ReportedGrant:
    return ReportedGrant(uid=uid, name="g", phase=phase, message=message, observed_generation=generation)


@pytest.mark.parametrize(
    ("known", "reported", "expected"),
    [
        (None, report("Active"), {"phase": "Active", "message": "", "observedGeneration": 1}),
        ({"phase": "Active", "message": "", "observedGeneration": 1}, report("Active"), None),
        (
            {"phase": "Active", "message": "", "observedGeneration": 1, "conditions": []},
            report("Complete", "flown", 2),
            {"phase": "Complete", "message": "flown", "observedGeneration": 2},
        ),
        (
            None,
            report("Complete").model_copy(update={"pictures": ReportedPictures(taken=2, refused=1)}),
            {"phase": "Complete", "message": "", "pictures": {"taken": 2, "refused": 1}, "observedGeneration": 1},
        ),
        ({"phase": "Complete", "message": "flown", "observedGeneration": 1}, report("Active"), None),
        (
            {"phase": "Failed", "message": "wind", "observedGeneration": 1},
            report("Complete", "flown", 2),
            {"phase": "Failed", "message": "wind", "observedGeneration": 2},
        ),
    ],
)
def test_report_becomes_grant_status_but_final_phase_stays(
    known: Body | None, reported: ReportedGrant, expected: Body | None
) -> None:
    assert reported_status({"metadata": {"name": "g"}, "status": known}, reported) == expected


@pytest.mark.parametrize("kind", ACCOUNT_KINDS, ids=lambda kind: kind.name)
def test_account_with_changed_fields_counts_as_modified(kind: Kind) -> None:
    created = account_object(kind, "drone-1")
    assert is_unmodified(kind, created | {"secrets": []})
    for field in created.keys() - {"apiVersion", "kind", "metadata"}:
        assert not is_unmodified(kind, created | {field: []})
    assert not is_unmodified(kind, created | {"metadata": {"name": "drone-2"}}) or kind is kinds.SERVICE_ACCOUNT


class Api(Store):
    """A fake API server that records requests."""

    def __init__(self) -> None:
        self.field_manager = "test"
        self.objects: dict[str, Body] = {}
        self.requests: list[tuple[str, str]] = []
        self._versions = itertools.count(1)

    async def request(self, method: str, path: str, body: Any = None, **_: Any) -> Any:
        self.requests.append((method, path))
        await asyncio.sleep(0)
        target = path.removesuffix("/status")
        if method == "POST":
            target = f"{path}/{body['metadata']['name']}"
            if target in self.objects:
                raise Conflict(409, "AlreadyExists", target)
            self.objects[target] = json.loads(json.dumps(body))
            self.objects[target]["metadata"]["uid"] = f"uid of {target}"
        elif target not in self.objects:
            raise NotFound(404, "NotFound", path)
        elif method == "DELETE":
            del self.objects[target]
            return {"kind": "Status"}
        elif method == "PATCH":
            stored = self.objects[target]
            if path != target:
                # As at the API server, a status patch must test the uid, because it cannot set metadata.
                test_operation, status_operation = body
                if test_operation != {"op": "test", "path": "/metadata/uid", "value": stored["metadata"]["uid"]}:
                    raise Invalid(422, "Invalid", path)
                stored["status"] = status_operation["value"]
            elif body["metadata"]["uid"] != stored["metadata"]["uid"]:
                raise Conflict(409, "Conflict", path)
            else:
                stored |= {field: value for field, value in body.items() if field != "metadata"}
        else:
            raise KubeError(405, "MethodNotAllowed", path)
        self.objects[target]["metadata"]["resourceVersion"] = str(next(self._versions))
        return json.loads(json.dumps(self.objects[target]))

    def node(self, name: str) -> dict[str, Body]:
        """Return the objects of a node by kind."""
        return {
            body["kind"]: body
            for path, body in self.objects.items()
            if f"/{NODE_GRANTS_NAMESPACE}/" in path and path.endswith(f"/{name}")
        }

    def granted(self, name: str) -> list[str] | None:
        """Return the names of the Grants in the NodeGrants of a node, or None if there is no NodeGrants."""
        node_grants = self.node(name).get("NodeGrants")
        return (
            None
            if node_grants is None
            else [
                grant["metadata"]["name"]
                for grant in unpack(node_grants["spec"]["packed"], node_grants["spec"]["count"])
            ]
        )


class Cluster:
    """Test bench that runs the controller, and delivers the events of its watches."""

    def __init__(self) -> None:
        self.api = Api()
        self.cache = ClusterCache(self.api)
        self.keeper = NodeGrantsController(self.api, self.cache)
        self.tasks = [asyncio.create_task(work_queue.run()) for work_queue in self.keeper.work_queues()]
        for informer in self.cache.informers:
            informer.synced.set()
        self._versions = itertools.count(1000)

    def drone(self, name: str) -> None:
        spec = {"home": {"lat": 1.0, "lon": 1.0, "alt": 1.0}, "services": {}}
        body = kinds.DRONE.header(name, uid=name, resourceVersion=str(next(self._versions))) | {"spec": spec}
        self.cache.drones._take("MODIFIED", body)

    def no_drone(self, name: str) -> None:
        self.cache.drones._drop(("", name))

    def host(self, name: str) -> None:
        body = kinds.NODE.header(name, uid=name, resourceVersion=str(next(self._versions))) | {"spec": {}, "status": {}}
        self.cache.hosts._take("MODIFIED", body)

    def no_host(self, name: str) -> None:
        self.cache.hosts._drop(("", name))

    def grant(self, name: str, node: str, **metadata: Any) -> Body:
        spec = {
            "node": node,
            "application": {"namespace": "t", "name": "a", "uid": "a"},
            "component": "A",
            "instance": name,
        }
        labels = {"app.kubernetes.io/managed-by": "fractus", "fractus.dev/application": "a"}
        known = {"uid": f"uid of {name}", "labels": labels, "generation": 1, **metadata}
        body = kinds.GRANT.header(name, **known, resourceVersion=str(next(self._versions))) | {"spec": spec}
        self.api.objects[kinds.GRANT.path("", name)] = json.loads(json.dumps(body))
        self.cache.children[kinds.GRANT]._take("MODIFIED", body)
        return body

    def no_grant(self, name: str) -> None:
        del self.api.objects[kinds.GRANT.path("", name)]
        self.cache.children[kinds.GRANT]._drop(("", name))

    def report(self, node: str, *reports: ReportedGrant) -> None:
        body = json.loads(json.dumps(self.api.node(node)["NodeGrants"]))
        body["status"] = {"observedGeneration": 1, "grants": [each.to_dict() for each in reports]}
        body["metadata"]["resourceVersion"] = str(next(self._versions))
        self.cache.node_objects.known._take("MODIFIED", body)

    def status(self, grant: str) -> Any:
        return self.api.objects[kinds.GRANT.path("", grant)].get("status")

    def report_deleted(self, kind: Kind, node: str) -> None:
        """Deliver the event of a deletion, like the watch."""
        objects = self.cache.node_objects
        informer: Any = objects.known if kind is kinds.NODE_GRANTS else objects.accounts[kind]
        informer._drop((NODE_GRANTS_NAMESPACE, node))

    async def until(self, condition: Any) -> None:
        async with asyncio.timeout(10):
            while not condition():  # noqa: ASYNC110 (the queues have no event)
                await asyncio.sleep(0)

    async def settled(self) -> None:
        """Wait until all queued keys are reconciled."""
        await self.until(lambda: not any(w._waiting or w._in_progress for w in self.keeper.work_queues()))


@pytest.fixture
async def cluster() -> AsyncIterator[Cluster]:
    running = Cluster()
    yield running
    for task in running.tasks:
        task.cancel()
    await asyncio.gather(*running.tasks, return_exceptions=True)


ALL = {"ServiceAccount", "Role", "RoleBinding", "NodeGrants"}


async def test_node_gets_account_and_empty_node_grants(cluster: Cluster) -> None:
    cluster.drone("drone-1")
    await cluster.until(lambda: cluster.api.node("drone-1").keys() == ALL)
    assert cluster.api.granted("drone-1") == []
    await cluster.settled()
    cluster.api.requests.clear()
    cluster.drone("drone-1")
    await cluster.settled()
    assert cluster.api.requests == []


async def test_nodes_are_reconciled_only_after_sync(cluster: Cluster) -> None:
    cluster.cache.children[kinds.GRANT].synced.clear()
    cluster.drone("drone-1")
    for _ in range(20):
        await asyncio.sleep(0)
    assert cluster.api.requests == []
    cluster.cache.children[kinds.GRANT].synced.set()
    await cluster.until(lambda: cluster.api.granted("drone-1") == [])


async def test_node_grants_follow_grants_of_the_node(cluster: Cluster) -> None:
    cluster.drone("drone-1")
    cluster.grant("a", "drone-1")
    cluster.grant("b", "edge-1")
    await cluster.until(lambda: cluster.api.granted("drone-1") == ["a"] and cluster.api.granted("edge-1") == ["b"])
    cluster.grant("c", "drone-1")
    await cluster.until(lambda: cluster.api.granted("drone-1") == ["a", "c"])
    cluster.grant("c", "drone-1", deletionTimestamp="2026-01-01T00:00:00Z")
    await cluster.until(lambda: cluster.api.granted("drone-1") == ["a"])
    cluster.no_grant("a")
    await cluster.until(lambda: cluster.api.granted("drone-1") == [])


async def test_reports_are_copied_to_grants_of_the_same_node(cluster: Cluster) -> None:
    cluster.grant("a", "drone-1")
    cluster.grant("b", "edge-1")
    await cluster.until(lambda: cluster.api.granted("drone-1") == ["a"])
    await cluster.settled()
    cluster.api.requests.clear()
    strangers = (report("Failed", uid="uid of b"), report("Failed", uid="unknown"))
    cluster.report("drone-1", report("Complete", "flown", uid="uid of a"), *strangers)
    await cluster.until(lambda: cluster.status("a") is not None)
    await cluster.settled()
    assert cluster.status("a") == {"phase": "Complete", "message": "flown", "observedGeneration": 1}
    assert cluster.status("b") is None
    # A changed status causes no write of the NodeGrants. An unchanged report causes no write of a status.
    assert cluster.api.requests == [("PATCH", f"{kinds.GRANT.path('', 'a')}/status")]
    cluster.report("drone-1", report("Complete", "flown", uid="uid of a"), report("Active", uid="more"))
    await cluster.settled()
    assert len(cluster.api.requests) == 1


async def test_deleted_node_gets_empty_node_grants_before_removal(cluster: Cluster) -> None:
    cluster.drone("drone-1")
    cluster.grant("a", "drone-1")
    await cluster.until(lambda: cluster.api.node("drone-1").keys() == ALL and cluster.api.granted("drone-1") == ["a"])
    cluster.no_drone("drone-1")
    await cluster.settled()
    assert cluster.api.granted("drone-1") == ["a"], "the NodeGrants is kept while a Grant names the node"
    cluster.api.requests.clear()
    cluster.no_grant("a")
    await cluster.until(lambda: not cluster.api.node("drone-1"))
    assert [method for method, _ in cluster.api.requests] == ["PATCH", "DELETE", "DELETE", "DELETE", "DELETE"]


async def test_unregistered_node_keeps_empty_node_grants(cluster: Cluster) -> None:
    cluster.host("edge-1")
    cluster.grant("a", "edge-1")
    await cluster.until(lambda: cluster.api.node("edge-1").keys() == ALL and cluster.api.granted("edge-1") == ["a"])
    cluster.no_grant("a")
    await cluster.settled()
    assert cluster.api.granted("edge-1") == []
    assert cluster.api.node("edge-1").keys() == ALL
    cluster.no_host("edge-1")
    await cluster.until(lambda: not cluster.api.node("edge-1"))


async def test_report_of_recreated_grant_is_dropped(cluster: Cluster) -> None:
    cluster.grant("a", "drone-1")
    await cluster.until(lambda: cluster.api.granted("drone-1") == ["a"])
    await cluster.settled()
    # The watch has not reported the object yet.
    cluster.api.objects[kinds.GRANT.path("", "a")]["metadata"]["uid"] = "another"
    cluster.report("drone-1", report("Complete", uid="uid of a"))
    await cluster.until(lambda: ("PATCH", f"{kinds.GRANT.path('', 'a')}/status") in cluster.api.requests)
    await cluster.settled()
    assert cluster.status("a") is None


async def test_newest_grants_are_omitted_when_node_grants_is_full(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    oldest = cluster.grant("z-oldest", "drone-1", creationTimestamp="2026-01-01T00:00:00Z")
    monkeypatch.setattr(grants, "MAX_UNPACKED_BYTES", 3 * len(json.dumps(oldest)))
    for hour in range(9):
        cluster.grant(f"g{hour}", "drone-1", creationTimestamp=f"2026-01-02T0{hour}:00:00Z")
    await cluster.settled()
    held = cluster.api.granted("drone-1")
    assert held is not None
    assert held[-1] == "z-oldest"
    assert held[:-1] == [f"g{hour}" for hour in range(len(held) - 1)]
    assert 2 <= len(held) <= 4
    assert f"omitted={10 - len(held)}" in caplog.text
    cluster.no_grant("z-oldest")
    await cluster.settled()
    assert cluster.api.granted("drone-1") == [f"g{hour}" for hour in range(len(held))], (
        "after the revocation, one more Grant fits"
    )


@pytest.mark.parametrize("kind", [*ACCOUNT_KINDS, kinds.NODE_GRANTS], ids=lambda kind: kind.name)
async def test_deleted_or_modified_node_object_is_created_again(cluster: Cluster, kind: Kind) -> None:
    cluster.drone("drone-1")
    cluster.grant("a", "drone-1")
    await cluster.until(lambda: cluster.api.node("drone-1").keys() == ALL)
    await cluster.settled()
    path = kind.path(NODE_GRANTS_NAMESPACE, "drone-1")
    before = cluster.api.objects[path]
    if kind is kinds.NODE_GRANTS:
        changed = before | {"spec": {"count": 0, "packed": ""}}
        informer: Any = cluster.cache.node_objects.known
    else:
        changed = before | {"rules": [], "subjects": [], "automountServiceAccountToken": True}
        informer = cluster.cache.node_objects.accounts[kind]
    version = str(next(cluster._versions))
    cluster.api.objects[path] = json.loads(json.dumps(changed))
    informer._take("MODIFIED", changed | {"metadata": before["metadata"] | {"resourceVersion": version}})
    await cluster.settled()
    expected = {field: value for field, value in before.items() if field != "metadata"}
    assert {field: cluster.api.objects[path].get(field) for field in expected} == expected
    del cluster.api.objects[path]
    cluster.report_deleted(kind, "drone-1")
    await cluster.until(lambda: path in cluster.api.objects)
    await cluster.settled()
    assert cluster.api.granted("drone-1") == ["a"]


async def test_grants_changed_during_packing_are_written(cluster: Cluster) -> None:
    for number in range(20):
        cluster.grant(f"g{number:02d}", "drone-1")
        await asyncio.sleep(0)
    await cluster.until(lambda: len(cluster.api.granted("drone-1") or ()) == 20)
    await cluster.settled()
    writes = [path for method, path in cluster.api.requests if "/nodegrants" in path]
    assert len(writes) < 20
