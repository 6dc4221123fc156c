"""The only module that talks to the API server: reads, watches, server-side applies, deletes.

It uses lightkube's connection (credentials from KUBECONFIG or the pod's service account, rotated
tokens, TLS), and speaks plain JSON over it: dicts need no schema of every kind, and the watch can
ask for bookmarks and time out, which lightkube's own watch does not offer.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from datetime import datetime
from typing import Any, Self
from urllib.request import getproxies_environment

import httpx2
from lightkube.config.client_adapter import ConnectionParams
from lightkube.config.kubeconfig import KubeConfig
from lightkube.core.exceptions import ConfigError

from fractus_operator.cluster.kinds import EVENT, Body, Key, Kind
from fractus_operator.cluster.transport import AiohttpTransport

FIELD_MANAGER = "fractus-operator"
_REQUEST_TIMEOUT_S = 15.0
_LIST_TIMEOUT_S = 120.0
"""Lists are long where links are slow: one that makes progress goes on, so that it is not begun anew for ever."""
_PAGE = 250
"""Objects a page: while one is read it takes several times its size."""
_TRIES = 3


class StoreError(Exception):
    """The API server refused a request, or could not be reached.

    Attributes:
        status: HTTP status; 0 where there was no answer.
        reason: Kubernetes' CamelCase reason, such as Conflict; "Unreachable" where there was no answer.
    """

    def __init__(self, status: int, reason: str, message: str) -> None:
        self.status = status
        self.reason = reason
        super().__init__(message)


class NotFound(StoreError):
    """There is no such object."""


class Taken(StoreError):
    """An object of that name exists, or it changed meanwhile (409)."""


class Expired(StoreError):
    """The resource version is too old to continue from (410): list again."""


class Unconfigured(Exception):
    """No credentials for an API server were found."""


_ERRORS: Mapping[int, type[StoreError]] = {404: NotFound, 409: Taken, 410: Expired}


class Page:
    """One page of a list."""

    __slots__ = ("continue_", "items", "resource_version")

    def __init__(self, body: Body) -> None:
        self.items: list[Body] = body.get("items") or []
        self.resource_version: str = body["metadata"].get("resourceVersion", "")
        self.continue_: str = body["metadata"].get("continue", "")


class Store:
    """Kubernetes, as far as the operator uses it."""

    def __init__(self, client: httpx2.AsyncClient) -> None:
        self._client = client
        self.may_write_s: Callable[[], float] = lambda: _REQUEST_TIMEOUT_S
        """For how many seconds writes may still take effect; none: another operator acts."""

    @classmethod
    def connect(cls) -> Self:
        """Open the cluster of KUBECONFIG, or the one this pod runs in.

        Raises:
            Unconfigured: there are no credentials.
        """
        try:
            config = KubeConfig.from_env().get()
        except ConfigError as error:
            raise Unconfigured(f"no cluster: set KUBECONFIG, or run in a pod ({error})") from error
        if config is None:
            raise Unconfigured("the kubeconfig has no current context; choose one with kubectl config use-context")
        parameters = ConnectionParams(timeout=httpx2.Timeout(_REQUEST_TIMEOUT_S)).httpx_params(config)
        if not getproxies_environment():
            parameters["transport"] = AiohttpTransport(parameters["verify"])
        return cls(httpx2.AsyncClient(**parameters))

    async def close(self) -> None:
        """Close every connection."""
        await self._client.aclose()

    async def get(self, kind: Kind, name: str, namespace: str = "") -> Body:
        """Read an object.

        Raises:
            NotFound: there is none of that name.
        """
        return await self._send("GET", kind.path(namespace, name))

    async def list_page(
        self, kind: Kind, *, selectors: Mapping[str, str] | None = None, continue_: str = "", limit: int = _PAGE
    ) -> Page:
        """Read one page of a collection over all namespaces.

        Args:
            kind: Which collection.
            selectors: labelSelector and fieldSelector, where wanted.
            continue_: What the page before gave, to go on from.
            limit: Objects a page.

        Raises:
            Expired: the list changed so much that it must be read from its beginning.
        """
        params = {"limit": str(limit), **(selectors or {})}
        if continue_:
            params["continue"] = continue_
        return Page(await self._send("GET", kind.path(), params=params, is_list=True))

    async def list(self, kind: Kind, *, selectors: Mapping[str, str] | None = None) -> list[Body]:
        """Read a whole collection over all namespaces."""
        items: list[Body] = []
        page = await self.list_page(kind, selectors=selectors)
        items += page.items
        while page.continue_:
            page = await self.list_page(kind, selectors=selectors, continue_=page.continue_)
            items += page.items
        return items

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
        timeout = httpx2.Timeout(_REQUEST_TIMEOUT_S, read=silence_s)
        try:
            async with self._client.stream("GET", kind.path(), params=params, timeout=timeout) as response:
                if response.status_code >= 400:
                    await response.aread()
                    raise _error(response)
                async for line in response.aiter_lines():
                    if not line:
                        continue
                    event = json.loads(line)
                    if event["type"] == "ERROR":
                        raise _from_status(event["object"])
                    yield event["type"], event["object"]
        except httpx2.HTTPError as error:
            raise StoreError(0, "Unreachable", f"watch of {kind.plural}: {type(error).__name__}: {error}") from error

    async def create(self, kind: Kind, body: Body, *, guarded: bool = True) -> Body:
        """Create an object; `guarded` as for every write, unless it is the Lease itself.

        As strict as an apply: what the API server does not know is refused, not dropped.

        Raises:
            Taken: one of that name exists; or, where its reason is not AlreadyExists, try again.
        """
        namespace, _ = _place(body)
        params = {"fieldManager": FIELD_MANAGER, "fieldValidation": "Strict"}
        return await self._send("POST", kind.path(namespace), params=params, body=body, guarded=guarded)

    async def apply(self, kind: Kind, body: Body, *, subresource: str = "") -> Body:
        """Make an object's fields as given, by server-side apply; fields of others stay.

        With metadata.uid in the body, an object that is gone or was made anew is left alone.

        Raises:
            Taken: metadata.uid does not match.
        """
        namespace, name = _place(body)
        return await self._send(
            "PATCH",
            kind.path(namespace, name, subresource),
            params={"fieldManager": FIELD_MANAGER, "force": "true"},
            body=body,
            content_type="application/apply-patch+yaml",
        )

    async def rewrite(self, kind: Kind, observed: Body, body: Body) -> Body:
        """Give an object exactly this spec, and these labels and annotations beside those it has.

        What is signed needs that: an apply leaves fields that others own. An object that is gone is not made anew.

        Raises:
            NotFound: the object is gone.
            Taken: it was made anew.
        """
        metadata = observed["metadata"]
        changes: list[Body] = [{"op": "test", "path": "/metadata/uid", "value": metadata["uid"]}]
        for name in ("labels", "annotations"):
            together = {**(metadata.get(name) or {}), **(body["metadata"].get(name) or {})}
            changes.append({"op": "add", "path": f"/metadata/{name}", "value": together})
        changes.append({"op": "add", "path": "/spec", "value": body["spec"]})
        namespace, name = _place(observed)
        try:
            return await self._send(
                "PATCH",
                kind.path(namespace, name),
                params={"fieldManager": FIELD_MANAGER, "fieldValidation": "Strict"},
                body=changes,
                content_type="application/json-patch+json",
            )
        except StoreError as error:
            # A test that fails looks like any other change that is refused.
            if error.status == 422 and (await self.get(kind, name, namespace))["metadata"]["uid"] != metadata["uid"]:
                raise Taken(409, "Conflict", f"{kind.name} {name} was made anew") from error
            raise

    async def count_as_applied(self, kind: Kind, key: Key) -> None:
        """Let what this operator created count as applied by it: else no later apply takes a field of it away.

        An apply could create it, too; but for what is new that costs the API server three times as much.

        Raises:
            Taken: somebody else keeps changing it.
        """
        for left in reversed(range(_TRIES)):
            try:
                metadata = (await self.get(kind, key[1], key[0]))["metadata"]
                entries = _all_applied(metadata.get("managedFields") or [])
                if entries is None:
                    return
                changes = {"managedFields": entries, "resourceVersion": metadata["resourceVersion"]}
                await self._send(
                    "PATCH",
                    kind.path(key[0], key[1]),
                    params={"fieldManager": FIELD_MANAGER},
                    body=[{"op": "replace", "path": f"/metadata/{k}", "value": v} for k, v in changes.items()],
                    content_type="application/json-patch+json",
                )
            except NotFound:
                return
            except Taken:
                if not left:
                    raise
            else:
                return

    async def label(self, kind: Kind, name: str, labels: Mapping[str, str | None]) -> None:
        """Set labels of somebody else's cluster-scoped object, and take off those that are None.

        Raises:
            NotFound: the object is gone; it is not made anew, as an apply would.
        """
        await self._send(
            "PATCH",
            kind.path(name=name),
            params={"fieldManager": FIELD_MANAGER},
            body={"metadata": {"labels": labels}},
            content_type="application/merge-patch+json",
        )

    async def replace(self, kind: Kind, body: Body, *, subresource: str = "", guarded: bool = True) -> Body:
        """Write what takes no apply, such as a signing request's approval; `guarded` as for create.

        Raises:
            Taken: the object changed since it was read.
        """
        namespace, name = _place(body)
        return await self._send("PUT", kind.path(namespace, name, subresource), body=body, guarded=guarded)

    async def delete(self, kind: Kind, key: Key, uid: str | None = None) -> None:
        """Delete an object and, in the background, what it owns; one that is gone already is no error."""
        options: Body = {"propagationPolicy": "Background"}
        if uid is not None:
            options["preconditions"] = {"uid": uid}
        try:
            await self._send("DELETE", kind.path(*key), body=options)
        except NotFound:
            return
        except Taken:
            if uid is None:
                raise

    async def record_event(
        self, regarding: Body, *, reason: str, message: str, warning: bool, name: str, now: datetime
    ) -> None:
        """Post an Event about an object, as `kubectl describe` shows it.

        Args:
            regarding: apiVersion, kind, metadata.name, metadata.namespace and metadata.uid are taken.
            reason: CamelCase.
            message: One sentence.
            warning: Type Warning rather than Normal.
            name: Name of the Event; a second one of that name is dropped.
            now: When it happened.
        """
        metadata = regarding["metadata"]
        namespace = metadata.get("namespace") or "default"
        reference = {
            "apiVersion": regarding["apiVersion"],
            "kind": regarding["kind"],
            "name": metadata["name"],
            "uid": metadata.get("uid", ""),
        }
        if "namespace" in metadata:
            reference["namespace"] = namespace
        stamp = now.strftime("%Y-%m-%dT%H:%M:%SZ")
        body = {
            **EVENT.header(name, namespace),
            "involvedObject": reference,
            "reason": reason,
            "message": message[:1024],
            "type": "Warning" if warning else "Normal",
            "firstTimestamp": stamp,
            "lastTimestamp": stamp,
            "count": 1,
            "source": {"component": FIELD_MANAGER},
            "reportingComponent": FIELD_MANAGER,
        }
        try:
            await self.create(EVENT, body)
        except Taken:
            return

    async def _send(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, str] | None = None,
        body: Body | Sequence[Body] | None = None,
        content_type: str = "application/json",
        guarded: bool = True,
        is_list: bool = False,
    ) -> Body:
        timeout_s = _LIST_TIMEOUT_S if is_list else _REQUEST_TIMEOUT_S
        if method != "GET" and guarded:
            timeout_s = min(timeout_s, self.may_write_s())
            if timeout_s <= 0:
                raise StoreError(0, "NotActing", f"{method} {path}: the lease is not held, another operator may act")
        headers = {"Accept": "application/json", **({"Content-Type": content_type} if body is not None else {})}
        try:
            # As a whole: the client's own time-outs are for each part of a request, and begin anew with every byte.
            async with asyncio.timeout(timeout_s):
                response = await self._client.request(
                    method,
                    path,
                    params=params,
                    content=None if body is None else json.dumps(body),
                    headers=headers,
                    timeout=min(timeout_s, _REQUEST_TIMEOUT_S),
                )
        except TimeoutError as error:
            raise StoreError(0, "Unreachable", f"{method} {path}: no answer in {timeout_s:.1f} s") from error
        except httpx2.HTTPError as error:
            raise StoreError(0, "Unreachable", f"{method} {path}: {type(error).__name__}: {error}") from error
        if response.status_code >= 400:
            raise _error(response)
        result: Body = response.json()
        return result


def _all_applied(entries: Sequence[Body]) -> list[Body] | None:
    """metadata.managedFields with all fields of ours as applied ones; None where they are."""
    ours = [e for e in entries if e.get("manager") == FIELD_MANAGER and not e.get("subresource")]
    if all(entry["operation"] == "Apply" for entry in ours):
        return None
    fields: Body = {}
    for entry in ours:
        _unite(fields, entry.get("fieldsV1") or {})
    return [*(entry for entry in entries if entry not in ours), {**ours[0], "operation": "Apply", "fieldsV1": fields}]


def _unite(fields: Body, more: Body) -> None:
    for name, below in more.items():
        _unite(fields.setdefault(name, {}), below)


def _place(body: Body) -> Key:
    return body["metadata"].get("namespace", ""), body["metadata"]["name"]


def _error(response: httpx2.Response) -> StoreError:
    try:
        status: Any = response.json()
    except ValueError:
        status = None
    if not isinstance(status, dict):
        status = {"message": response.text[:500]}
    return _from_status({"code": response.status_code, **status})


def _from_status(status: Body) -> StoreError:
    code = int(status.get("code") or 500)
    kind = _ERRORS.get(code, StoreError)
    return kind(code, str(status.get("reason") or "Unknown"), str(status.get("message") or f"HTTP {code}"))
