"""Requests to the recording endpoint of a drone's agent, with the token of the caller."""

from __future__ import annotations

import asyncio
import json
import logging
import ssl
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from http import HTTPStatus

import aiohttp
from fractus_core.api import FlightPlan, InvalidObject, node_server_name
from fractus_core.api.flight_records import records_path
from fractus_core.api.nodes import DroneStatus
from fractus_runtime.kubernetes import Body, NotFound
from yarl import URL

from fractus_management.api_server import Caller, kind_of
from fractus_management.drone_routes import DRONE
from fractus_management.problem_details import Refused, refused

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 5.0
TIMEOUT_S = 30.0
PICTURE_TIMEOUT_S = 120.0
MAX_PAGE_BYTES = 4_000_000
"""Maximum size of a page of records. A larger one, as a compromised node may send, is refused. The API needs up to 170 MB to
parse it, for one page at a time."""

MAX_PICTURE_BYTES = 16_000_000
_MAX_PROBLEM_BYTES = 10_000
_CHUNK_BYTES = 64 * 1024
_PORTS = 65536

_FORWARDED = frozenset({400, 401, 403, 404, 409, 503})
"""Statuses of the agent that describe the request, or a state of the node."""


@dataclass(frozen=True, slots=True)
class RecordingNode:
    """The drone that has the records of a plan.

    Attributes:
        drone: Name of the drone.
        url: URL of the records of the plan at the agent.
        token: Token of the caller.
        context: TLS context that trusts the authority of the nodes.
    """

    drone: str
    url: URL
    token: str
    context: ssl.SSLContext

    async def page(self, records: str, query: Mapping[str, str]) -> bytes:
        """Return a page of records as JSON.

        Raises:
            Refused: The node refused the request, or does not respond.
        """
        async with self._response(self.url / records, query, TIMEOUT_S) as response:
            return await self._content(response, MAX_PAGE_BYTES)

    async def picture(self, id_: str, stack: AsyncExitStack) -> tuple[int, AsyncIterator[bytes]]:
        """Return the size and the parts of a picture.

        Args:
            id_: Id of the picture.
            stack: Closes the connection.

        Raises:
            Refused: The node refused the request, or does not respond.
        """
        url = self.url / "pictures" / id_
        response = await stack.enter_async_context(self._response(url, {}, PICTURE_TIMEOUT_S))
        size = response.content_length
        if size is None or size > MAX_PICTURE_BYTES or response.content_type != "image/jpeg":
            raise self._unusable("its response is not a picture")
        return size, response.content.iter_chunked(_CHUNK_BYTES)

    @asynccontextmanager
    async def _response(
        self, url: URL, query: Mapping[str, str], timeout_s: float
    ) -> AsyncIterator[aiohttp.ClientResponse]:
        """Send a request. The agent closes the connection after each response."""
        timeout = aiohttp.ClientTimeout(total=timeout_s, sock_connect=CONNECT_TIMEOUT_S)
        # Agents do not compress. A small compressed response of a compromised node could expand to any size.
        async with aiohttp.ClientSession(timeout=timeout, trust_env=False, auto_decompress=False) as session:
            try:
                response = await session.get(
                    url,
                    params=query,
                    headers={"Authorization": f"Bearer {self.token}", "Accept-Encoding": "identity"},
                    ssl=self.context,
                    server_hostname=node_server_name(self.drone),
                    allow_redirects=False,
                )
            except (aiohttp.ClientError, OSError, TimeoutError) as error:
                raise self._unreachable(error) from error
            async with response:
                if response.status != HTTPStatus.OK:
                    raise self._refusal(response.status, await self._content(response, _MAX_PROBLEM_BYTES))
                yield response

    async def _content(self, response: aiohttp.ClientResponse, max_bytes: int) -> bytes:
        content = bytearray()
        try:
            async for chunk in response.content.iter_chunked(_CHUNK_BYTES):
                content += chunk
                if len(content) > max_bytes:
                    raise self._unusable("its response is too large; use a lower limit")
        except (aiohttp.ClientError, OSError, TimeoutError) as error:
            raise self._unreachable(error) from error
        return bytes(content)

    def _refusal(self, status: int, content: bytes) -> Refused:
        try:
            problem = json.loads(content)
            reason = str(problem["reason"])
            message = str(problem["message"])
        except (ValueError, KeyError, TypeError, RecursionError):
            return self._unusable(f"its response has the status {status}")
        return refused(status, reason, message) if status in _FORWARDED else self._unusable(message)

    def _unreachable(self, error: BaseException) -> Refused:
        log.info("management: node not reached (drone=%s error=%s)", self.drone, error or type(error).__name__)
        message = f"{self.drone} does not respond, so its records cannot be read now; try again when it has contact"
        return refused(HTTPStatus.SERVICE_UNAVAILABLE, "NodeUnreachable", message)

    def _unusable(self, problem: str) -> Refused:
        log.warning("management: response of node not usable (drone=%s problem=%s)", self.drone, problem)
        message = f"the records of {self.drone} cannot be read: {problem}"
        return refused(HTTPStatus.SERVICE_UNAVAILABLE, "NodeInvalid", message)


async def recording_node(caller: Caller, namespace: str, name: str) -> RecordingNode:
    """Return the drone that has the records of a plan.

    Raises:
        Refused: The flight has not started, or the drone serves no records.
        KubeError: The caller may not read the plan or the drone, or the plan does not exist.
    """
    plan = await caller.client.get(kind_of(FlightPlan), name, namespace)
    status: Body = plan.get("status") or {}
    drone = status.get("drone")
    if not status.get("application") or not drone:
        message = f"the flight of {name} has not started, so it has no records; read them after the takeoff"
        raise refused(HTTPStatus.CONFLICT, "NotStarted", message)
    try:
        root = _root(await caller.client.get(DRONE, drone))
    except NotFound:
        message = f"the Drone {drone} was deleted, so the records of {name} cannot be found"
        raise refused(HTTPStatus.NOT_FOUND, "DroneDeleted", message) from None
    if root is None:
        message = (
            f"{drone} serves no records; an administrator can enable them with management.records.enabled of the chart"
        )
        raise refused(HTTPStatus.SERVICE_UNAVAILABLE, "RecordsNotServed", message)
    url = root / records_path(namespace, name, "").strip("/")
    return RecordingNode(drone, url, caller.token, await asyncio.to_thread(_context, caller))


def _root(drone: Body) -> URL | None:
    """Return the URL of the recording endpoint of a Drone, or None if it has none, or its address is invalid."""
    try:
        address = DroneStatus.model_validate(drone.get("status") or {}).records_address
        host, _, port = (address or "").rpartition(":")
        root = URL.build(scheme="https", host=host.strip("[]"), port=int(port))
    except (InvalidObject, ValueError):
        return None
    return root if host and int(port) < _PORTS else None


def _context(caller: Caller) -> ssl.SSLContext:
    """Return the TLS context. The authority is read for each request, because it may be replaced.

    Raises:
        Refused: The authority of the nodes is not configured, or cannot be read.
    """
    path = caller.settings.node_ca
    try:
        if path is None:
            raise FileNotFoundError("start the API with --node-ca")
        return ssl.create_default_context(cafile=path)
    except (OSError, ValueError) as error:
        log.warning("management: authority of nodes not usable (file=%s error=%s)", path, error)
        message = "this API cannot verify the certificates of drones; an administrator must set --node-ca to the file of their CA"
        raise refused(HTTPStatus.SERVICE_UNAVAILABLE, "NoAuthority", message) from error
