"""Fake API server: HTTP on a loopback port with scripted responses."""

from __future__ import annotations

import asyncio
import contextlib
import json
import ssl
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_runtime.kubernetes import Access, Client, with_certificate

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"


@dataclass(frozen=True)
class Request:
    """Received HTTP request."""

    head: str
    body: bytes

    @property
    def line(self) -> str:
        return self.head.splitlines()[0].rsplit(" ", 1)[0]

    @property
    def method(self) -> str:
        return self.line.split(" ")[0]

    def header(self, name: str) -> str:
        values = [value for key, _, value in (h.partition(": ") for h in self.head.splitlines()) if key.lower() == name]
        assert len(values) <= 1, values
        return values[0] if values else ""


def response(body: Any, status: int = 200) -> bytes:
    """Return a complete response with a JSON body."""
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    return b"HTTP/1.1 %d X\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n" % (status, len(data)) + data


def chunk(data: bytes) -> bytes:
    """Return one chunk of a chunked response."""
    return b"%x\r\n%s\r\n" % (len(data), data)


class Server:
    """Connection handler that sends a response to each request and keeps or closes the connection."""

    def __init__(
        self, responses: bytes | Callable[[Request], bytes], *, closes: bool = False, delay_s: float = 0.0
    ) -> None:
        self._responses = responses
        self._closes = closes
        self._delay_s = delay_s
        self.requests: list[Request] = []
        self.connections = 0
        self.url = ""
        self.request_received = asyncio.Event()
        self.connection_ended = asyncio.Event()

    async def __call__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = (await reader.readuntil(b"\r\n\r\n")).decode()
                length = Request(head, b"").header("content-length")
                request = Request(head, await reader.readexactly(int(length or 0)))
                self.requests.append(request)
                self.request_received.set()
                await asyncio.sleep(self._delay_s)
                writer.write(self._responses if isinstance(self._responses, bytes) else self._responses(request))
                if self._closes:
                    break
        self.connection_ended.set()
        writer.close()


@contextlib.asynccontextmanager
async def listening(server: Server, context: ssl.SSLContext | None = None) -> AsyncIterator[Access]:
    """Run the server on a free port. Yield the Access for clients."""
    listener = await asyncio.start_server(server, "127.0.0.1", 0, ssl=context)
    scheme = "https" if context else "http"
    server.url = f"{scheme}://127.0.0.1:{listener.sockets[0].getsockname()[1]}"
    try:
        async with asyncio.timeout(30.0):
            yield with_certificate(server.url)
    finally:
        listener.close()


@contextlib.asynccontextmanager
async def client_of(server: Server, **options: Any) -> AsyncIterator[Client]:
    """Run the server and yield a Client that is connected to it. `options` are passed to Client."""
    async with listening(server) as access, contextlib.aclosing(Client(access, "tests", **options)) as client:
        yield client


def kubeconfig_for(directory: Path, server: str, user: dict[str, Any], **cluster: Any) -> Path:
    """Write a kubeconfig with one cluster and one user, and return its path."""
    config = {
        "apiVersion": "v1", "kind": "Config", "current-context": "c",
        "clusters": [{"name": "c", "cluster": {"server": server, **cluster}}],
        "users": [{"name": "u", "user": user}],
        "contexts": [{"name": "c", "context": {"cluster": "c", "user": "u"}}],
    }  # fmt: skip
    path = directory / "config"
    path.write_text(json.dumps(config))
    return path
