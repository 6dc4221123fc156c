"""Requests to the API server over the official client's connection (kubernetes.aio, aiohttp), as plain dicts.

Dicts need no class for each kind, and the API server checks them better than a class could. The official client brings
credentials, TLS, proxies and pooled connections; its own watch has no bound on silence and its own lists no pages, so
both are here.
"""

from __future__ import annotations

import asyncio
import json
import ssl
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from enum import StrEnum
from http import HTTPStatus
from urllib.parse import urlencode

import aiohttp
from kubernetes.aio.client.rest import RESTClientObject
from kubernetes.aio.config import ConfigException

from fractus_kube.access import Access, Unconfigured
from fractus_kube.errors import Conflict, KubeError, NotFound, from_status, unreachable
from fractus_kube.objects import Body, Key, Kind, key_of

REQUEST_TIMEOUT_S = 15.0
LIST_TIMEOUT_S = 120.0
"""Lists are long where links are slow: one that makes progress goes on, so that it does not start over again and again."""
PAGE = 250
"""Objects a page: while one is read it takes several times its size."""
MAX_CONNECTIONS = 100
_KEPT_OPEN_S = 60.0
"""Connections stay open between two changes, for less than the API server's 90 s: each costs a TLS handshake."""
_FAILURES = (aiohttp.ClientError, TimeoutError, OSError, ConfigException, Unconfigured)


class ContentType(StrEnum):
    """How a body is meant."""

    JSON = "application/json"
    APPLY = "application/apply-patch+yaml"
    MERGE = "application/merge-patch+json"
    JSON_PATCH = "application/json-patch+json"


class Page:
    """One page of a list."""

    __slots__ = ("continue_", "items", "resource_version")

    def __init__(self, body: Body) -> None:
        self.items: list[Body] = body.get("items") or []
        self.resource_version: str = body["metadata"].get("resourceVersion", "")
        self.continue_: str = body["metadata"].get("continue", "")


class Client:
    """An API server, as far as Fractus uses it.

    Every request ends within its time-out, with an answer or a KubeError.

    Args:
        access: Where the API server is, and who asks.
        field_manager: Who owns the fields that are written.
        may_write_s: For how many seconds writes may still take effect; none where another process may write instead.
        trust_env: Whether proxies of the environment are used.

    Raises:
        Unconfigured: a certificate or key cannot be read.
    """

    def __init__(
        self,
        access: Access,
        field_manager: str,
        *,
        may_write_s: Callable[[], float] = lambda: REQUEST_TIMEOUT_S,
        trust_env: bool = True,
    ) -> None:
        self.field_manager = field_manager
        self._access = access
        self._may_write_s = may_write_s
        self._trust_env = trust_env
        try:
            self._rest = RESTClientObject(access.configuration)
        except (ssl.SSLError, OSError) as error:
            raise Unconfigured(f"the certificates of the cluster cannot be used: {error}") from error

    async def aclose(self) -> None:
        """Close every connection."""
        await self._rest.close()

    # -- objects --

    async def get(self, kind: Kind, name: str, namespace: str = "") -> Body:
        """Read an object.

        Raises:
            NotFound: there is none of that name.
        """
        return await self.request("GET", kind.path(namespace, name))

    async def list_page(
        self,
        kind: Kind,
        *,
        selectors: Mapping[str, str] | None = None,
        continue_: str = "",
        timeout_s: float = LIST_TIMEOUT_S,
    ) -> Page:
        """Read one page of a collection over all namespaces.

        Args:
            kind: Which collection.
            selectors: labelSelector and fieldSelector, where wanted.
            continue_: What the page before gave, to go on from.
            timeout_s: How long the page may take; within that, it must make progress.

        Raises:
            Expired: the list changed so much that it must be read from its beginning.
        """
        params = {"limit": str(PAGE), **(selectors or {})}
        if continue_:
            params["continue"] = continue_
        return Page(await self.request("GET", kind.path(), params=params, timeout_s=timeout_s))

    async def list(self, kind: Kind, *, selectors: Mapping[str, str] | None = None) -> list[Body]:
        """Read a whole collection over all namespaces."""
        return (await self.list_whole(kind, selectors=selectors)).items

    async def list_whole(
        self, kind: Kind, *, selectors: Mapping[str, str] | None = None, timeout_s: float = LIST_TIMEOUT_S
    ) -> Page:
        """Read a whole collection over all namespaces as one page; the time-out is for each part of it."""
        page = await self.list_page(kind, selectors=selectors, timeout_s=timeout_s)
        items = page.items
        while page.continue_:
            page = await self.list_page(kind, selectors=selectors, continue_=page.continue_, timeout_s=timeout_s)
            items += page.items
        page.items = items
        return page

    async def watch(
        self,
        kind: Kind,
        *,
        resource_version: str,
        selectors: Mapping[str, str] | None = None,
        timeout_s: int,
        silence_s: float,
    ) -> AsyncIterator[tuple[str, Body]]:
        """Follow a collection: (ADDED | MODIFIED | DELETED | BOOKMARK, object), until the server ends it.

        Args:
            kind: Which collection.
            resource_version: Where to go on from.
            selectors: As for the list.
            timeout_s: The server ends the watch after this time.
            silence_s: The connection counts as dead after this time without a byte (the server sends a
                bookmark about every minute).

        Raises:
            Expired: the resource version is too old.
        """
        params = {
            "watch": "true",
            "allowWatchBookmarks": "true",
            "resourceVersion": resource_version,
            "timeoutSeconds": str(timeout_s),
            **(selectors or {}),
        }
        with _translated(f"watch of {kind.plural}"):
            async with self._answer("GET", kind.path(), params, silence_s=silence_s) as response:
                rest = b""
                while True:
                    # aiohttp's own time-out ends with the connection, also where that never tells the reader.
                    async with asyncio.timeout(silence_s):
                        chunk = await response.content.readany()
                    if not chunk:
                        return
                    *lines, rest = (rest + chunk).split(b"\n")
                    for line in filter(None, lines):
                        event = json.loads(line)
                        if event["type"] == "ERROR":
                            raise from_status(500, event["object"])
                        yield event["type"], event["object"]

    async def create(self, kind: Kind, body: Body, *, strict: bool = True) -> Body:
        """Create an object; if strict, what the API server does not know is refused, as by an apply, not dropped.

        Raises:
            Conflict: one of that name exists; or, where its reason is not AlreadyExists, try again.
        """
        params = {"fieldManager": self.field_manager, "fieldValidation": "Strict" if strict else "Warn"}
        return await self.request("POST", kind.path(key_of(body)[0]), body, params=params)

    async def apply(self, kind: Kind, body: Body, *, subresource: str = "") -> Body:
        """Make an object's fields as given, by server-side apply; fields of others stay.

        With metadata.uid in the body, an object that is gone, or another one of its name, is left alone.

        Raises:
            Conflict: metadata.uid does not match.
        """
        params = {"fieldManager": self.field_manager, "force": "true"}
        return await self.patch(kind, key_of(body), body, ContentType.APPLY, params=params, subresource=subresource)

    async def patch(
        self,
        kind: Kind,
        key: Key,
        changes: Body | Sequence[Body],
        content_type: ContentType,
        *,
        params: Mapping[str, str] | None = None,
        subresource: str = "",
    ) -> Body:
        """Change parts of an object."""
        return await self.request(
            "PATCH",
            kind.path(*key, subresource),
            changes,
            content_type=content_type,
            params={"fieldManager": self.field_manager, **(params or {})},
        )

    async def replace(self, kind: Kind, body: Body, *, subresource: str = "") -> Body:
        """Write a whole object, such as a signing request's approval, which takes no apply.

        Raises:
            Conflict: the object changed since it was read.
        """
        params = {"fieldManager": self.field_manager}
        return await self.request("PUT", kind.path(*key_of(body), subresource), body, params=params)

    async def delete(self, kind: Kind, key: Key, uid: str | None = None) -> None:
        """Delete an object and, in the background, what it owns; one that is gone already is no error."""
        options: Body = {"propagationPolicy": "Background"}
        if uid is not None:
            options["preconditions"] = {"uid": uid}
        try:
            await self.request("DELETE", kind.path(*key), options)
        except NotFound:
            return
        except Conflict:
            if uid is None:
                raise

    # -- requests --

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
        """Send one request; the object in the answer.

        Raises:
            KubeError: it was refused, or there was no answer in time.
        """
        if method != "GET":
            timeout_s = min(timeout_s, self._may_write_s())
            if timeout_s <= 0:
                raise KubeError(0, "NotActing", f"{method} {path}: the lease is not held, another operator may act")
        silence_s = min(timeout_s, REQUEST_TIMEOUT_S)
        with _translated(f"{method} {path}"):
            try:
                # As a whole: aiohttp's own time-outs are for each part of a request, and start over with every byte.
                async with (
                    asyncio.timeout(timeout_s),
                    self._answer(method, path, params, body, content_type, silence_s=silence_s) as response,
                ):
                    result: Body = json.loads(await response.read())
            except TimeoutError as error:
                raise unreachable(f"{method} {path}: no answer in {timeout_s:.1f} s") from error
        return result

    async def ready(self) -> bool:
        """Whether the API server says that it is ready."""
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S), self._answer("GET", "/readyz", None):
                return True
        except (KubeError, *_FAILURES):
            return False

    @asynccontextmanager
    async def _answer(
        self,
        method: str,
        path: str,
        params: Mapping[str, str] | None,
        body: Body | Sequence[Body] | None = None,
        content_type: ContentType = ContentType.JSON,
        *,
        silence_s: float = REQUEST_TIMEOUT_S,
    ) -> AsyncIterator[aiohttp.ClientResponse]:
        """The answer to a request, once its head is here and says success.

        Raises:
            KubeError: the API server refused it.
        """
        url = str(self._access.configuration.host) + path
        if params:
            url += "?" + urlencode(params)
        timeout = aiohttp.ClientTimeout(
            total=None, connect=REQUEST_TIMEOUT_S, sock_connect=REQUEST_TIMEOUT_S, sock_read=silence_s
        )
        for last in (False, True):
            async with asyncio.timeout(silence_s):
                headers = await self._headers(content_type)
                self._open()
                answer = await self._rest.request(method, url, headers, body, _request_timeout=timeout)
            response: aiohttp.ClientResponse = answer.response
            try:
                if response.status == HTTPStatus.UNAUTHORIZED and not last:
                    await self._access.renew()
                    continue
                if response.status >= HTTPStatus.BAD_REQUEST:
                    async with asyncio.timeout(silence_s):
                        raise _refusal(response.status, await response.read())
                yield response
                return
            finally:
                if response.content.at_eof():
                    response.release()
                else:
                    # What was not read to its end leaves a connection of no further use.
                    response.close()

    async def _headers(self, content_type: ContentType) -> dict[str, str]:
        headers = {"Accept": "application/json", "Content-Type": content_type.value}
        bearer = (await self._access.configuration.auth_settings()).get("BearerToken")
        if bearer is not None and bearer["value"]:
            # A token file may end with a newline, which no header may hold.
            headers["Authorization"] = bearer["value"].strip()
        return headers

    def _open(self) -> None:
        """Make the pool of connections, once there is a loop; the official client's own keeps them for 15 s only."""
        if self._rest.pool_manager is None:
            self._rest.pool_manager = aiohttp.ClientSession(
                connector=aiohttp.TCPConnector(
                    ssl=self._rest.ssl_context, limit=MAX_CONNECTIONS, keepalive_timeout=_KEPT_OPEN_S
                ),
                cookie_jar=aiohttp.DummyCookieJar(),
                trust_env=self._trust_env,
            )


@contextmanager
def _translated(what: str) -> Iterator[None]:
    try:
        yield
    except (*_FAILURES, ValueError) as error:
        raise unreachable(f"{what}: {type(error).__name__}: {error}") from error


def _refusal(code: int, content: bytes) -> KubeError:
    try:
        return from_status(code, json.loads(content))
    except ValueError:
        return from_status(code, content.decode(errors="replace"))
