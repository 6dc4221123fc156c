"""All that the agent reads from and writes to Kubernetes; no other module of the agent talks to an API server."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import os
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import httpx2
import msgspec
from fractus_core.api.model import API_VERSION, GROUP, VERSION
from lightkube import ApiError, AsyncClient, ConfigError, KubeConfig
from lightkube.config.kubeconfig import SERVICE_ACCOUNT
from lightkube.core.generic_client import ListAsyncIterable
from lightkube.core.resource import ApiInfo, ResourceDef
from lightkube.generic_resource import (
    GenericGlobalResource,
    GenericGlobalStatus,
    GenericNamespacedResource,
    create_api_info,
)
from lightkube.types import PatchType

from fractus_agent.backoff import Backoff

LOG = logging.getLogger(__name__)

T = TypeVar("T")
Object = dict[str, Any]
"""A Kubernetes object as JSON has it."""

FIELD_MANAGER = "fractus-agent"
SYSTEM_NAMESPACE = "fractus-system"
SIGNER = f"{GROUP}/node"
NODE_LABEL = f"{GROUP}/node"
CALL_TIMEOUT_S = 20.0


class Unavailable(Exception):
    """The API server is out of reach, overloaded, or does not let the agent do this (yet): try again later."""


class Rejected(Exception):
    """The API server refuses the object itself: the same request will fail again."""


class Conflict(Exception):
    """Somebody changed or created the object in between: read it again."""


@dataclass(frozen=True, slots=True)
class Listed:
    """Every grant of the node, after a complete list."""

    grants: tuple[Object, ...]


@dataclass(frozen=True, slots=True)
class Changed:
    """A grant was made or changed."""

    grant: Object


@dataclass(frozen=True, slots=True)
class Deleted:
    """A grant was deleted."""

    name: str


GrantEvent = Listed | Changed | Deleted


@dataclass(frozen=True, slots=True)
class WatchTimes:
    """How long watches live and how they come back.

    The API server sends a bookmark about once a minute, so silence_s without one means a dead connection.
    """

    server_s: int = 600
    silence_s: float = 150.0
    relist_s: float = 1800.0
    first_retry_s: float = 0.5
    longest_retry_s: float = 15.0


class _Expired(Exception):
    """The watch's resource version is too old (410): list again."""


def _resource(group: str, version: str, kind: str, plural: str) -> type[GenericGlobalResource]:
    # Not lightkube's registry: it refuses a kind that someone else in the process described differently.
    info = create_api_info(group, version, kind, plural)
    return type(kind, (GenericGlobalResource,), {"_api_info": info})


def _status_of(kind: str, plural: str) -> type[GenericGlobalStatus]:
    definition = ResourceDef(GROUP, VERSION, kind)
    info = ApiInfo(
        resource=definition, parent=definition, plural=plural, verbs=["get", "patch", "put"], action="status"
    )
    return type(f"{kind}Status", (GenericGlobalStatus,), {"_api_info": info})


_PLURALS = {"Drone": "drones", "EdgeNode": "edgenodes", "Grant": "grants"}
_KINDS = {kind: _resource(GROUP, VERSION, kind, plural) for kind, plural in _PLURALS.items()}
_STATUSES = {kind: _status_of(kind, plural) for kind, plural in _PLURALS.items()}
_NODE = _resource("", "v1", "Node", "nodes")
_SIGNING_REQUEST = _resource("certificates.k8s.io", "v1", "CertificateSigningRequest", "certificatesigningrequests")
_CONFIG_MAP = type(
    "ConfigMap", (GenericNamespacedResource,), {"_api_info": create_api_info("", "v1", "ConfigMap", "configmaps")}
)


def connect(service_account: Path = Path(SERVICE_ACCOUNT)) -> AsyncClient:
    """Client by the pod's service account (its token is read again when refused), or by KUBECONFIG outside a pod.

    Raises:
        Unavailable: there is neither.
    """
    try:
        given = os.environ.get("KUBECONFIG")
        config = KubeConfig.from_file(given) if given else KubeConfig.from_service_account(service_account)
        return AsyncClient(config=config, field_manager=FIELD_MANAGER, timeout=httpx2.Timeout(10.0), trust_env=False)
    except (ConfigError, OSError, KeyError) as error:
        raise Unavailable(f"no way to reach an API server: {error}") from error


class _Absent(Unavailable):
    """There is no such object, or no such kind yet."""


_FAILURES = (httpx2.HTTPError, httpx2.StreamError, ConfigError, msgspec.MsgspecError, OSError, TimeoutError)


def _translated(error: Exception) -> Exception:
    if isinstance(error, ApiError):
        code, message = error.status.code or 0, error.status.message or str(error)
        kinds: dict[int, type[Exception]] = {
            400: Rejected, 404: _Absent, 409: Conflict, 410: _Expired, 422: Rejected,
        }  # fmt: skip
        kind = kinds.get(code)
        return kind(message) if kind else Unavailable(f"{code}: {message}")
    if isinstance(error, httpx2.HTTPStatusError):
        return Unavailable(f"{error.response.status_code} from the API server")
    return Unavailable(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)


async def _call(request: Awaitable[T]) -> T:
    try:
        return await asyncio.wait_for(request, CALL_TIMEOUT_S)
    except _FAILURES as error:
        raise _translated(error) from error


async def _all(pages: ListAsyncIterable[Any]) -> tuple[Object, ...]:
    return tuple([dict(item) async for item in pages])


class Store:
    """The node's own objects and grants at the API server.

    Every call either returns within CALL_TIMEOUT_S or raises Unavailable, Rejected or Conflict.
    """

    def __init__(self, client: AsyncClient, node: str, times: WatchTimes | None = None) -> None:
        self._client = client
        self._node = node
        self._times = times or WatchTimes()

    async def node_labels(self) -> dict[str, str] | None:
        """Labels of the Kubernetes Node; None when there is no such node."""
        node = await self._get(_NODE, self._node)
        return None if node is None else dict(node["metadata"].get("labels", {}))

    async def described(self, kind: str) -> Object | None:
        """The node's Drone or EdgeNode; None when it is absent."""
        return await self._get(_KINDS[kind], self._node)

    async def create(self, body: Object) -> Object:
        """Create a Drone or EdgeNode.

        Raises:
            Conflict: it exists already.
        """
        return dict(await _call(self._client.create(_KINDS[body["kind"]](**body))))

    async def replace(self, body: Object) -> Object:
        """Replace a Drone or EdgeNode of the same resourceVersion.

        Raises:
            Conflict: it changed since it was read.
        """
        return dict(await _call(self._client.replace(_KINDS[body["kind"]](**body))))

    async def apply_status(self, kind: str, name: str, status: Object) -> Object | None:
        """Apply the agent's part of a status, server side; the whole object afterwards, None when it is absent."""
        resource = _STATUSES[kind]
        body: Object = {"apiVersion": API_VERSION, "kind": kind, "metadata": {"name": name}, "status": status}
        try:
            return dict(
                await _call(
                    self._client.patch(resource, name, resource(**body), patch_type=PatchType.APPLY, force=True)
                )
            )
        except _Absent:
            return None

    async def authority(self) -> bytes | None:
        """The PEM certificates that nodes and components trust; None when the operator has not published them."""
        try:
            found: Object = await _call(self._client.get(_CONFIG_MAP, "fractus-ca", namespace=SYSTEM_NAMESPACE))
        except _Absent:
            return None
        text = (found.get("data") or {}).get("ca.crt")
        return text.encode() if text else None

    async def request_certificate(self, name: str, request_pem: bytes, life_s: int) -> None:
        """Create the signing request; one of the same name is the same request."""
        body: Object = {
            "metadata": {"name": name, "labels": {NODE_LABEL: self._node}},
            "spec": {
                "request": base64.b64encode(request_pem).decode(),
                "signerName": SIGNER,
                "expirationSeconds": life_s,
                "usages": ["digital signature", "server auth", "client auth"],
            },
        }
        with contextlib.suppress(Conflict):
            await _call(self._client.create(_SIGNING_REQUEST(**body)))

    async def certificate_request(self, name: str) -> Object | None:
        """The signing request with what became of it; None when somebody deleted it."""
        return await self._get(_SIGNING_REQUEST, name)

    async def drop_certificate_requests(self) -> None:
        """Delete the signing requests of this node, whoever left them."""
        for item in await _call(_all(self._client.list(_SIGNING_REQUEST, labels={NODE_LABEL: self._node}))):
            name = item["metadata"]["name"]
            if name.startswith(f"fractus-{self._node}-"):
                with contextlib.suppress(_Absent):
                    await _call(self._client.delete(_SIGNING_REQUEST, name))

    async def grants(self) -> AsyncIterator[GrantEvent]:
        """Grants of this node, for ever: a complete list, then changes, and a list again after any break.

        A break is never taken for an empty list. After one the list is read anew rather than the watch resumed: the
        list is short, and an API server restored from a backup may count versions from an earlier number.
        """
        backoff = Backoff(self._times.first_retry_s, self._times.longest_retry_s)
        while True:
            started_s = time.monotonic()
            try:
                grants, version = await self._list_grants()
                if backoff.attempts > 1:
                    LOG.info("the API server is back after %d attempts", backoff.attempts)
                yield Listed(grants)
                async with contextlib.aclosing(self._watch_grants(version)) as events:
                    async for event in events:
                        yield event
            except (Unavailable, Rejected, Conflict) as error:
                level = logging.WARNING if backoff.attempts == 0 else logging.DEBUG
                LOG.log(level, "grants cannot be followed, keeping those on disk: %s", error)
            except _Expired:
                LOG.debug("the watch of grants expired, listing again")
            if time.monotonic() - started_s > 30.0:
                backoff.succeeded()
            await asyncio.sleep(backoff.delay_s())

    async def close(self) -> None:
        """Close the connections."""
        await self._client.close()

    async def _get(self, resource: type[GenericGlobalResource], name: str) -> Object | None:
        try:
            return dict(await _call(self._client.get(resource, name)))
        except _Absent:
            return None

    async def _list_grants(self) -> tuple[tuple[Object, ...], str]:
        pages = self._client.list(_KINDS["Grant"], fields={"spec.node": self._node})
        grants = await _call(_all(pages))
        return grants, pages.resourceVersion

    async def _watch_grants(self, version: str) -> AsyncGenerator[GrantEvent, None]:
        until_s = time.monotonic() + self._times.relist_s
        while time.monotonic() < until_s:
            opened_s = time.monotonic()
            async for kind, body in self._events(version):
                version = body["metadata"]["resourceVersion"]
                if kind == "DELETED":
                    yield Deleted(body["metadata"]["name"])
                elif kind in ("ADDED", "MODIFIED"):
                    yield Changed(body)
            if time.monotonic() - opened_s < 1.0:
                raise Unavailable("the API server closed the watch at once")

    async def _events(self, version: str) -> AsyncGenerator[tuple[str, Object], None]:
        # lightkube's own watch has no bookmarks, no limit on silence, and reconnects without a pause.
        http: Any = self._client._client
        request = http.prepare_request(
            "list",
            _KINDS["Grant"],
            watch=True,
            params={
                "fieldSelector": f"spec.node={self._node}",
                "resourceVersion": version,
                "timeoutSeconds": str(self._times.server_s),
                "allowWatchBookmarks": "true",
            },
        )
        request.timeout = httpx2.Timeout(10.0, read=self._times.silence_s)
        try:
            response = await http.send(http.build_adapter_request(request), stream=True)
            try:
                if response.is_error:
                    await response.aread()
                http.raise_for_status(response)
                async for line in response.aiter_lines():
                    event = msgspec.json.decode(line)
                    if event["type"] == "ERROR":
                        _raise_watch_error(event["object"])
                    yield event["type"], event["object"]
            finally:
                await response.aclose()
        except _FAILURES as error:
            raise _translated(error) from error


def _raise_watch_error(status: Object) -> None:
    message = f"{status.get('code')}: {status.get('message')}"
    if status.get("code") == 410:
        raise _Expired(message)
    raise Unavailable(message)
