"""The operator's HTTP below its client: what arrives, what is torn, what never answers."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import ssl
from collections.abc import AsyncIterator
from pathlib import Path

import httpx2
import pytest
from fractus_operator.cluster.store import Store
from fractus_operator.cluster.transport import AiohttpTransport

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"


class Server:
    """Answers each request with bytes, and then keeps the connection or closes it."""

    def __init__(self, answer: bytes, *, closes: bool = False) -> None:
        self.answer, self.closes = answer, closes
        self.requests: list[bytes] = []
        self.connections = 0
        self.heard, self.gone = asyncio.Event(), asyncio.Event()

    async def __call__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                length = next(
                    (
                        int(line.split(b":")[1])
                        for line in head.splitlines()
                        if line.lower().startswith(b"content-length")
                    ),
                    0,
                )
                self.requests.append(head + await reader.readexactly(length))
                self.heard.set()
                writer.write(self.answer)
                if self.closes:
                    break
        self.gone.set()
        writer.close()


@contextlib.asynccontextmanager
async def client_of(server: Server, **timeouts: float) -> AsyncIterator[httpx2.AsyncClient]:
    listener = await asyncio.start_server(server, "127.0.0.1", 0)
    port = listener.sockets[0].getsockname()[1]
    transport = AiohttpTransport(ssl.create_default_context())
    timeout = httpx2.Timeout(20.0, **timeouts)
    async with (
        asyncio.timeout(30.0),
        httpx2.AsyncClient(base_url=f"http://127.0.0.1:{port}", transport=transport, timeout=timeout) as client,
    ):
        yield client
    listener.close()


async def test_a_request_arrives_as_it_is_and_connections_are_kept() -> None:
    server = Server(HEAD + b"Content-Length: 10\r\n\r\n" + b'{"a": [1]}')
    async with client_of(server) as client:
        for _ in range(3):
            params = {"labelSelector": "a=b/c,d", "fieldManager": "x"}
            response = await client.request("POST", "/apis/one", params=params, content="{}", headers={"X-One": "two"})
            assert response.status_code == 200
            assert response.json() == {"a": [1]}
    assert server.connections == 1
    request = server.requests[0].decode()
    assert request.startswith("POST /apis/one?labelSelector=a%3Db%2Fc%2Cd&fieldManager=x HTTP/1.1\r\n")
    assert request.lower().count("content-length:") == request.lower().count("host:") == 1
    assert "X-One: two\r\n" in request or "x-one: two\r\n" in request
    assert request.endswith("\r\n\r\n{}")


async def test_what_is_compressed_is_read() -> None:
    data = gzip.compress(b'{"items": []}')
    head = HEAD + b"Content-Encoding: gzip\r\nContent-Length: %d\r\n\r\n" % len(data)
    async with client_of(Server(head + data)) as client:
        assert (await client.get("/")).json() == {"items": []}


async def test_a_stream_comes_as_it_is_sent_and_ends_with_its_reader() -> None:
    server = Server(CHUNKED + b"4\r\nab\nc\r\n")
    async with client_of(server) as client:
        async with client.stream("GET", "/") as response:
            assert await anext(response.aiter_lines()) == "ab"
        await server.gone.wait()


async def test_a_stream_that_is_cut_is_an_error() -> None:
    async with client_of(Server(CHUNKED + b"4\r\nab\n", closes=True)) as client, client.stream("GET", "/") as response:
        with pytest.raises(httpx2.RemoteProtocolError):
            await response.aread()


async def test_a_connection_that_is_closed_without_an_answer_is_an_error() -> None:
    async with client_of(Server(b"", closes=True)) as client:
        with pytest.raises(httpx2.RemoteProtocolError):
            await client.post("/")


@pytest.mark.parametrize(
    "answer",
    [b"", CHUNKED + b"4\r\nab\nc\r\n", CHUNKED + b"4\r\nab\nc\r\nHTTP/1.1 502 Bad Gateway\r\n\r\n"],
    ids=["no answer", "silent stream", "no chunk"],
)
async def test_silence_is_a_time_out(answer: bytes) -> None:
    async with client_of(Server(answer), read=0.2) as client:
        with pytest.raises((httpx2.ReadTimeout, httpx2.RemoteProtocolError)):
            await client.get("/")


async def test_nobody_there_is_an_error() -> None:
    async with client_of(Server(b"")) as client:
        with pytest.raises(httpx2.ConnectError):
            await client.get("http://127.0.0.1:1/")


async def test_a_request_that_is_given_up_leaves_no_connection() -> None:
    server = Server(b"")
    async with client_of(server) as client:
        request = asyncio.create_task(client.get("/"))
        await server.heard.wait()
        request.cancel()
        with pytest.raises(asyncio.CancelledError):
            await request
        await server.gone.wait()


@pytest.mark.parametrize(("proxy", "ours"), [(None, True), ("http://127.0.0.1:9", False)])
async def test_a_proxy_of_the_environment_is_left_to_httpx2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, proxy: str | None, ours: bool
) -> None:
    """aiohttp below knows nothing of it."""
    for name in ("http_proxy", "https_proxy", "all_proxy", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    if proxy is not None:
        monkeypatch.setenv("HTTPS_PROXY", proxy)
    config = {
        "apiVersion": "v1", "kind": "Config", "current-context": "c",
        "clusters": [{"name": "c", "cluster": {"server": "https://127.0.0.1:1"}}],
        "users": [{"name": "u", "user": {"token": "t"}}],
        "contexts": [{"name": "c", "context": {"cluster": "c", "user": "u"}}],
    }  # fmt: skip
    (tmp_path / "config").write_text(json.dumps(config))
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "config"))
    store = Store.connect()
    try:
        assert isinstance(store._client._transport, AiohttpTransport) is ours
    finally:
        await store.close()
