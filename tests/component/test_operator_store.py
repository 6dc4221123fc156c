"""Field ownership and spec replacement by the operator, against a fake API server."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import pytest
from fractus_operator.kinds import DEPLOYMENT, Body
from fractus_operator.store import FIELD_MANAGER, Conflict, Invalid, KubeError, Store
from kube_server import Request, answer, listening
from kube_server import Server as HttpServer

KEY = ("city", "traffic")
CREATED = {"manager": FIELD_MANAGER, "operation": "Update", "fieldsV1": {"f:spec": {"f:a": {}, "f:b": {"f:c": {}}}}}
APPLIED = {"manager": FIELD_MANAGER, "operation": "Apply", "fieldsV1": {"f:spec": {"f:b": {"f:d": {}}}}}
STATUS = {"manager": FIELD_MANAGER, "operation": "Update", "subresource": "status", "fieldsV1": {"f:status": {}}}
THEIRS = {"manager": "kube-controller-manager", "operation": "Update", "fieldsV1": {"f:metadata": {}}}


class Server:
    """Answers with one object; refuses the first patches as made on an older one."""

    def __init__(self, *entries: Body, there: bool = True, refusals: int = 0) -> None:
        self.metadata: Body = {"name": KEY[1], "namespace": KEY[0], "uid": "u1", "resourceVersion": "7"}
        self.metadata["managedFields"] = list(entries)
        self.refusal = answer({"reason": "Conflict"}, 409)
        self.there = there
        self.refusals = refusals
        self.patches: list[dict[str, Any]] = []

    def __call__(self, request: Request) -> bytes:
        if not self.there:
            return answer({"reason": "NotFound"}, 404)
        if request.method == "PATCH":
            assert request.header("content-type") == "application/json-patch+json"
            if self.refusals:
                self.refusals -= 1
                return self.refusal
            self.patches.append({step["path"]: step["value"] for step in json.loads(request.body)})
        return answer({"metadata": self.metadata})


async def asked(server: Server) -> None:
    async with listening(HttpServer(server)) as access, contextlib.aclosing(Store(access)) as store:
        await store.take_ownership(DEPLOYMENT, KEY)


async def test_take_ownership_changes_only_own_fields() -> None:
    server = Server(CREATED, THEIRS, STATUS)
    await asked(server)
    (patch,) = server.patches
    assert patch["/metadata/resourceVersion"] == "7"
    assert patch["/metadata/managedFields"] == [THEIRS, STATUS, {**CREATED, "operation": "Apply"}]


async def test_take_ownership_merges_applied_fields() -> None:
    server = Server(APPLIED, CREATED)
    await asked(server)
    (entry,) = server.patches[0]["/metadata/managedFields"]
    assert entry["fieldsV1"] == {"f:spec": {"f:a": {}, "f:b": {"f:c": {}, "f:d": {}}}}


@pytest.mark.parametrize("entries", [(), (THEIRS,), (APPLIED, THEIRS, STATUS)])
async def test_take_ownership_writes_nothing_if_applied(entries: tuple[Body, ...]) -> None:
    server = Server(*entries)
    await asked(server)
    assert server.patches == []


async def test_take_ownership_ignores_deleted_object() -> None:
    await asked(Server(there=False))


async def test_take_ownership_retries_after_conflict() -> None:
    server = Server(CREATED, refusals=2)
    await asked(server)
    assert len(server.patches) == 1
    with pytest.raises(Conflict):
        await asked(Server(CREATED, refusals=3))


OBSERVED: Body = {
    "metadata": {"name": KEY[1], "namespace": KEY[0], "uid": "u1", "labels": {"theirs": "1", "ours": "1"}}
}
WANTED: Body = {
    "metadata": {"name": KEY[1], "labels": {"ours": "2"}, "annotations": {"signature": "s"}},
    "spec": {"a": 1},
}


async def rewritten(server: Server) -> None:
    async with listening(HttpServer(server)) as access, contextlib.aclosing(Store(access)) as store:
        await store.replace_spec(DEPLOYMENT, OBSERVED, WANTED)


async def test_replace_spec_keeps_foreign_labels() -> None:
    server = Server()
    await rewritten(server)
    assert server.patches == [
        {
            "/metadata/uid": "u1",
            "/metadata/labels": {"theirs": "1", "ours": "2"},
            "/metadata/annotations": {"signature": "s"},
            "/spec": {"a": 1},
        }
    ]


@pytest.mark.parametrize(("uid", "error"), [("u1", Invalid), ("u2", Conflict)])
async def test_replace_spec_detects_recreated_object(uid: str, error: type[KubeError]) -> None:
    server = Server(refusals=1)
    server.refusal = answer({"reason": "Invalid"}, 422)
    server.metadata["uid"] = uid
    with pytest.raises(KubeError) as raised:
        await rewritten(server)
    assert type(raised.value) is error
