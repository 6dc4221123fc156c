"""Answers health checks while another operator acts: a pod that waits for its turn is ready to take over."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

_ANSWER = b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_REQUEST_TIMEOUT_S = 5.0


@asynccontextmanager
async def standing_by(health: str) -> AsyncIterator[None]:
    """Answer on the port of the liveness endpoint, and leave it to that afterwards.

    Args:
        health: URL of the endpoint.
    """
    address = urlsplit(health)
    server = await asyncio.start_server(_answer, address.hostname, address.port)
    try:
        yield
    finally:
        server.close()


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        async with asyncio.timeout(_REQUEST_TIMEOUT_S):
            await reader.readuntil(b"\r\n\r\n")
            writer.write(_ANSWER)
            await writer.drain()
    except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
        pass
    finally:
        writer.close()
