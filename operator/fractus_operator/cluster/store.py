"""What the operator does with objects beyond reading and applying them: rewrites, ownership of fields, events."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Self

from fractus_runtime.kubernetes import (
    Access,
    Backoff,
    Client,
    Conflict,
    ContentType,
    Invalid,
    KubeError,
    LeaseThread,
    LostLease,
    NotFound,
    Reflector,
    Unconfigured,
    from_environment,
)

from fractus_operator.cluster.kinds import EVENT, Body, Key, Kind, key_of

__all__ = [
    "Backoff",
    "Conflict",
    "ContentType",
    "Invalid",
    "KubeError",
    "LeaseThread",
    "LostLease",
    "NotFound",
    "Reflector",
    "Store",
    "Unconfigured",
]

FIELD_MANAGER = "fractus-operator"
_TRIES = 3
_MAX_NAME = 253


class Store(Client):
    """Kubernetes, as far as the operator uses it."""

    def __init__(self, access: Access, may_write_s: Callable[[], float] = lambda: float("inf")) -> None:
        super().__init__(access, FIELD_MANAGER, may_write_s=may_write_s)

    @classmethod
    async def connect(cls, may_write_s: Callable[[], float] = lambda: float("inf")) -> Self:
        """Open the cluster of KUBECONFIG, or the one this pod runs in.

        Args:
            may_write_s: For how many seconds writes may still take effect; none: another operator may act.

        Raises:
            Unconfigured: there are no credentials.
        """
        return cls(await from_environment(), may_write_s)

    async def rewrite(self, kind: Kind, observed: Body, body: Body) -> Body:
        """Give an object exactly this spec, and these labels and annotations beside those it has.

        What is signed needs that: an apply leaves fields that others own. An object that is gone is not made again.

        Raises:
            NotFound: the object is gone.
            Conflict: it was made again.
        """
        metadata = observed["metadata"]
        changes: list[Body] = [{"op": "test", "path": "/metadata/uid", "value": metadata["uid"]}]
        for name in ("labels", "annotations"):
            together = {**(metadata.get(name) or {}), **(body["metadata"].get(name) or {})}
            changes.append({"op": "add", "path": f"/metadata/{name}", "value": together})
        changes.append({"op": "add", "path": "/spec", "value": body["spec"]})
        namespace, name = key_of(observed)
        try:
            return await self.patch(
                kind, (namespace, name), changes, ContentType.JSON_PATCH, params={"fieldValidation": "Strict"}
            )
        except KubeError as error:
            # A test that fails looks like any other change that is refused.
            if error.status == 422 and (await self.get(kind, name, namespace))["metadata"]["uid"] != metadata["uid"]:
                raise Conflict(409, "Conflict", f"{kind.name} {name} was made again") from error
            raise

    async def count_as_applied(self, kind: Kind, key: Key) -> None:
        """Let what this operator created count as applied by it: else no later apply takes a field of it away.

        An apply could create it, too; but for what is new that costs the API server three times as much.

        Raises:
            Conflict: another keeps changing it.
        """
        for left in reversed(range(_TRIES)):
            try:
                metadata = (await self.get(kind, key[1], key[0]))["metadata"]
                entries = _all_applied(metadata.get("managedFields") or [])
                if entries is None:
                    return
                changes = {"managedFields": entries, "resourceVersion": metadata["resourceVersion"]}
                steps = [{"op": "replace", "path": f"/metadata/{k}", "value": v} for k, v in changes.items()]
                await self.patch(kind, key, steps, ContentType.JSON_PATCH)
            except NotFound:
                return
            except Conflict:
                if not left:
                    raise
            else:
                return

    async def label(self, kind: Kind, name: str, labels: Mapping[str, str | None]) -> None:
        """Set labels of another's cluster-scoped object, and take off those that are None.

        Raises:
            NotFound: the object is gone; it is not made again, as an apply would.
        """
        await self.patch(kind, ("", name), {"metadata": {"labels": dict(labels)}}, ContentType.MERGE)

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
            # An object's name may be as long as any name.
            **EVENT.header(name if len(name) <= _MAX_NAME else hashlib.sha256(name.encode()).hexdigest(), namespace),
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
        except Conflict:
            return


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
