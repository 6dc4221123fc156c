"""The node's Drone or EdgeNode: made from the description on the node, then left to its owner."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
from collections.abc import Callable
from pathlib import Path

from fractus_core.api.model import GROUP, InvalidObject
from fractus_core.api.names import CLASS_LABEL
from fractus_core.api.nodes import Drone, EdgeNode, InvalidDescription, parse_description

from fractus_agent.cluster.store import Invalid, KubeError, Object, Store
from fractus_agent.conditions import Condition
from fractus_agent.registration.handover import Handover
from fractus_agent.supervisor import repeat

LOG = logging.getLogger(__name__)

HASH_ANNOTATION = f"{GROUP}/description-hash"
CHECK_INTERVAL_S = 10.0
"""Seconds between checks of the description on the node."""
RESYNC_INTERVAL_S = 300.0
"""Seconds between reads of the object; every status write returns it too."""
_KINDS: dict[str, type[Drone] | type[EdgeNode]] = {"Drone": Drone, "EdgeNode": EdgeNode}
_KIND_OF_CLASS = {"drone": "Drone", "edge": "EdgeNode"}


def own_description(text: str, node: str) -> Drone | EdgeNode:
    """The Drone or EdgeNode that a manifest describes.

    Raises:
        InvalidDescription: it is not one, or another node's.
    """
    described = parse_description(text, Drone, EdgeNode)
    if described is None:
        raise InvalidDescription("is empty; put this node's Drone or EdgeNode manifest there")
    if described.name != node:
        raise InvalidDescription(f"metadata.name: is {described.name}, but this node is {node}")
    return described


def description_hash(described: Drone | EdgeNode) -> str:
    """Digest of what the description says; comments and layout do not count."""
    said = {"kind": described.kind, "labels": described.metadata.labels, "spec": described.spec.model_dump(mode="json")}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]


class Registration:
    """Keeps the node registered.

    The object is written in two cases only: it is absent, or the description on the node changed since it was last
    taken over (annotation fractus.dev/description-hash). The owner's edits of an object stay.
    """

    def __init__(
        self, store: Store, path: Path, node: str, handover: Handover, *, changed: Callable[[], None] = lambda: None
    ) -> None:
        self._store = store
        self._path = path
        self._node = node
        self._handover = handover
        self._changed = changed
        self._stamp: object = None
        self._gone = asyncio.Event()
        self._resync_s = 0.0
        self.body: Object | None = None
        self.resource: Drone | EdgeNode | None = None
        self.described: Condition | None = None

    async def run(self) -> None:
        """Keep the node registered until cancelled."""
        await repeat("registration", self._check, self._gone)

    async def _check(self) -> float:
        now_s = asyncio.get_running_loop().time()
        if self._file_changed() or self.body is None or now_s >= self._resync_s:
            try:
                await self.step()
            except KubeError:
                self._stamp = None  # so that the next check registers, whatever the file says
                raise
            self._resync_s = now_s + RESYNC_INTERVAL_S
        return CHECK_INTERVAL_S

    def seen(self, body: Object | None) -> None:
        """Take the object as a write of its status returned it; None when it is gone."""
        if body is None:
            LOG.warning("registration: the node's object was deleted")
            self.body = None
            self._gone.set()
            return
        old, self.body = self.body, body
        if old is None or old["metadata"].get("generation") != body["metadata"].get("generation"):
            self._read(body)

    async def step(self) -> None:
        """Bring the object in step with the description once.

        Raises:
            Conflict: the object was written in between.
            Invalid: the API server refuses the object.
            KubeError: the API server is out of reach.
        """
        described = self._description()
        labels = await self._store.node_labels()
        kind = _KIND_OF_CLASS.get((labels or {}).get(CLASS_LABEL, ""))
        if described is not None and kind not in (None, described.kind):
            self._set_invalid(f"kind: is {described.kind}, but the node's label {CLASS_LABEL} calls for {kind}")
            described = None
        kind = described.kind if described is not None else kind
        if kind is None:
            LOG.debug("registration: the node's kind is unknown (description=%s label=%s)", self._path, CLASS_LABEL)
            return
        body = await self._store.described(kind)
        if described is not None:
            body = await self._register(described, body)
        self._take(body)

    async def _register(self, described: Drone | EdgeNode, body: Object | None) -> Object:
        digest = description_hash(described)
        try:
            if body is None:
                made: Object = {
                    "name": self._node,
                    "labels": described.metadata.labels,
                    "annotations": described.metadata.annotations | {HASH_ANNOTATION: digest},
                }
                said = {key: value for key, value in described.to_dict().items() if key != "status"}
                created = await self._store.create(said | {"metadata": made})
                LOG.info("registration: created (kind=%s node=%s)", described.kind, self._node)
                return created
            known = body["metadata"].get("annotations", {}).get(HASH_ANNOTATION)
            if known == digest:
                return body
            metadata = dict(body["metadata"])
            metadata["annotations"] = metadata.get("annotations", {}) | {HASH_ANNOTATION: digest}
            changed = body | {"metadata": metadata}
            if known is not None:
                # Who changes the description on the node has the hardware in front of them: it overrides the owner's edits.
                metadata["labels"] = metadata.get("labels", {}) | described.metadata.labels
                changed["spec"] = described.to_dict()["spec"]
                LOG.info("registration: description changed (kind=%s node=%s)", described.kind, self._node)
            return await self._store.replace(changed)
        except Invalid as error:
            self._set_invalid(f"the API server refuses it: {error}")
            self._take(body)
            raise

    def _take(self, body: Object | None) -> None:
        self.body = body
        if body is None:
            if self.described is None:
                LOG.debug("registration: waiting for the owner's object (node=%s)", self._node)
            return
        self._read(body)

    def _read(self, body: Object) -> None:
        try:
            self.resource = _KINDS[body["kind"]].from_body({k: v for k, v in body.items() if k != "status"})
        except InvalidObject as error:
            LOG.warning("registration: the node's object cannot be read: %s", error)
            self._handover.drop(f"The agent cannot read the object: {error}.")
        else:
            self._handover.put(self.resource)
        self._changed()

    def _file_changed(self) -> bool:
        try:
            status = self._path.stat()
            stamp: object = (status.st_ino, status.st_mtime_ns, status.st_size)
        except OSError:
            stamp = "absent"
        changed, self._stamp = stamp != self._stamp, stamp
        return changed

    def _description(self) -> Drone | EdgeNode | None:
        try:
            described = own_description(self._path.read_text(encoding="utf-8"), self._node)
        except FileNotFoundError:
            self.described = None
            return None
        except (OSError, UnicodeDecodeError, InvalidDescription) as error:
            self._set_invalid(str(error))
            return None
        self.described = None
        return described

    def _set_invalid(self, problem: str) -> None:
        found = Condition("Described", "False", "InvalidDescription", f"{self._path}: {problem}.")
        if found != self.described:
            LOG.error("registration: the description cannot be used (file=%s): %s", self._path, problem)
            self.described = found
            self._changed()
