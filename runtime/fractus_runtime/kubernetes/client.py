"""Requests for Kubernetes objects as plain dicts: reads, paged lists, watches, server-side apply, deletes.

Dicts need no class for each kind, and the API server validates them. Watch and list are implemented here, because the watch of
the official client has no limit on silence, and its lists have no pages.
"""

from __future__ import annotations

import asyncio
import copy
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping, Sequence
from functools import partial

import aiohttp

from fractus_runtime.kubernetes.access import unchanging, with_tokens, without_credentials
from fractus_runtime.kubernetes.connection import Connection, ContentType, translated
from fractus_runtime.kubernetes.errors import Conflict, NotFound, from_status
from fractus_runtime.kubernetes.objects import Body, Key, Kind, key_of, parse_response

LIST_TIMEOUT_S = 120.0
"""Maximum time of one page of a list, in seconds. Over slow links, a list that makes progress must not be restarted."""
PAGE = 250
"""Objects in a page. Decoding a page takes several times its size in memory."""

POD = Kind("v1", "Pod", "pods", namespaced=True)

_TOKEN_LIFE_S = 3600
_SERVICE_ACCOUNT = Kind("v1", "ServiceAccount", "serviceaccounts", namespaced=True)


class Page:
    """One page of a list."""

    __slots__ = ("continue_", "items", "resource_version")

    def __init__(self, body: Body) -> None:
        self.items: list[Body] = body.get("items") or []
        self.resource_version: str = body["metadata"].get("resourceVersion", "")
        self.continue_: str = body["metadata"].get("continue", "")


async def _lines(content: aiohttp.StreamReader, silence_s: float | None) -> AsyncIterator[bytes]:
    """Iterate over the lines of a stream, with their line ends. The last line may be cut off and have no line end."""
    rest = b""
    while True:
        # When the connection ends, the timeout of aiohttp ends too. If aiohttp does not notify this reader of the end,
        # the reader would wait forever without this timeout.
        async with asyncio.timeout(silence_s):
            chunk = await content.readany()
        if not chunk:
            break
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            yield line + b"\n"
    if rest:
        yield rest


class Client(Connection):
    """Sends requests for kinds of objects to the API server."""

    def account(self, name: str, namespace: str, node: str) -> Client:
        """Return a client that acts as a ServiceAccount, with tokens that are bound to a Node and valid for an hour.

        Args:
            name: Name of the ServiceAccount.
            namespace: Namespace of the ServiceAccount.
            node: Node of the tokens. The tokens become invalid when the Node is deleted.
        """
        request: Body = {
            "apiVersion": "authentication.k8s.io/v1",
            "kind": "TokenRequest",
            "spec": {
                "expirationSeconds": _TOKEN_LIFE_S,
                "boundObjectRef": {"apiVersion": "v1", "kind": "Node", "name": node},
            },
        }

        async def token() -> str:
            response = await self.request("POST", _SERVICE_ACCOUNT.path(namespace, name, "token"), request)
            return str(response["status"]["token"])

        access = with_tokens(self._access.configuration, token, _TOKEN_LIFE_S / 2)
        return Client(access, self.field_manager, trust_env=self._trust_env)

    def without_credentials(self) -> Client:
        """Return a client for the same API server without credentials, which must be closed separately."""
        return Client(without_credentials(self._access.configuration), self.field_manager, trust_env=self._trust_env)

    def on_behalf_of(self, token: str) -> Client:
        """Return a client that sends a bearer token instead of the credentials of this client, over the same connections.

        This client must not have a client certificate, which would authenticate the connections (`without_credentials`).
        """
        configuration = copy.copy(self._access.configuration)
        configuration.api_key = {"BearerToken": f"Bearer {token}"}
        client = copy.copy(self)
        client._access = unchanging(configuration)
        return client

    async def get(self, kind: Kind, name: str, namespace: str = "") -> Body:
        """Read an object.

        Raises:
            NotFound: No object has this name.
        """
        return await self.request("GET", kind.path(namespace, name))

    async def list_page(
        self,
        kind: Kind,
        *,
        namespace: str = "",
        selectors: Mapping[str, str] | None = None,
        continue_: str = "",
        timeout_s: float = LIST_TIMEOUT_S,
    ) -> Page:
        """Read one page of a collection.

        Args:
            kind: Kind of the objects.
            namespace: Namespace of the objects. Empty: all namespaces.
            selectors: labelSelector and fieldSelector, if any.
            continue_: Continuation token of the previous page.
            timeout_s: Maximum time of the page, in seconds.

        Raises:
            Expired: The continuation token is too old. Read the list from its beginning.
        """
        params = {"limit": str(PAGE), **(selectors or {})}
        if continue_:
            params["continue"] = continue_
        return Page(await self.request("GET", kind.path(namespace), params=params, timeout_s=timeout_s))

    async def list(self, kind: Kind, *, selectors: Mapping[str, str] | None = None) -> list[Body]:
        """Read a whole collection over all namespaces."""
        return (await self.list_whole(kind, selectors=selectors)).items

    async def list_whole(
        self,
        kind: Kind,
        *,
        namespace: str = "",
        selectors: Mapping[str, str] | None = None,
        timeout_s: float = LIST_TIMEOUT_S,
    ) -> Page:
        """Read a whole collection and return it as a single page. The timeout applies to each page that is read."""
        read = partial(self.list_page, kind, namespace=namespace, selectors=selectors, timeout_s=timeout_s)
        page = await read()
        items = page.items
        while page.continue_:
            page = await read(continue_=page.continue_)
            items += page.items
        page.items = items
        return page

    async def watch(
        self,
        kind: Kind,
        *,
        resource_version: str,
        namespace: str = "",
        selectors: Mapping[str, str] | None = None,
        timeout_s: int,
        silence_s: float,
        opened: Callable[[], None] = lambda: None,
    ) -> AsyncGenerator[tuple[str, Body], None]:
        """Watch a collection: yield (ADDED | MODIFIED | DELETED | BOOKMARK, object) until the API server ends the watch.

        Args:
            kind: Kind of the objects.
            resource_version: Resource version to continue from.
            namespace: Namespace of the objects. Empty: all namespaces.
            selectors: labelSelector and fieldSelector, if any.
            timeout_s: Time after which the API server ends the watch, in seconds.
            silence_s: Time without a byte after which the connection counts as dead, in seconds. The API server sends a
                bookmark about every minute.
            opened: Called when the response begins, which may be long before the first event.

        Raises:
            Expired: The resource version is too old.
        """
        params = {
            "watch": "true",
            "allowWatchBookmarks": "true",
            "resourceVersion": resource_version,
            "timeoutSeconds": str(timeout_s),
            **(selectors or {}),
        }
        with translated(f"watch of {kind.plural}"):
            async with self.open_response("GET", kind.path(namespace), params, silence_s=silence_s) as response:
                opened()
                async for line in _lines(response.content, silence_s):
                    if line.endswith(b"\n") and line.strip():
                        event = parse_response(line)
                        if not isinstance(event, dict) or not event.keys() >= {"type", "object"}:
                            raise ValueError("the line is not a watch event")
                        if event["type"] == "ERROR":
                            raise from_status(500, event["object"])
                        yield event["type"], event["object"]

    async def log(self, pod: Key, params: Mapping[str, str], *, silence_s: float | None) -> AsyncGenerator[bytes, None]:
        """Iterate over the lines of a container's log, without line ends. A followed log ends with its container.

        Args:
            pod: (namespace, name).
            params: Parameters of the log subresource: container, follow, previous, sinceTime, timestamps and so on.
            silence_s: Maximum time without a line, in seconds. None for a followed log: the kubelet responds with the first
                line, and a container may log nothing for hours.
        """
        path = POD.path(*pod, "log")
        with translated(f"GET {path}"):
            async with self.open_response("GET", path, params, silence_s=silence_s) as response:
                async for line in _lines(response.content, silence_s):
                    yield line.rstrip(b"\r\n")

    async def create(self, kind: Kind, body: Body, *, strict: bool = True) -> Body:
        """Create an object. If strict, unknown fields are refused, as by an apply. Otherwise they are dropped.

        Raises:
            Conflict: An object of this name exists (reason AlreadyExists), or the request must be repeated (other reasons).
        """
        params = {"fieldManager": self.field_manager, "fieldValidation": "Strict" if strict else "Warn"}
        return await self.request("POST", kind.path(key_of(body)[0]), body, params=params)

    async def apply(
        self,
        kind: Kind,
        body: Body,
        *,
        subresource: str = "",
        field_manager: str | None = None,
    ) -> Body:
        """Set the fields of an object by server-side apply. Fields of other managers stay.

        If the body has a metadata.uid, only the object with this uid is written. A deleted object is not created again.

        Args:
            kind: Kind of the object.
            body: The fields.
            subresource: Subresource, such as status.
            field_manager: Owner of the fields. Default: the field manager of the client.

        Raises:
            Conflict: metadata.uid does not match.
        """
        params = {"fieldManager": field_manager or self.field_manager, "force": "true"}
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
        """Replace a whole object, such as the approval of a signing request, which does not support apply.

        Raises:
            Conflict: The object was changed since it was read.
        """
        params = {"fieldManager": self.field_manager}
        return await self.request("PUT", kind.path(*key_of(body), subresource), body, params=params)

    async def delete(self, kind: Kind, key: Key, uid: str | None = None, *, orphan: bool = False) -> bool:
        """Delete an object. A missing object is not an error.

        Args:
            kind: Kind of the object.
            key: (namespace, name).
            uid: Delete only the object with this uid.
            orphan: Keep the objects that it owns. Otherwise they are deleted in the background.

        Returns:
            True if this request removed the object. False while a finalizer or a grace period keeps it.
        """
        options: Body = {"propagationPolicy": "Orphan" if orphan else "Background"}
        if uid is not None:
            options["preconditions"] = {"uid": uid}
        try:
            # The response is a Status if the object was removed, and the object if a finalizer or grace period keeps it.
            return (await self.request("DELETE", kind.path(*key), options)).get("kind") == "Status"
        except NotFound:
            return False
        except Conflict:
            if uid is None:
                raise
            return False
