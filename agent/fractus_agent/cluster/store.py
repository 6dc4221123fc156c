"""All that the agent reads from and writes to Kubernetes; no other module of the agent talks to an API server."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import os
import time
from collections.abc import AsyncGenerator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fractus_core.api import DirectLink, Drone, EdgeNode, InvalidObject, NodeGrants
from fractus_core.api.grants import NODE_GRANTS_NAMESPACE, NodeGrantsStatus, ReportedGrant, unpack
from fractus_core.api.model import API_VERSION, GROUP
from fractus_core.api.names import NODE_SIGNER
from fractus_runtime.kubernetes import (
    Backoff,
    Body,
    Client,
    Conflict,
    Expired,
    Invalid,
    Kind,
    KubeError,
    NotFound,
    Unconfigured,
    in_cluster,
    kubeconfig,
)
from fractus_runtime.kubernetes.access import SERVICE_ACCOUNT
from pydantic import ValidationError

__all__ = ["Backoff", "Conflict", "Expired", "Invalid", "KubeError", "Object", "Store", "Unconfigured", "connect"]

LOG = logging.getLogger(__name__)

Object = Body

FIELD_MANAGER = "fractus-agent"
SYSTEM_NAMESPACE = "fractus-system"
NODE_LABEL = f"{GROUP}/node"
CALL_TIMEOUT_S = 20.0


@dataclass(frozen=True, slots=True)
class Listed:
    """Every object of the node, after a complete list."""

    objects: tuple[Object, ...]


@dataclass(frozen=True, slots=True)
class Changed:
    """An object was made or changed."""

    object: Object


@dataclass(frozen=True, slots=True)
class Deleted:
    """An object was deleted."""

    name: str


Event = Listed | Changed | Deleted


@dataclass(frozen=True, slots=True)
class Granted:
    """All Grants of the node, as the operator says by now.

    Attributes:
        generation: metadata.generation of the object that holds them.
        grants: None where they are as they were told of last.
        reported: what the API server was told became of them, by uid.
        reported_of: the generation that this was said of.
    """

    generation: int
    grants: tuple[Object, ...] | None
    reported: Mapping[str, ReportedGrant]
    reported_of: int


End = Literal["drone", "node"]
"""Which end of its direct links a node is, as their specs name it: the one that asks, or the one that is asked."""


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


_KINDS = {
    model.KIND: Kind(API_VERSION, model.KIND, model.PLURAL, namespaced=False) for model in (Drone, EdgeNode, DirectLink)
}
_NODE_GRANTS = Kind(API_VERSION, NodeGrants.KIND, NodeGrants.PLURAL, namespaced=True)
_NODE = Kind("v1", "Node", "nodes", namespaced=False)
_SIGNING_REQUEST = Kind("certificates.k8s.io/v1", "CertificateSigningRequest", "certificatesigningrequests", False)
_CONFIG_MAP = Kind("v1", "ConfigMap", "configmaps", namespaced=True)


@dataclass(frozen=True, slots=True)
class _Feed:
    """What is followed, and by whom."""

    client: Client
    kind: Kind
    selectors: Mapping[str, str]
    namespace: str = ""


def _reported(body: Object) -> NodeGrantsStatus:
    """What was reported in a NodeGrants; what cannot be read, as of another release, is reported again."""
    try:
        return NodeGrantsStatus.model_validate(body.get("status") or {})
    except ValidationError as error:
        LOG.warning("grants: what was reported cannot be read: %s", InvalidObject.from_pydantic(error))
        return NodeGrantsStatus()


async def connect(service_account: Path = SERVICE_ACCOUNT) -> Client:
    """Client by the pod's service account (its token is read again when refused), or by KUBECONFIG outside a pod.

    Raises:
        Unconfigured: there is neither.
    """
    given = os.environ.get("KUBECONFIG")
    access = await kubeconfig(given) if given else await in_cluster(service_account)
    return Client(access, FIELD_MANAGER, trust_env=False)


class Store:
    """The node's own objects and Grants at the API server.

    Every call either returns within CALL_TIMEOUT_S or raises a KubeError.
    """

    def __init__(self, client: Client, node: str, times: WatchTimes | None = None) -> None:
        self._client = client
        # All agents are one account, which may read no Grant: those of a node are for an account of its own.
        self._own_client = client.account(node, NODE_GRANTS_NAMESPACE, node)
        self._node = node
        self._times = times or WatchTimes()
        self._heard: dict[str, float] = {}

    def heard_s(self) -> dict[str, float]:
        """Seconds since the API server said anything about a kind that is followed, by its plural."""
        now_s = time.monotonic()
        return {plural: now_s - heard_s for plural, heard_s in self._heard.items()}

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
        return await self._client.create(_KINDS[body["kind"]], body, strict=False)

    async def replace(self, body: Object) -> Object:
        """Replace a Drone or EdgeNode of the same resourceVersion.

        Raises:
            Conflict: it changed since it was read.
        """
        return await self._client.replace(_KINDS[body["kind"]], body)

    async def apply_status(self, kind: str, name: str, status: Object, end: End | None = None) -> Object | None:
        """Apply the agent's part of a status, server side; the whole object afterwards, None when it is absent.

        Args:
            kind: of the object.
            name: its name.
            status: all that this agent says of it.
            end: of a DirectLink, of which the agents of both ends each say a part.
        """
        body = {**_KINDS[kind].header(name), "status": status}
        manager = f"{FIELD_MANAGER}-{end}" if end else None
        try:
            return await self._client.apply(_KINDS[kind], body, subresource="status", field_manager=manager)
        except NotFound:
            return None

    async def authority(self) -> bytes | None:
        """The PEM certificates that nodes and components trust; None when the operator has not published them."""
        found = await self._get(_CONFIG_MAP, "fractus-ca", SYSTEM_NAMESPACE)
        if found is None:
            return None
        text = (found.get("data") or {}).get("ca.crt")
        return text.encode() if text else None

    async def request_certificate(self, name: str, request_pem: bytes, life_s: int) -> None:
        """Create the signing request; one of the same name is the same request."""
        body: Object = {
            **_SIGNING_REQUEST.header(name, labels={NODE_LABEL: self._node}),
            "spec": {
                "request": base64.b64encode(request_pem).decode(),
                "signerName": NODE_SIGNER,
                "expirationSeconds": life_s,
                "usages": ["digital signature", "server auth", "client auth"],
            },
        }
        with contextlib.suppress(Conflict):
            await self._client.create(_SIGNING_REQUEST, body, strict=False)

    async def certificate_request(self, name: str) -> Object | None:
        """The signing request with what became of it; None when it was deleted."""
        return await self._get(_SIGNING_REQUEST, name)

    async def drop_certificate_requests(self) -> None:
        """Delete the signing requests that this node left."""
        ours = {"labelSelector": f"{NODE_LABEL}={self._node}"}
        for item in (await self._client.list_whole(_SIGNING_REQUEST, selectors=ours, timeout_s=CALL_TIMEOUT_S)).items:
            name = item["metadata"]["name"]
            if name.startswith(f"fractus-{self._node}-"):
                await self._client.delete(_SIGNING_REQUEST, ("", name))

    async def grants(self) -> AsyncGenerator[Granted, None]:
        """The node's Grants, at first and after each change.

        Only an object that is there and can be read tells which Grants there are: one that is not there yet, was deleted, is
        withheld or damaged takes no Grant from a drone.
        """
        feed = _Feed(
            self._own_client, _NODE_GRANTS, {"fieldSelector": f"metadata.name={self._node}"}, NODE_GRANTS_NAMESPACE
        )
        packed: str | None = None
        async for event in self._follow(feed):
            if isinstance(event, Deleted) or (isinstance(event, Listed) and not event.objects):
                LOG.warning("grants: the operator has told of none yet, keeping those on disk")
                packed = None
                continue
            # A list, which follows each break, is compared with the disk again.
            body, known = (event.objects[0], None) if isinstance(event, Listed) else (event.object, packed)
            try:
                found = NodeGrants.from_body({**body, "status": None})
                packed_now, count = found.spec.packed, found.spec.count
                fresh = None if packed_now == known else await asyncio.to_thread(unpack, packed_now, count)
            except InvalidObject as error:
                LOG.error("grants: cannot be read, keeping those on disk: %s", error)  # noqa: TRY400
                continue
            packed = packed_now
            status = _reported(body)
            reported = {each.uid: each for each in status.grants}
            yield Granted(found.metadata.generation or 0, fresh, reported, status.observed_generation or 0)
            # They are many times as large as they came, and the next may be hours away.
            del event, body, fresh

    async def report_grants(self, generation: int, reports: Sequence[ReportedGrant]) -> bool:
        """Tell what became of the node's Grants; False while there is no object to tell it in."""
        status = {"observedGeneration": generation, "grants": [report.to_dict() for report in reports]}
        body = {**_NODE_GRANTS.header(self._node, NODE_GRANTS_NAMESPACE), "status": status}
        try:
            await self._own_client.apply(_NODE_GRANTS, body, subresource="status")
        except NotFound:
            return False
        return True

    def direct_links(self, end: End) -> AsyncGenerator[Event, None]:
        """DirectLinks of this node, as `_follow` tells of them."""
        own = {"fieldSelector": f"spec.{end}={self._node}"}
        return self._follow(_Feed(self._client, _KINDS["DirectLink"], own))

    async def _follow(self, feed: _Feed) -> AsyncGenerator[Event, None]:
        """Objects, indefinitely: a complete list, then changes, and a list again after any break.

        A break is never taken for an empty list. After one the list is read again rather than the watch resumed: the
        list is short, and an API server restored from a backup may count versions from an earlier number.
        """
        backoff = Backoff(self._times.first_retry_s, self._times.longest_retry_s)
        kind = feed.kind
        self._heard.setdefault(kind.plural, time.monotonic())
        while True:
            started_s = time.monotonic()
            try:
                objects, version = await self._list(feed)
                self._heard[kind.plural] = time.monotonic()
                if backoff.attempts > 1:
                    LOG.info("%s: the API server is back (attempts=%d)", kind.plural, backoff.attempts)
                yield Listed(objects)
                async with contextlib.aclosing(self._watch(feed, version)) as events:
                    async for event in events:
                        yield event
            except Expired:
                LOG.debug("%s: the watch expired; listing again", kind.plural)
            except KubeError as error:
                level = logging.WARNING if backoff.attempts == 0 else logging.DEBUG
                LOG.log(level, "%s: cannot be followed, keeping those on disk: %s", kind.plural, error)
            if time.monotonic() - started_s > 30.0:
                backoff.succeeded()
            await asyncio.sleep(backoff.delay_s())

    async def answers(self, timeout_s: float) -> bool:
        """Whether anything is heard from the API server within some seconds, be it a refusal: the path to it works."""
        return await self._client.answers(timeout_s)

    async def close(self) -> None:
        """Close the connections."""
        await self._own_client.aclose()
        await self._client.aclose()

    async def _get(self, kind: Kind, name: str, namespace: str = "") -> Object | None:
        try:
            return await self._client.get(kind, name, namespace)
        except NotFound:
            return None

    async def _list(self, feed: _Feed) -> tuple[tuple[Object, ...], str]:
        page = await feed.client.list_whole(
            feed.kind, namespace=feed.namespace, selectors=feed.selectors, timeout_s=CALL_TIMEOUT_S
        )
        return tuple(page.items), page.resource_version

    async def _watch(self, feed: _Feed, version: str) -> AsyncGenerator[Event, None]:
        until_s = time.monotonic() + self._times.relist_s
        while time.monotonic() < until_s:
            opened_s = time.monotonic()
            events = feed.client.watch(
                feed.kind,
                resource_version=version,
                namespace=feed.namespace,
                selectors=feed.selectors,
                timeout_s=self._times.server_s,
                silence_s=self._times.silence_s,
            )
            async for change, body in events:
                version = body["metadata"]["resourceVersion"]
                self._heard[feed.kind.plural] = time.monotonic()
                if change == "DELETED":
                    yield Deleted(body["metadata"]["name"])
                elif change in ("ADDED", "MODIFIED"):
                    yield Changed(body)
            if time.monotonic() - opened_s < 1.0:
                raise KubeError(0, "Unreachable", "the API server closed the watch at once")
