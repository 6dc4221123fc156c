"""Kubernetes access of the agent: the node's objects, Grants, DirectLinks and signing requests.

No other module of the agent sends requests to the API server.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import os
import time
from collections.abc import AsyncGenerator, Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Literal

from fractus_core.api import DirectLink, Drone, EdgeNode, FlightPlan, InvalidObject, NodeGrants
from fractus_core.api.grants import NODE_GRANTS_NAMESPACE, NodeGrantsStatus, ReportedGrant, unpack
from fractus_core.api.model import API_VERSION, GROUP
from fractus_core.api.names import NODE_SIGNER
from fractus_runtime.backoff import Backoff
from fractus_runtime.kubernetes import (
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

__all__ = ["Conflict", "Expired", "Invalid", "KubeError", "Object", "Store", "Unconfigured", "connect"]

log = logging.getLogger(__name__)

Object = Body

FIELD_MANAGER = "fractus-agent"
SYSTEM_NAMESPACE = "fractus-system"
NODE_LABEL = f"{GROUP}/node"
CALL_TIMEOUT_S = 20.0


@dataclass(frozen=True, slots=True)
class Listed:
    """All objects of the node, from a complete list."""

    objects: tuple[Object, ...]


@dataclass(frozen=True, slots=True)
class Changed:
    """An object was created or changed."""

    object: Object


@dataclass(frozen=True, slots=True)
class Deleted:
    """An object was deleted."""

    name: str


WatchEvent = Listed | Changed | Deleted


@dataclass(frozen=True, slots=True)
class GrantList:
    """All Grants of the node in one NodeGrants object.

    Attributes:
        generation: metadata.generation of the NodeGrants.
        grants: The Grants, None if they have not changed since the previous event.
        reported: Reports in the status of the NodeGrants, by uid of the Grant.
        reported_generation: Generation that these reports refer to.
    """

    generation: int
    grants: tuple[Object, ...] | None
    reported: Mapping[str, ReportedGrant]
    reported_generation: int


LinkEnd = Literal["drone", "node"]
"""End of a direct link, by the name of its spec field. The drone requests pairing, and the node accepts it."""


@dataclass(frozen=True, slots=True)
class WatchTimes:
    """Timing of watches, in seconds.

    The API server sends a bookmark about once a minute, so a connection without any event for `silence_s` is dead.

    Attributes:
        server_s: Time after which the server ends a watch.
        silence_s: Time without an event after which the connection counts as dead.
        relist_s: Time after which the objects are listed again.
        first_retry_s: First delay after a failure.
        longest_retry_s: Longest delay after repeated failures.
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
_FLIGHT_PLAN = Kind(API_VERSION, FlightPlan.KIND, FlightPlan.PLURAL, namespaced=True)
_ACCESS_REVIEW = Kind(
    "authorization.k8s.io/v1", "SelfSubjectAccessReview", "selfsubjectaccessreviews", namespaced=False
)
_REVIEW_TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True)
class _WatchTarget:
    """Client, kind and selectors of a watch."""

    client: Client
    kind: Kind
    selectors: Mapping[str, str]
    namespace: str = ""


def _parse_status(body: Object) -> NodeGrantsStatus:
    """Parse the status of a NodeGrants. An invalid status, for example of another release, counts as empty."""
    try:
        return NodeGrantsStatus.model_validate(body.get("status") or {})
    except ValidationError as error:
        log.warning("grants: invalid status, reporting again (error=%s)", InvalidObject.from_pydantic(error))
        return NodeGrantsStatus()


async def connect(service_account: Path = SERVICE_ACCOUNT) -> Client:
    """Return a client that uses KUBECONFIG if set, otherwise the pod's service account.

    The token of the service account is read again when the API server refuses it.

    Raises:
        Unconfigured: There is neither KUBECONFIG nor a service account.
    """
    path = os.environ.get("KUBECONFIG")
    access = await kubeconfig(path) if path else await in_cluster(service_account)
    return Client(access, FIELD_MANAGER, trust_env=False)


class Store:
    """The node's own objects and Grants at the API server.

    Every call returns within CALL_TIMEOUT_S, or raises a KubeError.

    Args:
        client: Kubernetes client.
        node: Name of the node.
        times: Timing of watches.
    """

    def __init__(self, client: Client, node: str, times: WatchTimes | None = None) -> None:
        self._client = client
        # All agents share one account, which may not read Grants. Each node has its own account for its Grants.
        self._own_client = client.account(node, NODE_GRANTS_NAMESPACE, node)
        self._anonymous = client.without_credentials()
        self._node = node
        self._times = times or WatchTimes()
        self._last_event_s: dict[str, float] = {}

    def watch_ages_s(self) -> dict[str, float]:
        """Return the seconds since the last watch event or list response for each watched kind.

        The keys are the plural names of the kinds.
        """
        now_s = time.monotonic()
        return {plural: now_s - event_s for plural, event_s in self._last_event_s.items()}

    async def node_labels(self) -> dict[str, str] | None:
        """Return the labels of the Kubernetes Node, None if it does not exist."""
        node = await self._get(_NODE, self._node)
        return None if node is None else dict(node["metadata"].get("labels", {}))

    async def node_object(self, kind: str) -> Object | None:
        """Return the node's Drone or EdgeNode, None if it does not exist."""
        return await self._get(_KINDS[kind], self._node)

    async def create(self, body: Object) -> Object:
        """Create a Drone or EdgeNode.

        Raises:
            Conflict: The object exists already.
            Invalid: The API server refused the object.
        """
        return await self._client.create(_KINDS[body["kind"]], body, strict=False)

    async def replace(self, body: Object) -> Object:
        """Replace a Drone or EdgeNode with the same resourceVersion.

        Raises:
            Conflict: The object was changed since it was read.
            Invalid: The API server refused the object.
        """
        return await self._client.replace(_KINDS[body["kind"]], body)

    async def apply_status(self, kind: str, name: str, status: Object, end: LinkEnd | None = None) -> Object | None:
        """Apply the agent's part of a status (server-side apply).

        Args:
            kind: Kind of the object.
            name: Name of the object.
            status: All status fields that this agent owns.
            end: End of a DirectLink, because the agents of both ends own different fields.

        Returns:
            The object after the change, None if it does not exist.
        """
        body = {**_KINDS[kind].header(name), "status": status}
        manager = f"{FIELD_MANAGER}-{end}" if end else None
        try:
            return await self._client.apply(_KINDS[kind], body, subresource="status", field_manager=manager)
        except NotFound:
            return None

    async def authority(self) -> bytes | None:
        """Return the PEM certificates of the authority, None if the operator has not published them."""
        config_map = await self._get(_CONFIG_MAP, "fractus-ca", SYSTEM_NAMESPACE)
        if config_map is None:
            return None
        text = (config_map.get("data") or {}).get("ca.crt")
        return text.encode() if text else None

    async def request_certificate(self, name: str, request_pem: bytes, lifetime_s: int) -> None:
        """Create a signing request. If the name exists, nothing is created, because the name contains a hash of the request."""
        body: Object = {
            **_SIGNING_REQUEST.header(name, labels={NODE_LABEL: self._node}),
            "spec": {
                "request": base64.b64encode(request_pem).decode(),
                "signerName": NODE_SIGNER,
                "expirationSeconds": lifetime_s,
                "usages": ["digital signature", "server auth", "client auth"],
            },
        }
        with contextlib.suppress(Conflict):
            await self._client.create(_SIGNING_REQUEST, body, strict=False)

    async def certificate_request(self, name: str) -> Object | None:
        """Return the signing request with its status, None if it was deleted."""
        return await self._get(_SIGNING_REQUEST, name)

    async def delete_certificate_requests(self) -> None:
        """Delete all signing requests of this node."""
        selectors = {"labelSelector": f"{NODE_LABEL}={self._node}"}
        for item in (
            await self._client.list_whole(_SIGNING_REQUEST, selectors=selectors, timeout_s=CALL_TIMEOUT_S)
        ).items:
            name = item["metadata"]["name"]
            if name.startswith(f"fractus-{self._node}-"):
                await self._client.delete(_SIGNING_REQUEST, ("", name))

    async def grants(self) -> AsyncGenerator[GrantList, None]:
        """Yield the node's Grants once after a list, and again after each change.

        Only a valid NodeGrants object is authoritative. If the object does not exist yet, was deleted, is withheld or
        damaged, nothing is yielded, and the drone keeps its Grants.
        """
        target = _WatchTarget(
            self._own_client, _NODE_GRANTS, {"fieldSelector": f"metadata.name={self._node}"}, NODE_GRANTS_NAMESPACE
        )
        packed: str | None = None
        async for event in self._follow(target):
            if isinstance(event, Deleted) or (isinstance(event, Listed) and not event.objects):
                log.warning("grants: no NodeGrants object, keeping the stored Grants (node=%s)", self._node)
                packed = None
                continue
            if isinstance(event, Listed):
                # Forget the last Grants, so that those of the list are compared with the disk even if they have not
                # changed.
                body = event.objects[0]
                packed = None
            else:
                body = event.object
            try:
                node_grants = NodeGrants.from_body({**body, "status": None})
                spec = node_grants.spec
                grants = None if spec.packed == packed else await asyncio.to_thread(unpack, spec.packed, spec.count)
            except InvalidObject as error:
                log.error("grants: invalid NodeGrants, keeping the stored Grants (error=%s)", error)  # noqa: TRY400
                continue
            packed = spec.packed
            status = _parse_status(body)
            reported = {report.uid: report for report in status.grants}
            yield GrantList(node_grants.metadata.generation or 0, grants, reported, status.observed_generation or 0)
            # Free the memory, because unpacked Grants are large and the next event may be hours away.
            del event, body, node_grants, spec, grants

    async def report_grants(self, generation: int, reports: Sequence[ReportedGrant]) -> bool:
        """Write the reports of the node's Grants. Return False if the NodeGrants object does not exist."""
        status = {"observedGeneration": generation, "grants": [report.to_dict() for report in reports]}
        body = {**_NODE_GRANTS.header(self._node, NODE_GRANTS_NAMESPACE), "status": status}
        try:
            await self._own_client.apply(_NODE_GRANTS, body, subresource="status")
        except NotFound:
            return False
        return True

    def direct_links(self, end: LinkEnd) -> AsyncGenerator[WatchEvent, None]:
        """Yield list and watch events of the node's DirectLinks."""
        selectors = {"fieldSelector": f"spec.{end}={self._node}"}
        return self._follow(_WatchTarget(self._client, _KINDS["DirectLink"], selectors))

    async def _follow(self, target: _WatchTarget) -> AsyncGenerator[WatchEvent, None]:
        """Yield a complete list, then changes, and another list after each interruption, indefinitely.

        An interruption never yields an empty list. After an interruption the objects are listed again, and the watch is not
        resumed, because an API server restored from a backup may have lower resource versions. The list is short.
        """
        backoff = Backoff(self._times.first_retry_s, self._times.longest_retry_s)
        kind = target.kind
        self._last_event_s.setdefault(kind.plural, time.monotonic())
        while True:
            started_s = time.monotonic()
            try:
                objects, version = await self._list(target)
                self._last_event_s[kind.plural] = time.monotonic()
                if backoff.attempts > 1:
                    log.info("%s: API server reachable again (attempts=%d)", kind.plural, backoff.attempts)
                yield Listed(objects)
                async with contextlib.aclosing(self._watch(target, version)) as events:
                    async for event in events:
                        yield event
            except Expired:
                log.debug("%s: watch expired, listing again", kind.plural)
            except KubeError as error:
                level = logging.WARNING if backoff.attempts == 0 else logging.DEBUG
                log.log(level, "%s: watch failed, keeping the stored objects (error=%s)", kind.plural, error)
            if time.monotonic() - started_s > 30.0:
                backoff.succeeded()
            await asyncio.sleep(backoff.delay_s())

    @property
    def contact_age_s(self) -> float:
        """Seconds since the last successful request to the API server, infinite before the first."""
        return time.monotonic() - max(self._client.succeeded_at, self._own_client.succeeded_at)

    async def is_reachable(self, timeout_s: float) -> bool:
        """Return True if the API server responds within the timeout. A refusal counts as a response."""
        return await self._client.responds(timeout_s)

    async def plan_with_records(self, token: str, namespace: str, name: str) -> Object:
        """Return a FlightPlan whose records the holder of a token may read.

        The requests are authorised with this token, so the agent needs no permissions on FlightPlans.

        Raises:
            KubeError: The holder may not read the plan or its records, the plan does not exist, or the API server does not respond.
        """
        client = self._anonymous.on_behalf_of(token)
        attributes = {
            "group": GROUP, "resource": FlightPlan.PLURAL, "subresource": "records", "verb": "get", "namespace": namespace,
            "name": name,
        }  # fmt: skip
        review: Body = {
            "apiVersion": _ACCESS_REVIEW.api_version,
            "kind": _ACCESS_REVIEW.name,
            "spec": {"resourceAttributes": attributes},
        }
        reviewed = await client.request("POST", _ACCESS_REVIEW.path(""), review, timeout_s=_REVIEW_TIMEOUT_S)
        if (reviewed.get("status") or {}).get("allowed") is not True:
            message = (
                f"you may not read the records of {name}: you need get on flightplans/records in namespace {namespace}"
            )
            raise KubeError(HTTPStatus.FORBIDDEN, "Forbidden", message)
        return await client.request("GET", _FLIGHT_PLAN.path(namespace, name), timeout_s=_REVIEW_TIMEOUT_S)

    async def close(self) -> None:
        """Close the connections."""
        await self._anonymous.aclose()
        await self._own_client.aclose()
        await self._client.aclose()

    async def _get(self, kind: Kind, name: str, namespace: str = "") -> Object | None:
        try:
            return await self._client.get(kind, name, namespace)
        except NotFound:
            return None

    async def _list(self, target: _WatchTarget) -> tuple[tuple[Object, ...], str]:
        page = await target.client.list_whole(
            target.kind, namespace=target.namespace, selectors=target.selectors, timeout_s=CALL_TIMEOUT_S
        )
        return tuple(page.items), page.resource_version

    async def _watch(self, target: _WatchTarget, version: str) -> AsyncGenerator[WatchEvent, None]:
        until_s = time.monotonic() + self._times.relist_s
        while time.monotonic() < until_s:
            opened_s = time.monotonic()
            events = target.client.watch(
                target.kind,
                resource_version=version,
                namespace=target.namespace,
                selectors=target.selectors,
                timeout_s=self._times.server_s,
                silence_s=self._times.silence_s,
            )
            async for change, body in events:
                version = body["metadata"]["resourceVersion"]
                self._last_event_s[target.kind.plural] = time.monotonic()
                if change == "DELETED":
                    yield Deleted(body["metadata"]["name"])
                elif change in ("ADDED", "MODIFIED"):
                    yield Changed(body)
            if time.monotonic() - opened_s < 1.0:
                raise KubeError(0, "Unreachable", "the API server closed the watch immediately")
