"""Following grants against an API server that restarts, forgets, freezes and compacts."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
from agent_pki import TestAuthority
from agent_server import FRACTUS, ApiServer, running
from fractus_agent.cluster import store as store_module
from fractus_agent.cluster.store import (
    Changed,
    Conflict,
    Deleted,
    Event,
    Expired,
    Invalid,
    KubeError,
    Listed,
    Store,
    WatchTimes,
    connect,
)

pytestmark = [pytest.mark.timeout(300), pytest.mark.xdist_group("agent-watch")]  # they share an API server
WAIT_TIMEOUT_S = 30.0


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApiServer]:
    with running(tmp_path_factory.mktemp("plane")) as server:
        server.furnish(TestAuthority().pem)
        yield server


@pytest.fixture(autouse=True)
def credentials(server: ApiServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("KUBECONFIG", str(server.agent_kubeconfig))
    yield
    server.delete(f"{FRACTUS}/grants")
    server.delete(f"{FRACTUS}/drones")


def grant(name: str, node: str = "drone-1") -> dict[str, Any]:
    application = {"namespace": "default", "name": "app", "uid": "a"}
    return {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Grant",
        "metadata": {"name": name},
        "spec": {"node": node, "application": application, "component": "Navigator", "instance": f"app-{name}"},
    }


@contextlib.asynccontextmanager
async def store(**times: Any) -> AsyncIterator[Store]:
    made = Store(await connect(), "drone-1", WatchTimes(**({"first_retry_s": 0.1, "longest_retry_s": 1.0} | times)))
    try:
        yield made
    finally:
        await made.close()


async def following(events: AsyncIterator[Event]) -> Event:
    return await asyncio.wait_for(anext(events), WAIT_TIMEOUT_S)


async def until(events: AsyncIterator[Event], wanted: type[Event]) -> Event:
    async with asyncio.timeout(WAIT_TIMEOUT_S):
        async for event in events:
            if isinstance(event, wanted):
                return event
    raise AssertionError("the events ended")


async def served(watched: Store) -> None:
    events = watched.grants()
    await until(events, Listed)
    waiting = asyncio.ensure_future(anext(events))
    done, _ = await asyncio.wait([waiting], timeout=2.0)
    waiting.cancel()
    assert not done


def names(event: Event) -> set[str]:
    assert isinstance(event, Listed)
    return {g["metadata"]["name"] for g in event.objects}


async def test_a_list_then_changes_of_this_node_only(server: ApiServer) -> None:
    server.post(f"{FRACTUS}/grants", grant("a"))
    server.post(f"{FRACTUS}/grants", grant("other", "drone-2"))
    async with store() as watched:
        events = watched.grants()
        assert names(await following(events)) == {"a"}
        server.post(f"{FRACTUS}/grants", grant("other-2", "drone-2"))
        server.post(f"{FRACTUS}/grants", grant("b"))
        event = await following(events)
        assert isinstance(event, Changed)
        assert event.object["metadata"]["name"] == "b"
        server.delete(f"{FRACTUS}/grants/a")
        assert await following(events) == Deleted("a")


async def test_an_expired_version_leads_to_a_list(server: ApiServer) -> None:
    async with store() as watched:
        grants = store_module._KINDS["Grant"], watched._own("node")
        _, old = await watched._list(*grants)
        for number in range(3):
            server.post(f"{FRACTUS}/grants", grant(f"g{number}"))
        server.stop_apiserver()
        server.start_apiserver()
        server.compact()
        # Storage of the kinds comes up a moment after the server says it is ready.
        await served(watched)
        with pytest.raises(Expired):
            await until(watched._watch(*grants, old), Deleted)

        real, used = watched._list, []

        async def stale_at_first(*of: Any) -> tuple[tuple[dict[str, Any], ...], str]:
            objects, version = await real(*of)
            used.append(version)
            return objects, old if len(used) == 1 else version

        watched._list = stale_at_first  # type: ignore[method-assign]
        events = watched.grants()
        assert names(await following(events)) == {"g0", "g1", "g2"}
        assert names(await following(events)) == {"g0", "g1", "g2"}
        server.delete(f"{FRACTUS}/grants/g1")
        assert await following(events) == Deleted("g1")
        assert len(used) == 2


async def test_an_outage_yields_nothing_and_then_a_list(server: ApiServer) -> None:
    server.post(f"{FRACTUS}/grants", grant("a"))
    server.post(f"{FRACTUS}/grants", grant("b"))
    async with store() as watched:
        events = watched.grants()
        assert names(await following(events)) == {"a", "b"}
        server.stop_apiserver()
        waiting = asyncio.ensure_future(anext(events))
        done, _ = await asyncio.wait([waiting], timeout=2.0)
        assert not done
        server.start_apiserver()
        server.delete(f"{FRACTUS}/grants/a")
        async with asyncio.timeout(WAIT_TIMEOUT_S):
            event = await waiting
            while not (isinstance(event, Listed) and names(event) == {"b"}) and event != Deleted("a"):
                event = await anext(events)


async def test_a_frozen_server_is_noticed_by_its_silence(server: ApiServer) -> None:
    async with store(silence_s=1.0) as watched:
        events = watched.grants()
        assert names(await following(events)) == set()
        with server.frozen():
            waiting = asyncio.ensure_future(anext(events))
            done, _ = await asyncio.wait([waiting], timeout=3.0)
            assert not done
        server.post(f"{FRACTUS}/grants", grant("late"))
        async with asyncio.timeout(WAIT_TIMEOUT_S):
            event = await waiting
            while isinstance(event, Listed) and names(event) != {"late"}:
                event = await anext(events)


async def test_a_watch_that_the_server_ends_goes_on_where_it_was(server: ApiServer) -> None:
    async with store(server_s=2) as watched:
        events = watched.grants()
        assert names(await following(events)) == set()
        waiting = asyncio.ensure_future(anext(events))
        done, _ = await asyncio.wait([waiting], timeout=3.5)
        assert not done, "a clean end is no reason to list again"
        server.post(f"{FRACTUS}/grants", grant("after"))
        event = await asyncio.wait_for(waiting, WAIT_TIMEOUT_S)
        assert isinstance(event, Changed)


async def test_a_rotated_token_is_read_again(
    server: ApiServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
            await used.described("Drone")
        (tmp_path / "token").write_text(token)
        assert await used.described("Drone") is None
    finally:
        await used.close()


async def test_errors_come_by_what_to_do_about_them(server: ApiServer) -> None:
    drone: dict[str, Any] = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Drone",
        "metadata": {"name": "drone-1"},
        "spec": {},
    }
    async with store() as used:
        assert await used.described("Drone") is None
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
                await used.described("Drone")
        finally:
            server.start_apiserver()
        assert await used.described("Drone") is not None
