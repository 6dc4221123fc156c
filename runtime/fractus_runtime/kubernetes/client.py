"""Objects of Kubernetes as plain dicts: reads, lists by pages, watches, server-side applies, deletes.

Dicts need no class for each kind, and the API server checks them better than a class could. The official client's own watch has no
bound on silence and its lists have no pages, so both are here.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping, Sequence
from functools import partial

import aiohttp

from fractus_runtime.kubernetes.access import with_tokens
from fractus_runtime.kubernetes.connection import Connection, ContentType, translated
from fractus_runtime.kubernetes.errors import Conflict, NotFound, from_status
from fractus_runtime.kubernetes.objects import Body, Key, Kind, key_of

LIST_TIMEOUT_S = 120.0
"""Lists are long where links are slow: one that makes progress goes on, so that it does not start over again and again."""
PAGE = 250
"""Objects a page: while one is read it takes several times its size."""

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
    """What comes, by lines with their ends; one that was cut off has none."""
    rest = b""
    while True:
        # aiohttp's own time-out ends with the connection, also where that never tells the reader.
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
    """An API server by kinds of objects."""

    def account(self, name: str, namespace: str, node: str) -> Client:
        """A client that acts as a ServiceAccount, by tokens that this one asks for; each is bound to a Node, for an hour.

        Args:
            name: of the ServiceAccount.
            namespace: of the ServiceAccount.
            node: with which tokens end.
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
            made = await self.request("POST", _SERVICE_ACCOUNT.path(namespace, name, "token"), request)
            return str(made["status"]["token"])

        access = with_tokens(self._access.configuration, token, _TOKEN_LIFE_S / 2)
        return Client(access, self.field_manager, trust_env=self._trust_env)

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
        namespace: str = "",
        selectors: Mapping[str, str] | None = None,
        continue_: str = "",
        timeout_s: float = LIST_TIMEOUT_S,
    ) -> Page:
        """Read one page of a collection.

        Args:
            kind: Which collection.
            namespace: Which part of it; empty: all namespaces.
            selectors: labelSelector and fieldSelector, where wanted.
            continue_: What the page before gave, to go on from.
            timeout_s: How long the page may take; within that, it must make progress.

        Raises:
            Expired: the list changed so much that it must be read from its beginning.
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
        """Read a whole collection as one page, over all namespaces or of one; the time-out is for each part of it."""
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
    ) -> AsyncIterator[tuple[str, Body]]:
        """Follow a collection: (ADDED | MODIFIED | DELETED | BOOKMARK, object), until the server ends it.

        Args:
            kind: Which collection.
            resource_version: Where to go on from.
            namespace: As for the list.
            selectors: As for the list.
            timeout_s: The server ends the watch after this time.
            silence_s: The connection counts as dead after this time without a byte (the server sends a
                bookmark about every minute).
            opened: Called once the API server has begun to answer, which may be long before the first event.

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
        with translated(f"watch of {kind.plural}"):
            async with self.answer("GET", kind.path(namespace), params, silence_s=silence_s) as response:
                opened()
                async for line in _lines(response.content, silence_s):
                    if line.endswith(b"\n") and line.strip():
                        event = json.loads(line)
                        if event["type"] == "ERROR":
                            raise from_status(500, event["object"])
                        yield event["type"], event["object"]

    async def log(self, pod: Key, params: Mapping[str, str], *, silence_s: float | None) -> AsyncGenerator[bytes, None]:
        """Lines of a container's log, without their ends, until the log ends or, followed, the container does.

        Args:
            pod: (namespace, name).
            params: those of the log subresource: container, follow, previous, sinceTime, timestamps and so on.
            silence_s: How long nothing may come. None where the log is followed: a container may say nothing for hours,
                and a kubelet answers with its first line.
        """
        path = POD.path(*pod, "log")
        with translated(f"GET {path}"):
            async with self.answer("GET", path, params, silence_s=silence_s) as response:
                async for line in _lines(response.content, silence_s):
                    yield line.rstrip(b"\r\n")

    async def create(self, kind: Kind, body: Body, *, strict: bool = True) -> Body:
        """Create an object; if strict, what the API server does not know is refused, as by an apply, not dropped.

        Raises:
            Conflict: one of that name exists; or, where its reason is not AlreadyExists, try again.
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

        With metadata.uid in the body, neither a deleted object nor another one of its name is written.

        Args:
            kind: Kind of the object.
            body: The fields.
            subresource: Subresource, such as status.
            field_manager: Replaces the field manager of the client, if several of its parts each own some fields.

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
        """Write a whole object, such as a signing request's approval, which takes no apply.

        Raises:
            Conflict: the object changed since it was read.
        """
        params = {"fieldManager": self.field_manager}
        return await self.request("PUT", kind.path(*key_of(body), subresource), body, params=params)

    async def delete(self, kind: Kind, key: Key, uid: str | None = None, *, orphan: bool = False) -> bool:
        """Delete an object; one that is gone already is no error.

        Args:
            kind: Of the object.
            key: (namespace, name).
            uid: Delete only the object that has it.
            orphan: Leave what it owns, which goes in the background otherwise.

        Returns:
            Whether this request removed it; not so while a finalizer or a grace period keeps it.
        """
        options: Body = {"propagationPolicy": "Orphan" if orphan else "Background"}
        if uid is not None:
            options["preconditions"] = {"uid": uid}
        try:
            # A Status is the answer where it is gone, else the object as it is kept.
            return (await self.request("DELETE", kind.path(*key), options)).get("kind") == "Status"
        except NotFound:
            return False
        except Conflict:
            if uid is None:
                raise
            return False
