"""Kubernetes client of the operator: replaces specs, sets labels of foreign objects, and creates Events."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Self

from fractus_core.api.model import timestamp
from fractus_runtime.kubernetes import (
    Access,
    Client,
    Conflict,
    ContentType,
    Informer,
    Invalid,
    KubeError,
    LeaseThread,
    LostLease,
    NotFound,
    Unconfigured,
    from_environment,
)

from fractus_operator.kinds import EVENT, Body, Key, Kind, key_of

__all__ = [
    "Conflict",
    "ContentType",
    "Informer",
    "Invalid",
    "KubeError",
    "LeaseThread",
    "LostLease",
    "NotFound",
    "Store",
    "Unconfigured",
]

FIELD_MANAGER = "fractus-operator"
_OWNERSHIP_ATTEMPTS = 3
_MAX_NAME_LENGTH = 253
_MAX_EVENT_MESSAGE_LENGTH = 1024


class Store(Client):
    """The API server, as the operator uses it.

    Args:
        access: Address and credentials of the API server.
        may_write_s: Returns for how many seconds writes may still take effect. At 0 another operator may be the leader.
    """

    def __init__(self, access: Access, may_write_s: Callable[[], float] = lambda: float("inf")) -> None:
        super().__init__(access, FIELD_MANAGER, may_write_s=may_write_s)

    @classmethod
    async def connect(cls, may_write_s: Callable[[], float] = lambda: float("inf")) -> Self:
        """Connect to the cluster that this pod runs in, or to the cluster of KUBECONFIG.

        Args:
            may_write_s: See the class.

        Raises:
            Unconfigured: There are no credentials.
        """
        return cls(await from_environment(), may_write_s)

    async def replace_spec(self, kind: Kind, observed: Body, body: Body) -> Body:
        """Replace the spec of an existing object, and merge the given labels and annotations into its own.

        Signed objects need an exact spec. A server-side apply would leave fields of other managers.

        Raises:
            NotFound: The object was deleted.
            Conflict: The object was deleted and created again.
        """
        metadata = observed["metadata"]
        changes: list[Body] = [{"op": "test", "path": "/metadata/uid", "value": metadata["uid"]}]
        for field in ("labels", "annotations"):
            merged = {**(metadata.get(field) or {}), **(body["metadata"].get(field) or {})}
            changes.append({"op": "add", "path": f"/metadata/{field}", "value": merged})
        changes.append({"op": "add", "path": "/spec", "value": body["spec"]})
        namespace, name = key_of(observed)
        try:
            return await self.patch(
                kind, (namespace, name), changes, ContentType.JSON_PATCH, params={"fieldValidation": "Strict"}
            )
        except KubeError as error:
            # A failed "test" operation has the same status as an invalid object.
            if error.status == 422 and (await self.get(kind, name, namespace))["metadata"]["uid"] != metadata["uid"]:
                raise Conflict(409, "Conflict", f"{kind.name} {name} was created again") from error
            raise

    async def replace_status(self, kind: Kind, observed: Body, status: Body) -> Body:
        """Replace the whole status of an existing object, including fields of other managers.

        Raises:
            KubeError: The object was deleted or created again, the API server refused the status, or could not be reached.
        """
        changes = [
            {"op": "test", "path": "/metadata/uid", "value": observed["metadata"]["uid"]},
            {"op": "add", "path": "/status", "value": status},
        ]
        return await self.patch(kind, key_of(observed), changes, ContentType.JSON_PATCH, subresource="status")

    async def take_ownership(self, kind: Kind, key: Key) -> None:
        """Change the ownership of fields that this operator created with POST to ownership by apply.

        Otherwise a later apply would not remove them. See docs/decisions/0022-objects-are-created-by-post.md.

        Raises:
            Conflict: Another manager keeps changing the object.
        """
        for remaining in reversed(range(_OWNERSHIP_ATTEMPTS)):
            try:
                metadata = (await self.get(kind, key[1], key[0]))["metadata"]
                entries = _applied_entries(metadata.get("managedFields") or [])
                if entries is None:
                    return
                values = {"managedFields": entries, "resourceVersion": metadata["resourceVersion"]}
                changes = [{"op": "replace", "path": f"/metadata/{k}", "value": v} for k, v in values.items()]
                await self.patch(kind, key, changes, ContentType.JSON_PATCH)
            except NotFound:
                return
            except Conflict:
                if not remaining:
                    raise
            else:
                return

    async def set_labels(self, kind: Kind, name: str, labels: Mapping[str, str | None]) -> None:
        """Set labels of a cluster-scoped object that another client manages, and remove labels whose value is None.

        Raises:
            NotFound: The object does not exist. Unlike an apply, this request does not create it.
        """
        await self.patch(kind, ("", name), {"metadata": {"labels": dict(labels)}}, ContentType.MERGE)

    async def create_event(
        self, regarding: Body, *, reason: str, message: str, warning: bool, name: str, now: datetime
    ) -> None:
        """Create an Event about an object, as `kubectl describe` shows it.

        Args:
            regarding: Object that provides apiVersion, kind, metadata.name, metadata.namespace and metadata.uid.
            reason: CamelCase.
            message: One sentence.
            warning: True for type Warning, False for type Normal.
            name: Name of the Event. If an Event of that name exists, nothing is created.
            now: Time of the Event.
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
        if len(name) > _MAX_NAME_LENGTH:
            name = hashlib.sha256(name.encode()).hexdigest()
        stamp = timestamp(now)
        body = {
            **EVENT.header(name, namespace),
            "involvedObject": reference,
            "reason": reason,
            "message": message[:_MAX_EVENT_MESSAGE_LENGTH],
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


def _applied_entries(entries: Sequence[Body]) -> list[Body] | None:
    """Return metadata.managedFields with all fields of this operator as applied fields.

    Return None if all fields of this operator are applied fields already.
    """
    managed = [e for e in entries if e.get("manager") == FIELD_MANAGER and not e.get("subresource")]
    if all(entry["operation"] == "Apply" for entry in managed):
        return None
    fields: Body = {}
    for entry in managed:
        _merge_fields(fields, entry.get("fieldsV1") or {})
    others = [entry for entry in entries if entry not in managed]
    return [*others, {**managed[0], "operation": "Apply", "fieldsV1": fields}]


def _merge_fields(fields: Body, more: Body) -> None:
    for name, nested in more.items():
        _merge_fields(fields.setdefault(name, {}), nested)
