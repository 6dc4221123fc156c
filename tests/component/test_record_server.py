"""Recording endpoint of the agent over TLS, with a fake API server."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import pytest
from agent_pki import TestAuthority
from aiohttp import ClientSession
from flight_log import DRIVER, NAMESPACE, VIEWER, call, flight_plan, grant, state, write_log, write_pictures
from fractus_agent.certificates import create_request
from fractus_agent.identity import NodeIdentity
from fractus_agent.records import record_server
from fractus_agent.records.audit_records import Page
from fractus_agent.records.record_server import RecordServer
from fractus_agent.store import KubeError, Object
from fractus_cluster.ports import free_port
from fractus_runtime.files import write_set

ROOT = f"/v1/namespaces/{NAMESPACE}/plans/survey-1"


@dataclass
class Plans:
    """Fake of the API server: the holder of the token `alice` may read the records of one plan."""

    plan: Object = field(default_factory=flight_plan)
    error: KubeError | None = None
    asked: list[tuple[str, str]] = field(default_factory=list)

    async def plan_with_records(self, token: str, namespace: str, name: str) -> Object:
        self.asked.append((namespace, name))
        if self.error is not None:
            raise self.error
        if token != "alice":
            raise KubeError(401, "Unauthorized", "Unauthorized")
        if (namespace, name) != (NAMESPACE, "survey-1"):
            raise KubeError(403, "Forbidden", "you may not read the records")
        return self.plan


@dataclass
class Identity:
    """Fake of the node's certificate."""

    ready: asyncio.Event = field(default_factory=asyncio.Event)
    serial: int = 1


@dataclass
class Endpoint:
    """A running endpoint."""

    port: int
    plans: Plans
    identity: Identity
    state: Path
    authority: TestAuthority

    def certify(self, node: str = "drone-1") -> None:
        key, request = create_request(node)
        files = {"tls.crt": self.authority.sign(request), "tls.key": key, "ca.crt": self.authority.pem}
        write_set(self.state / "tls", files)
        self.identity.serial += 1
        self.identity.ready.set()

    async def get(self, path: str, token: str = "alice", *, node: str = "drone-1") -> tuple[int, Any]:
        context = ssl.create_default_context(cadata=self.authority.pem.decode())
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        url = f"https://127.0.0.1:{self.port}{path}"
        async with (
            ClientSession() as session,
            session.get(url, headers=headers, ssl=context, server_hostname=f"{node}.node.fractus.dev") as response,
        ):
            if response.content_type == "application/json":
                return response.status, await response.json()
            return response.status, await response.read()


@pytest.fixture
async def endpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Endpoint]:
    monkeypatch.setattr(record_server, "ACCEPT_INTERVAL_S", 0.001)
    endpoint = Endpoint(free_port(), Plans(), Identity(), tmp_path, TestAuthority())
    endpoint.certify()
    server = RecordServer(f"127.0.0.1:{endpoint.port}", "drone-1", tmp_path, tmp_path / "tls", endpoint.plans)
    running = asyncio.create_task(server.run(cast("NodeIdentity", endpoint.identity)))
    async with asyncio.timeout(10):
        while True:
            try:
                _, writer = await asyncio.open_connection("127.0.0.1", endpoint.port)
            except OSError:
                await asyncio.sleep(0.01)
            else:
                writer.close()
                break
    yield endpoint
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


async def test_records_of_the_flight_are_returned(endpoint: Endpoint) -> None:
    audit = endpoint.state / "audit"
    write_log(audit / "mobility.jsonl", [grant(0, DRIVER), call(1, DRIVER), state(2), state(3)])
    pictures = endpoint.state / "recordings" / "camera"
    write_pictures(pictures / "000001-20260601T120000Z.mcap", [(1, f"u/{VIEWER}", b"\xff\xd8 picture")])
    status, verdicts = await endpoint.get(f"{ROOT}/verdicts")
    assert (status, [verdict["component"] for verdict in verdicts["items"]]) == (200, ["Navigator"])
    status, first = await endpoint.get(f"{ROOT}/track?limit=1")
    assert (status, first["items"][0]["lat"], first["items"][0]["inAir"]) == (200, 39.36, True)
    _, second = await endpoint.get(f"{ROOT}/track?limit=1&continue={first['continue']}")
    assert (len(second["items"]), "continue" in second) == (1, False)
    _, listed = await endpoint.get(f"{ROOT}/pictures")
    assert await endpoint.get(f"{ROOT}/pictures/{listed['items'][0]['id']}") == (200, b"\xff\xd8 picture")
    assert (await endpoint.get(f"{ROOT}/pictures/1-2-3"))[0] == 404


@pytest.mark.parametrize("token", ["", "bob", "a b", "alice;"])
async def test_request_without_valid_token_is_refused(endpoint: Endpoint, token: str) -> None:
    status, body = await endpoint.get(f"{ROOT}/verdicts", token)
    assert (status, body["reason"]) == (401, "Unauthorized")


async def test_records_of_other_plans_are_refused(endpoint: Endpoint) -> None:
    for path in (f"/v1/namespaces/{NAMESPACE}/plans/other/track", "/v1/namespaces/other/plans/survey-1/track"):
        assert (await endpoint.get(path))[0] == 403
    endpoint.plans.plan = flight_plan(drone="drone-2")
    status, body = await endpoint.get(f"{ROOT}/track")
    assert (status, body["reason"]) == (409, "NoFlight")


@pytest.mark.parametrize(
    "path",
    [
        "/", "/v1/namespaces/%2e%2e/plans/survey-1/track", "/v1/namespaces/team/plans/%2e%2e/track",
        "/v1/namespaces/team/plans/..%2fx/track", "/v1/namespaces/team/plans/a%3Fb/track", f"{ROOT}/track/..%2fverdicts",
        f"{ROOT}/pictures/..%2f..%2fetc%2fpasswd", f"{ROOT}/pictures/%00",
    ],
)  # fmt: skip
async def test_hostile_path_reaches_no_file_and_no_other_object(endpoint: Endpoint, path: str) -> None:
    (endpoint.state / "recordings" / "camera").mkdir(parents=True)
    assert (await endpoint.get(path))[0] == 404
    assert set(endpoint.plans.asked) <= {(NAMESPACE, "survey-1")}


@pytest.mark.parametrize(
    "query", ["limit=0", "limit=501", "limit=-1", "limit=1e9", "limit=" + "9" * 4000, "continue=x"]
)
async def test_invalid_paging_is_refused(endpoint: Endpoint, query: str) -> None:
    for records in ("verdicts", "track", "pictures"):
        (endpoint.state / "recordings" / "camera").mkdir(parents=True, exist_ok=True)
        status, body = await endpoint.get(f"{ROOT}/{records}?{query}")
        assert (status, query.partition("=")[0] in body["message"]) == (400, True)


async def test_records_are_refused_while_the_api_server_does_not_respond(endpoint: Endpoint) -> None:
    for error in (
        KubeError(0, "Unreachable", "no route"),
        KubeError(500, "InternalError", "x"),
        KubeError(429, "x", "x"),
    ):
        endpoint.plans.error = error
        status, body = await endpoint.get(f"{ROOT}/verdicts")
        assert (status, body["reason"]) == (503, "Unreachable")
        assert "cannot check your permission" in body["message"]


async def test_missing_recordings_are_explained(endpoint: Endpoint) -> None:
    status, body = await endpoint.get(f"{ROOT}/pictures")
    assert (status, body["reason"]) == (404, "NotRecorded")
    assert "camera.recordings.enabled" in body["message"]


async def test_other_methods_are_refused(endpoint: Endpoint) -> None:
    context = ssl.create_default_context(cadata=endpoint.authority.pem.decode())
    async with ClientSession() as session:
        for method in ("POST", "DELETE", "HEAD"):
            url = f"https://127.0.0.1:{endpoint.port}{ROOT}/track"
            name = "drone-1.node.fractus.dev"
            async with session.request(method, url, ssl=context, server_hostname=name) as response:
                assert response.status == 405


async def test_renewed_certificate_is_used(endpoint: Endpoint) -> None:
    endpoint.certify("drone-2")
    assert (await endpoint.get(f"{ROOT}/track", node="drone-2"))[0] == 200
    (endpoint.state / "tls" / "tls.crt").unlink()
    endpoint.identity.serial += 1
    assert (await endpoint.get(f"{ROOT}/track", node="drone-2"))[0] == 200


async def test_certificate_that_could_not_be_read_is_read_again(endpoint: Endpoint) -> None:
    assert (await endpoint.get(f"{ROOT}/track"))[0] == 200
    (endpoint.state / "tls" / "tls.crt").unlink()
    endpoint.identity.serial += 1
    assert (await endpoint.get(f"{ROOT}/track"))[0] == 200
    endpoint.identity.serial -= 1
    endpoint.certify("drone-2")
    assert (await endpoint.get(f"{ROOT}/track", node="drone-2"))[0] == 200


async def test_idle_connections_keep_no_caller_out(endpoint: Endpoint) -> None:
    context = ssl.create_default_context(cadata=endpoint.authority.pem.decode())
    name = "drone-1.node.fractus.dev"
    async with asyncio.timeout(30):
        plain = [await asyncio.open_connection("127.0.0.1", endpoint.port) for _ in range(20)]
        idle = [
            await asyncio.open_connection("127.0.0.1", endpoint.port, ssl=context, server_hostname=name)
            for _ in range(record_server.MAX_CONNECTIONS + 8)
        ]
        assert (await endpoint.get(f"{ROOT}/track"))[0] == 200
        assert [await reader.read(1) for reader, _ in idle[:8]] == [b""] * 8
        for _, writer in plain + idle:
            writer.close()


async def test_records_are_read_for_one_request_at_a_time(endpoint: Endpoint, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record_server, "TURN_TIMEOUT_S", 0.1)
    loop = asyncio.get_running_loop()
    release = asyncio.Event()

    def slow(*_: object) -> Page[Any]:
        asyncio.run_coroutine_threadsafe(release.wait(), loop).result(20)
        return Page([], None)

    monkeypatch.setattr(record_server, "read_track", slow)
    first = asyncio.create_task(endpoint.get(f"{ROOT}/track"))
    await asyncio.sleep(0.3)
    status, body = await endpoint.get(f"{ROOT}/verdicts")
    assert (status, body["reason"]) == (503, "NodeBusy")
    release.set()
    assert (await first)[0] == 200
    assert (await endpoint.get(f"{ROOT}/verdicts"))[0] == 200


async def request_without_reading(endpoint: Endpoint, path: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Send a request, and receive only the first bytes of its response."""
    context = ssl.create_default_context(cadata=endpoint.authority.pem.decode())
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect(("127.0.0.1", endpoint.port))
    reader, writer = await asyncio.open_connection(
        sock=connection, ssl=context, server_hostname="drone-1.node.fractus.dev", limit=1024
    )
    writer.write(f"GET {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer alice\r\n\r\n".encode())
    assert (await reader.readexactly(12)).endswith(b"200")
    return reader, writer


@pytest.fixture
async def large_picture(endpoint: Endpoint) -> str:
    """Path of a picture that is larger than the buffers of a connection."""
    recorded = endpoint.state / "recordings" / "camera" / "000001-20260601T120000Z.mcap"
    write_pictures(recorded, [(1, f"u/{VIEWER}", b"\xff\xd8" + bytes(5_500_000))])
    _, listed = await endpoint.get(f"{ROOT}/pictures")
    return f"{ROOT}/pictures/{listed['items'][0]['id']}"


async def test_slow_caller_keeps_no_other_caller_out(
    endpoint: Endpoint, large_picture: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_server, "TURN_TIMEOUT_S", 1.0)
    _, writer = await request_without_reading(endpoint, large_picture)
    assert (await endpoint.get(f"{ROOT}/track"))[0] == 200
    status, picture = await endpoint.get(large_picture)
    assert (status, len(picture)) == (200, 5_500_002)
    writer.close()


@pytest.mark.parametrize(("limit", "value"), [("MAX_TRANSFERS", 1), ("MAX_UNSENT_BYTES", 6_000_000)])
async def test_oldest_transfer_is_aborted_for_another_one(
    endpoint: Endpoint, large_picture: str, monkeypatch: pytest.MonkeyPatch, limit: str, value: int
) -> None:
    monkeypatch.setattr(record_server, limit, value)
    reader, writer = await request_without_reading(endpoint, large_picture)
    assert (await endpoint.get(large_picture))[0] == 200
    received = 0
    with contextlib.suppress(OSError):
        while chunk := await asyncio.wait_for(reader.read(65536), 20):
            received += len(chunk)
    assert received < 5_500_000
    writer.close()
