"""Field ownership and spec replacement by the operator, against a fake API server."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import pytest
from fractus_operator.kinds import DEPLOYMENT, Body
from fractus_operator.store import FIELD_MANAGER, Conflict, Invalid, KubeError, Store
from kube_server import Request, listening, response
from kube_server import Server as HttpServer

KEY = ("city", "traffic")
CREATED = {"manager": FIELD_MANAGER, "operation": "Update", "fieldsV1": {"f:spec": {"f:a": {}, "f:b": {"f:c": {}}}}}
APPLIED = {"manager": FIELD_MANAGER, "operation": "Apply", "fieldsV1": {"f:spec": {"f:b": {"f:d": {}}}}}
STATUS = {"manager": FIELD_MANAGER, "operation": "Update", "subresource": "status", "fieldsV1": {"f:status": {}}}
FOREIGN = {"manager": "kube-controller-manager", "operation": "Update", "fieldsV1": {"f:metadata": {}}}


class Server:
    """Fake API server with one object. It refuses the first `refusals` patches with a conflict."""

    def __init__(self, *entries: Body, exists: bool = True, refusals: int = 0) -> None:
        self.metadata: Body = {"name": KEY[1], "namespace": KEY[0], "uid": "u1", "resourceVersion": "7"}
        self.metadata["managedFields"] = list(entries)
        self.refusal = response({"reason": "Conflict"}, 409)
        self.exists = exists
        self.refusals = refusals
        self.patches: list[dict[str, Any]] = []

    def __call__(self, request: Request) -> bytes:
        if not self.exists:
            return response({"reason": "NotFound"}, 404)
        if request.method == "PATCH":
            assert request.header("content-type") == "application/json-patch+json"
            if self.refusals:
                self.refusals -= 1
                return self.refusal
            self.patches.append({step["path"]: step["value"] for step in json.loads(request.body)})
        return response({"metadata": self.metadata})


async def take_ownership(server: Server) -> None:
    async with listening(HttpServer(server)) as access, contextlib.aclosing(Store(access)) as store:
        await store.take_ownership(DEPLOYMENT, KEY)


async def test_take_ownership_changes_only_own_fields() -> None:
    server = Server(CREATED, FOREIGN, STATUS)
    await take_ownership(server)
    (patch,) = server.patches
    assert patch["/metadata/resourceVersion"] == "7"
    assert patch["/metadata/managedFields"] == [FOREIGN, STATUS, {**CREATED, "operation": "Apply"}]


async def test_take_ownership_merges_applied_fields() -> None:
    server = Server(APPLIED, CREATED)
    await take_ownership(server)
    (entry,) = server.patches[0]["/metadata/managedFields"]
    assert entry["fieldsV1"] == {"f:spec": {"f:a": {}, "f:b": {"f:c": {}, "f:d": {}}}}


@pytest.mark.parametrize("entries", [(), (FOREIGN,), (APPLIED, FOREIGN, STATUS)])
async def test_take_ownership_writes_nothing_if_applied(entries: tuple[Body, ...]) -> None:
    server = Server(*entries)
    await take_ownership(server)
    assert server.patches == []


async def test_take_ownership_ignores_deleted_object() -> None:
    await take_ownership(Server(exists=False))


async def test_take_ownership_retries_after_conflict() -> None:
    server = Server(CREATED, refusals=2)
    await take_ownership(server)
    assert len(server.patches) == 1
    with pytest.raises(Conflict):
        await take_ownership(Server(CREATED, refusals=3))


OBSERVED: Body = {
    "metadata": {"name": KEY[1], "namespace": KEY[0], "uid": "u1", "labels": {"foreign": "1", "own": "1"}}
}
DESIRED: Body = {
    "metadata": {"name": KEY[1], "labels": {"own": "2"}, "annotations": {"signature": "s"}},
    "spec": {"a": 1},
}


async def replace_spec(server: Server) -> None:
    async with listening(HttpServer(server)) as access, contextlib.aclosing(Store(access)) as store:
        await store.replace_spec(DEPLOYMENT, OBSERVED, DESIRED)


async def test_replace_spec_keeps_foreign_labels() -> None:
    server = Server()
    await replace_spec(server)
    assert server.patches == [
        {
            "/metadata/uid": "u1",
            "/metadata/labels": {"foreign": "1", "own": "2"},
            "/metadata/annotations": {"signature": "s"},
            "/spec": {"a": 1},
        }
    ]


@pytest.mark.parametrize(("uid", "error"), [("u1", Invalid), ("u2", Conflict)])
async def test_replace_spec_detects_recreated_object(uid: str, error: type[KubeError]) -> None:
    server = Server(refusals=1)
    server.refusal = response({"reason": "Invalid"}, 422)
    server.metadata["uid"] = uid
    with pytest.raises(KubeError) as raised:
        await replace_spec(server)
    assert type(raised.value) is error
