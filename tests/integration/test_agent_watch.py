"""Watches of Grants and DirectLinks while the API server restarts, loses data, freezes, or compacts its storage."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest
from agent_pki import TestAuthority
from agent_server import ACCOUNTS, FRACTUS, NODE_GRANTS, RBAC, ApiServer, running
from fractus_agent import store as store_module
from fractus_agent.store import (
    Changed,
    Conflict,
    Deleted,
    Expired,
    GrantList,
    Invalid,
    KubeError,
    Listed,
    Store,
    WatchEvent,
    WatchTimes,
    connect,
)
from fractus_core.api.grants import ReportedGrant

pytestmark = [pytest.mark.timeout(300), pytest.mark.xdist_group("agent-watch")]  # the tests share one API server
WAIT_TIMEOUT_S = 30.0
WatchItem = TypeVar("WatchItem", WatchEvent, GrantList)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApiServer]:
    with running(tmp_path_factory.mktemp("plane")) as server:
        server.furnish(TestAuthority().pem)
        server.post("/api/v1/nodes", {"metadata": {"name": "drone-1"}})
        yield server


@pytest.fixture(autouse=True)
def credentials(server: ApiServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("KUBECONFIG", str(server.agent_kubeconfig))
    yield
    for collection in (f"{FRACTUS}/directlinks", f"{FRACTUS}/drones", f"{FRACTUS}/grants", NODE_GRANTS, ACCOUNTS):
        server.delete(collection)


def link(name: str, drone: str = "drone-1") -> dict[str, Any]:
    return {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "DirectLink",
        "metadata": {"name": name},
        "spec": {
            "drone": drone, "node": "edge-1", "application": {"namespace": "default", "name": "app", "uid": "a"},
            "technology": "WiFi", "pairing": {"mode": "adhoc", "networkId": "fleet"}, "range": 80, "bandwidth": 12,
            "position": {"lat": 39.36, "lon": 22.94}, "heuristic": {"kind": "max", "metric": "ingress-bandwidth"},
        },
    }  # fmt: skip


def add_grant(server: ApiServer, name: str, node: str = "drone-1") -> str:
    application = {"namespace": "default", "name": "app", "uid": "a"}
    body = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Grant",
        "metadata": {"name": name},
        "spec": {"node": node, "application": application, "component": "Navigator", "instance": f"app-{name}"},
    }
    return str(server.post(f"{FRACTUS}/grants", body)["metadata"]["uid"])


@contextlib.asynccontextmanager
async def store(**times: Any) -> AsyncIterator[Store]:
    made = Store(await connect(), "drone-1", WatchTimes(**({"first_retry_s": 0.1, "longest_retry_s": 1.0} | times)))
    try:
        yield made
    finally:
        await made.close()


async def following(events: AsyncIterator[WatchItem]) -> WatchItem:
    return await asyncio.wait_for(anext(events), WAIT_TIMEOUT_S)


async def until(events: AsyncIterator[WatchEvent], kind: type[WatchEvent]) -> WatchEvent:
    async with asyncio.timeout(WAIT_TIMEOUT_S):
        async for event in events:
            if isinstance(event, kind):
                return event
    raise AssertionError("the stream of events ended")


async def served(watched: Store) -> None:
    events = watched.direct_links("drone")
    await until(events, Listed)
    waiting = asyncio.ensure_future(anext(events))
    done, _ = await asyncio.wait([waiting], timeout=2.0)
    waiting.cancel()
    assert not done


def names(event: WatchEvent) -> set[str]:
    assert isinstance(event, Listed)
    return {g["metadata"]["name"] for g in event.objects}


async def test_watch_yields_a_list_and_then_changes_of_this_node_only(server: ApiServer) -> None:
    server.post(f"{FRACTUS}/directlinks", link("a"))
    server.post(f"{FRACTUS}/directlinks", link("other", "drone-2"))
    async with store() as watched:
        events = watched.direct_links("drone")
        assert names(await following(events)) == {"a"}
        server.post(f"{FRACTUS}/directlinks", link("other-2", "drone-2"))
        server.post(f"{FRACTUS}/directlinks", link("b"))
        event = await following(events)
        assert isinstance(event, Changed)
        assert event.object["metadata"]["name"] == "b"
        server.delete(f"{FRACTUS}/directlinks/a")
        assert await following(events) == Deleted("a")


async def test_expired_resource_version_leads_to_a_new_list(server: ApiServer) -> None:
    async with store() as watched:
        selector = {"fieldSelector": "spec.drone=drone-1"}
        links = store_module._WatchTarget(watched._client, store_module._KINDS["DirectLink"], selector)
        _, old = await watched._list(links)
        for number in range(3):
            server.post(f"{FRACTUS}/directlinks", link(f"g{number}"))
        server.stop_apiserver()
        server.start_apiserver()
        server.compact()
        # Custom resources are available a moment after the API server reports that it is ready.
        await served(watched)
        with pytest.raises(Expired):
            await until(watched._watch(links, old), Deleted)

        real = watched._list
        used = []

        async def stale_at_first(*of: Any) -> tuple[tuple[dict[str, Any], ...], str]:
            objects, version = await real(*of)
            used.append(version)
            return objects, old if len(used) == 1 else version

        watched._list = stale_at_first  # type: ignore[method-assign]
        events = watched.direct_links("drone")
        assert names(await following(events)) == {"g0", "g1", "g2"}
        assert names(await following(events)) == {"g0", "g1", "g2"}
        server.delete(f"{FRACTUS}/directlinks/g1")
        assert await following(events) == Deleted("g1")
        assert len(used) == 2


async def test_outage_yields_no_event_and_then_a_list(server: ApiServer) -> None:
    server.post(f"{FRACTUS}/directlinks", link("a"))
    server.post(f"{FRACTUS}/directlinks", link("b"))
    async with store() as watched:
        events = watched.direct_links("drone")
        assert names(await following(events)) == {"a", "b"}
        server.stop_apiserver()
        waiting = asyncio.ensure_future(anext(events))
        done, _ = await asyncio.wait([waiting], timeout=2.0)
        assert not done
        server.start_apiserver()
        server.delete(f"{FRACTUS}/directlinks/a")
        async with asyncio.timeout(WAIT_TIMEOUT_S):
            event = await waiting
            while not (isinstance(event, Listed) and names(event) == {"b"}) and event != Deleted("a"):
                event = await anext(events)


async def test_frozen_api_server_is_detected_by_its_silence(server: ApiServer) -> None:
    async with store(silence_s=1.0) as watched:
        events = watched.direct_links("drone")
        assert names(await following(events)) == set()
        with server.frozen():
            waiting = asyncio.ensure_future(anext(events))
            done, _ = await asyncio.wait([waiting], timeout=3.0)
            assert not done
        server.post(f"{FRACTUS}/directlinks", link("late"))
        async with asyncio.timeout(WAIT_TIMEOUT_S):
            event = await waiting
            while isinstance(event, Listed) and names(event) != {"late"}:
                event = await anext(events)


async def test_watch_ended_by_the_server_continues_without_a_list(server: ApiServer) -> None:
    async with store(server_s=2) as watched:
        events = watched.direct_links("drone")
        assert names(await following(events)) == set()
        waiting = asyncio.ensure_future(anext(events))
        done, _ = await asyncio.wait([waiting], timeout=3.5)
        assert not done, "the store listed all objects after the API server ended the watch normally"
        server.post(f"{FRACTUS}/directlinks", link("after"))
        event = await asyncio.wait_for(waiting, WAIT_TIMEOUT_S)
        assert isinstance(event, Changed)


async def nothing_from(granted: AsyncIterator[GrantList], for_s: float = 2.0) -> asyncio.Future[GrantList]:
    """Check that the stream yields nothing for a time in seconds. Return a future of its next list."""
    waiting = asyncio.ensure_future(anext(granted))
    done, _ = await asyncio.wait([waiting], timeout=for_s)
    assert not done
    return waiting


def named(granted: GrantList) -> set[str] | None:
    return None if granted.grants is None else {body["metadata"]["name"] for body in granted.grants}


async def test_grants_of_the_node_come_from_its_node_grants_object(server: ApiServer) -> None:
    uid = add_grant(server, "a")
    add_grant(server, "other", "drone-2")
    for node in ("drone-1", "drone-2"):
        server.publish(node)
    async with store() as watched:
        granted = watched.grants()
        first = await following(granted)
        assert named(first) == {"a"}
        assert first.grants is not None
        assert first.grants[0]["metadata"]["uid"] == uid
        add_grant(server, "b")
        server.publish("drone-1")
        second = await following(granted)
        assert (named(second), second.generation) == ({"a", "b"}, first.generation + 1)
        report = ReportedGrant(uid=uid, name="a", phase="Active", observed_generation=1)
        assert await watched.report_grants(second.generation, [report])
        assert server.reported("drone-1", "a")["phase"] == "Active"
        third = await following(granted)
        assert (named(third), third.reported) == (None, {uid: report}), "the store decoded unchanged Grants again"
        assert await watched.report_grants(second.generation, [])
        assert server.reported("drone-1", "a") == {}


async def test_missing_or_damaged_node_grants_object_removes_no_grant(server: ApiServer) -> None:
    async with store() as watched:
        granted = watched.grants()
        waiting = await nothing_from(granted)
        assert not await _reports(watched)
        add_grant(server, "a")
        server.publish("drone-1")
        assert named(await asyncio.wait_for(waiting, WAIT_TIMEOUT_S)) == {"a"}
        server.delete(f"{NODE_GRANTS}/drone-1")
        waiting = await nothing_from(granted)
        assert not await _reports(watched)
        server.publish("drone-1")
        assert named(await asyncio.wait_for(waiting, WAIT_TIMEOUT_S)) == {"a"}
        server.admin.merge(f"{NODE_GRANTS}/drone-1", {"spec": {"packed": "damaged"}})
        waiting = await nothing_from(granted)
        server.delete(f"{FRACTUS}/grants/a")
        server.publish("drone-1")
        assert named(await asyncio.wait_for(waiting, WAIT_TIMEOUT_S)) == set()


async def _reports(watched: Store) -> bool:
    try:
        return await watched.report_grants(1, [])
    except KubeError:
        return False


async def test_recreated_or_unauthorized_account_removes_no_grant(server: ApiServer) -> None:
    add_grant(server, "a")
    server.publish("drone-1")
    async with store(server_s=1) as watched:
        granted = watched.grants()
        assert named(await following(granted)) == {"a"}
        server.delete(f"{ACCOUNTS}/drone-1")
        waiting = await nothing_from(granted, 4.0)
        server.publish("drone-1")
        add_grant(server, "b")
        server.publish("drone-1")
        assert named(await asyncio.wait_for(waiting, WAIT_TIMEOUT_S)) == {"a", "b"}
        roles = f"{RBAC}/namespaces/fractus-nodes/rolebindings/drone-1"
        binding = server.get(roles)
        assert binding is not None
        server.delete(roles)
        waiting = await nothing_from(granted, 4.0)
        server.post(
            roles.rpartition("/")[0],
            {key: binding[key] for key in ("roleRef", "subjects")} | {"metadata": {"name": "drone-1"}},
        )
        server.delete(f"{FRACTUS}/grants/b")
        server.publish("drone-1")
        assert named(await asyncio.wait_for(waiting, WAIT_TIMEOUT_S)) == {"a"}


async def test_rotated_token_is_read_again(server: ApiServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    account = server.post("/api/v1/namespaces/fractus-system/serviceaccounts", {"metadata": {"name": "agent"}})
    server.post(
        "/apis/rbac.authorization.k8s.io/v1/clusterrolebindings",
        {
            "metadata": {"name": "agent-account"},
            "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": "agent"},
            "subjects": [{"kind": "ServiceAccount", "name": "agent", "namespace": "fractus-system"}],
        },
    )
    path = f"/api/v1/namespaces/fractus-system/serviceaccounts/{account['metadata']['name']}/token"
    token = server.post(path, {"spec": {"expirationSeconds": 600}})["status"]["token"]
    monkeypatch.delenv("KUBECONFIG")
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "127.0.0.1")
    monkeypatch.setenv("KUBERNETES_SERVICE_PORT", server.server.rsplit(":", 1)[1])
    for name, text in {"token": "expired", "namespace": "fractus-system", "ca.crt": server.ca.read_text()}.items():
        (tmp_path / name).write_text(text)
    used = Store(await connect(tmp_path), "drone-1")
    try:
        with pytest.raises(KubeError, match="Unauthorized"):
            await used.node_object("Drone")
        (tmp_path / "token").write_text(token)
        assert await used.node_object("Drone") is None
    finally:
        await used.close()


async def test_store_errors_have_distinct_types(server: ApiServer) -> None:
    drone: dict[str, Any] = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Drone",
        "metadata": {"name": "drone-1"},
        "spec": {},
    }
    async with store() as used:
        assert await used.node_object("Drone") is None
        assert await used.apply_status("Drone", "drone-1", {"flightState": "inactive"}) is None
        made = await used.create(drone)
        with pytest.raises(Conflict):
            await used.create(drone)
        with pytest.raises(Invalid, match="autonomy"):
            await used.replace(made | {"spec": {"autonomy": -5}})
        changed = await used.replace(made | {"spec": {"autonomy": 5}})
        with pytest.raises(Conflict):
            await used.replace(made | {"spec": {"autonomy": 6}})
        after = await used.apply_status("Drone", "drone-1", {"flightState": "flying"})
        assert after is not None
        assert after["spec"] == changed["spec"]
        assert after["status"]["flightState"] == "flying"
        server.stop_apiserver()
        try:
            with pytest.raises(KubeError):
                await used.node_object("Drone")
        finally:
            server.start_apiserver()
        assert await used.node_object("Drone") is not None
