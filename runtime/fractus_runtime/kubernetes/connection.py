"""Connection to the API server: requests through the official client (kubernetes.aio, aiohttp) with timeouts."""

from __future__ import annotations

import asyncio
import json
import math
import socket
import ssl
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from enum import StrEnum
from http import HTTPStatus
from urllib.parse import urlencode
from urllib.request import getproxies_environment

import aiohttp
from kubernetes.aio.client.rest import RESTClientObject
from kubernetes.aio.config import ConfigException

from fractus_runtime.kubernetes.access import Access, Unconfigured
from fractus_runtime.kubernetes.errors import KubeError, from_status, unreachable
from fractus_runtime.kubernetes.objects import Body, parse_response

REQUEST_TIMEOUT_S = 15.0
MAX_CONNECTIONS = 100
_KEPT_OPEN_S = 60.0
"""Time for which idle connections are kept, shorter than the 90 s of the API server. A new connection costs a TLS handshake."""
_KEEPALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}
"""TCP keep-alive that detects a dead connection after 25 s."""
_FAILURES = (aiohttp.ClientError, TimeoutError, OSError, ConfigException, Unconfigured)


class ContentType(StrEnum):
    """Content type of a request body."""

    JSON = "application/json"
    APPLY = "application/apply-patch+yaml"
    MERGE = "application/merge-patch+json"
    JSON_PATCH = "application/json-patch+json"


class Connection:
    """Sends requests to paths of the API server.

    Every request ends within its timeout, with a response or a KubeError.

    Args:
        access: Address and credentials of the API server.
        field_manager: Owner of the written fields.
        may_write_s: Returns the seconds for which writes may still take effect. 0 if another process may write instead.
        trust_env: Use the proxies of the environment.
        max_connections: Maximum number of connections. Each open watch occupies one.

    Attributes:
        succeeded_at: Monotonic time of the last response that reported success.

    Raises:
        Unconfigured: A certificate or key cannot be read.
    """

    def __init__(
        self,
        access: Access,
        field_manager: str,
        *,
        may_write_s: Callable[[], float] = lambda: REQUEST_TIMEOUT_S,
        trust_env: bool = True,
        max_connections: int = MAX_CONNECTIONS,
    ) -> None:
        self.field_manager = field_manager
        self._access = access
        self._may_write_s = may_write_s
        self._trust_env = trust_env
        self._max_connections = max_connections
        self.succeeded_at = -math.inf
        self._closed = False
        # Python 3.13 rejects certificates without an authority key identifier by default. Kubernetes and kubectl accept them.
        access.configuration.disable_strict_ssl_verification = True
        try:
            self._rest = RESTClientObject(access.configuration)
        except (ssl.SSLError, OSError) as error:
            raise Unconfigured(f"the certificates of the cluster cannot be used: {error}") from error

    async def aclose(self) -> None:
        """Close every connection. Later requests fail as if the API server were unreachable."""
        self._closed = True
        await self._rest.close()

    async def request(
        self,
        method: str,
        path: str,
        body: Body | Sequence[Body] | None = None,
        *,
        content_type: ContentType = ContentType.JSON,
        params: Mapping[str, str] | None = None,
        timeout_s: float = REQUEST_TIMEOUT_S,
    ) -> Body:
        """Send one request and return the object in the response.

        Raises:
            KubeError: The request was refused, or there was no response in time.
        """
        if method != "GET":
            timeout_s = min(timeout_s, self._may_write_s())
            if timeout_s <= 0:
                raise KubeError(0, "NotActing", f"{method} {path}: the lease is not held, another operator may act")
        silence_s = min(timeout_s, REQUEST_TIMEOUT_S)
        with translated(f"{method} {path}"):
            try:
                # Limit the whole request. The timeouts of aiohttp apply to its parts and restart with every byte.
                async with (
                    asyncio.timeout(timeout_s),
                    self.open_response(method, path, params, body, content_type, silence_s=silence_s) as response,
                ):
                    result: Body = parse_response(await response.read())
            except TimeoutError as error:
                raise unreachable(f"{method} {path}: no response in {timeout_s:.1f} s") from error
        return result

    async def ready(self) -> bool:
        """Return True if the API server reports that it is ready."""
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S), self.open_response("GET", "/readyz", None):
                return True
        except (KubeError, *_FAILURES):
            return False

    async def responds(self, timeout_s: float) -> bool:
        """Return True if the network path to the API server works: it responds in time, even with a refusal."""
        try:
            async with asyncio.timeout(timeout_s), self.open_response("GET", "/livez", None):
                return True
        except KubeError:
            return True
        except aiohttp.ClientConnectorError as error:
            return isinstance(error.os_error, ConnectionRefusedError)
        except _FAILURES:
            return False

    @asynccontextmanager
    async def open_response(
        self,
        method: str,
        path: str,
        params: Mapping[str, str] | None,
        body: Body | Sequence[Body] | None = None,
        content_type: ContentType = ContentType.JSON,
        *,
        silence_s: float | None = REQUEST_TIMEOUT_S,
    ) -> AsyncIterator[aiohttp.ClientResponse]:
        """Send a request and yield the response after its headers, if they report success.

        Raises:
            KubeError: The API server refused the request.
        """
        url = str(self._access.configuration.host) + path
        if params:
            url += "?" + urlencode(params)
        timeout = aiohttp.ClientTimeout(
            total=None, connect=REQUEST_TIMEOUT_S, sock_connect=REQUEST_TIMEOUT_S, sock_read=silence_s
        )
        for renewed in (False, True):
            async with asyncio.timeout(silence_s):
                headers = await self._headers(content_type)
                self._open()
                raw_response = await self._rest.request(method, url, headers, body, _request_timeout=timeout)
            response: aiohttp.ClientResponse = raw_response.response
            try:
                if response.status == HTTPStatus.UNAUTHORIZED and not renewed:
                    async with asyncio.timeout(silence_s):
                        await self._access.renew()
                    continue
                if response.status >= HTTPStatus.BAD_REQUEST:
                    async with asyncio.timeout(silence_s):
                        raise _refusal(response.status, await response.read())
                self.succeeded_at = time.monotonic()
                yield response
                return
            finally:
                # If the response was not read to its end, this closes the connection.
                response.release()

    async def _headers(self, content_type: ContentType) -> dict[str, str]:
        headers = {"Accept": "application/json", "Content-Type": content_type.value}
        bearer = (await self._access.configuration.auth_settings()).get("BearerToken")
        if bearer is not None and bearer["value"]:
            # A token file may end with a newline, which is not valid in a header.
            headers["Authorization"] = bearer["value"].strip()
        return headers

    def _open(self) -> None:
        """Create the connection pool, which needs a running event loop.

        The official client would create a pool that keeps idle connections for only 15 s.
        """
        if self._closed:
            raise aiohttp.ClientConnectionError("the connection was closed")
        if self._rest.pool_manager is None:
            no_redirects = aiohttp.TraceConfig()
            no_redirects.on_request_redirect.append(_refuse_redirect)
            self._rest.pool_manager = aiohttp.ClientSession(
                trace_configs=[no_redirects],
                connector=aiohttp.TCPConnector(
                    ssl=self._rest.ssl_context,
                    limit=self._max_connections,
                    keepalive_timeout=_KEPT_OPEN_S,
                    socket_factory=_socket,
                ),
                cookie_jar=aiohttp.DummyCookieJar(),
                # The lookup of proxies doubles the time of a request, so it is skipped if none is configured.
                trust_env=self._trust_env and bool(getproxies_environment()),
            )


def _socket(address: aiohttp.AddrInfoType) -> socket.socket:
    """Create a socket with keep-alive.

    A watch sends nothing, so without keep-alive it would not detect a dead connection.
    """
    new_socket = socket.socket(*address[:3])
    new_socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE.items():
        if hasattr(socket, option):
            new_socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
    return new_socket


async def _refuse_redirect(
    _session: aiohttp.ClientSession, _context: object, redirect: aiohttp.TraceRequestRedirectParams
) -> None:
    """Refuse a redirect. The API server sends none, and another server could receive Secrets in plain text."""
    raise aiohttp.ClientError(
        f"refused a redirect to {redirect.response.headers.get('Location', 'an unknown address')}"
    )


@contextmanager
def translated(request: str) -> Iterator[None]:
    """Raise connection errors as KubeError."""
    try:
        yield
    except (*_FAILURES, ValueError, RecursionError) as error:
        raise unreachable(f"{request}: {type(error).__name__}: {error}") from error


def _refusal(code: int, content: bytes) -> KubeError:
    try:
        return from_status(code, json.loads(content))
    except (ValueError, RecursionError):
        return from_status(code, content.decode(errors="replace"))
