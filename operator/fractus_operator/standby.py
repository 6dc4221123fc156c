"""Standby of an operator before it is the leader: waits for the custom resource kinds, and responds to health checks."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

from fractus_core.api import API_VERSION, KINDS

from fractus_operator.store import KubeError, NotFound, Store

log = logging.getLogger(__name__)

_KINDS_PERIOD_S = 2.0
_RESPONSE = b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_REQUEST_TIMEOUT_S = 5.0


async def wait_for_kinds(store: Store) -> None:
    """Wait until the API server serves every kind, because decisions need all of them.

    Health checks fail meanwhile, so that a rolling update keeps the pods of the previous release, which works without the new
    kinds.
    """
    logged = False
    while missing := await _missing_kinds(store):
        if not logged:
            log.warning("operator: waiting for kinds, upgrade the chart fractus-crds (missing=%s)", ",".join(missing))
            logged = True
        await asyncio.sleep(_KINDS_PERIOD_S)


async def _missing_kinds(store: Store) -> list[str]:
    try:
        served = (await store.request("GET", f"/apis/{API_VERSION}"))["resources"]
    except NotFound:
        served = []
    except KubeError:
        # The election waits for the API server.
        return []
    return sorted({kind.KIND for kind in KINDS} - {each["kind"] for each in served})


@asynccontextmanager
async def health_endpoint(health: str) -> AsyncIterator[None]:
    """Respond to health checks while the context lasts. Afterwards, kopf serves the same port.

    Args:
        health: URL of the endpoint.
    """
    address = urlsplit(health)
    server = await asyncio.start_server(_respond, address.hostname, address.port)
    try:
        yield
    finally:
        server.close()


async def _respond(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        async with asyncio.timeout(_REQUEST_TIMEOUT_S):
            await reader.readuntil(b"\r\n\r\n")
            writer.write(_RESPONSE)
            await writer.drain()
    except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
        pass
    finally:
        writer.close()
