"""Responses of a compromised agent to the management API."""

from __future__ import annotations

import asyncio
import gzip
import ssl
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import pytest
from agent_pki import TestAuthority
from fractus_agent.certificates import create_request
from fractus_management import node_records
from fractus_management.api_server import Caller
from fractus_management.node_records import RecordingNode, recording_node
from fractus_management.problem_details import Refused
from fractus_management.request_limits import RequestLimits
from fractus_management.settings import Settings
from fractus_runtime.kubernetes import Body, Client, Kind
from yarl import URL

Answers = Callable[[bytes], RecordingNode]


@pytest.fixture
async def answering(tmp_path: Path) -> AsyncIterator[Answers]:
    """Return a function that starts an agent with a fixed response, and returns the node."""
    authority = TestAuthority()
    key, request = create_request("drone-1")
    (tmp_path / "key").write_bytes(key)
    (tmp_path / "crt").write_bytes(authority.sign(request))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(tmp_path / "crt", tmp_path / "key")
    response = b""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(response)
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0, ssl=context)
    port = server.sockets[0].getsockname()[1]
    trusted = ssl.create_default_context(cadata=authority.pem.decode())

    def node(content: bytes) -> RecordingNode:
        nonlocal response
        response = content
        return RecordingNode("drone-1", URL(f"https://127.0.0.1:{port}/v1"), "token", trusted)

    yield node
    server.close()


def http(status: str, body: bytes, *headers: str) -> bytes:
    lines = [f"HTTP/1.1 {status}", f"Content-Length: {len(body)}", "Connection: close", *headers]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


@pytest.mark.parametrize(
    ("response", "status", "reason"),
    [
        (http("403 Forbidden", b'{"reason": "Forbidden", "message": "no"}'), 403, "Forbidden"),
        (http("409 Conflict", b'{"reason": "NoFlight", "message": "no"}'), 409, "NoFlight"),
        (http("403 Forbidden", b"<html>"), 503, "NodeInvalid"),
        (http("418 Teapot", b'{"reason": "x", "message": "y"}'), 503, "NodeInvalid"),
        (http("302 Found", b"", "Location: http://127.0.0.1:1/"), 503, "NodeInvalid"),
        (http("500 Error", b"[" * 5000), 503, "NodeInvalid"),
        (http("200 OK", b"x" * 2000), 503, "NodeInvalid"),
        (http("200 OK", b"x" * 2000)[:900], 503, "NodeUnreachable"),
        (b"garbage", 503, "NodeUnreachable"),
    ],
    ids=["refused", "no-flight", "not-json", "status", "redirect", "nested", "large", "cut-off", "garbage"],
)
async def test_response_of_the_agent_becomes_a_documented_problem(
    answering: Answers, monkeypatch: pytest.MonkeyPatch, response: bytes, status: int, reason: str
) -> None:
    monkeypatch.setattr(node_records, "MAX_PAGE_BYTES", 1000)
    with pytest.raises(Refused) as refusal:
        await answering(response).page("verdicts", {"limit": "1"})
    assert (refusal.value.status, refusal.value.reasons[0].reason) == (status, reason)


@pytest.mark.parametrize(
    "response",
    [
        http("200 OK", b"<script>", "Content-Type: text/html"),
        http("200 OK", b"", "Content-Type: image/jpeg").replace(b"Content-Length: 0", b"Content-Length: 16000001"),
        b"HTTP/1.1 200 OK\r\nContent-Type: image/jpeg\r\nConnection: close\r\n\r\nx",
    ],
    ids=["type", "large", "unknown-size"],
)
async def test_response_that_is_no_picture_of_known_size_is_refused(answering: Answers, response: bytes) -> None:
    async with AsyncExitStack() as stack:
        with pytest.raises(Refused) as refusal:
            await answering(response).picture("1-2-3", stack)
    assert refusal.value.reasons[0].reason == "NodeInvalid"


async def test_compressed_response_is_not_expanded(answering: Answers) -> None:
    body = gzip.compress(b" " * 5_000_000)
    headers = ("Content-Type: image/jpeg", "Content-Encoding: gzip")
    node = answering(http("200 OK", body, *headers))
    assert await node.page("verdicts", {}) == body
    async with AsyncExitStack() as stack:
        size, parts = await node.picture("1-2-3", stack)
        assert size == len(b"".join([part async for part in parts])) == len(body)


@dataclass
class Objects:
    """Fake of the API server: a plan that flies with drone-1, which reports an address."""

    address: str

    async def get(self, kind: Kind, _name: str, _namespace: str = "") -> Body:
        if kind.name == "FlightPlan":
            return {"status": {"drone": "drone-1", "application": "flight-x"}}
        return {"status": {"recordsAddress": self.address}}


@pytest.mark.parametrize(
    "address", ["", "host", ":1", "host:", "host:x", "host:99999", "user@host:1", "host/path:1", "a b:1", "h?x:1"]
)
async def test_invalid_address_of_a_drone_is_no_internal_error(tmp_path: Path, address: str) -> None:
    settings = Settings(node_ca=tmp_path / "ca.crt")
    caller = Caller(cast("Client", Objects(address)), settings, RequestLimits(settings), "token", b"")
    with pytest.raises(Refused) as refusal:
        await recording_node(caller, "team", "survey-1")
    assert (refusal.value.status, refusal.value.reasons[0].reason) == (503, "RecordsNotServed")
