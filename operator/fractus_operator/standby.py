"""Before an operator acts: it waits for its kinds, and answers health checks while another one has its turn."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

from fractus_core.api import API_VERSION, KINDS

from fractus_operator.cluster.store import KubeError, NotFound, Store

logger = logging.getLogger(__name__)

_KINDS_PERIOD_S = 2.0
_ANSWER = b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_REQUEST_TIMEOUT_S = 5.0


async def kinds_served(store: Store) -> None:
    """Wait until the API server has every kind, as decisions need them all.

    No health check is answered meanwhile, so that pods of a release before, which can decide, are not ended for this one.
    """
    told = False
    while missing := await _missing_kinds(store):
        if not told:
            logger.warning("operator: waits for kinds, upgrade the chart fractus-crds (missing=%s)", ",".join(missing))
            told = True
        await asyncio.sleep(_KINDS_PERIOD_S)


async def _missing_kinds(store: Store) -> list[str]:
    try:
        served = (await store.request("GET", f"/apis/{API_VERSION}"))["resources"]
    except NotFound:
        served = []
    except KubeError:
        # Who has the Lease waits for the API server.
        return []
    return sorted({kind.KIND for kind in KINDS} - {each["kind"] for each in served})


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
