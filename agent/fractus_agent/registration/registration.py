"""Registration of the node: creates its Drone or EdgeNode from the description on the node.

After that the object belongs to its owner.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
from collections.abc import Callable
from pathlib import Path

from fractus_core.api.conditions import ConditionUpdate
from fractus_core.api.model import GROUP, InvalidObject
from fractus_core.api.names import CLASS_LABEL
from fractus_core.api.nodes import Drone, EdgeNode, InvalidDescription, parse_description
from fractus_runtime.files import read_file

from fractus_agent.registration.node_object_file import NodeObjectFile
from fractus_agent.store import Invalid, KubeError, Object, Store
from fractus_agent.supervisor import repeat

log = logging.getLogger(__name__)

HASH_ANNOTATION = f"{GROUP}/description-hash"
DESCRIPTION_CHECK_INTERVAL_S = 10.0
"""Seconds between checks of the description on the node."""
RESYNC_INTERVAL_S = 300.0
"""Seconds between reads of the object from the API server. Each status write also returns the object."""
_KINDS: dict[str, type[Drone] | type[EdgeNode]] = {"Drone": Drone, "EdgeNode": EdgeNode}
_KIND_OF_CLASS = {"drone": "Drone", "edge": "EdgeNode"}


def parse_node_description(text: str, node: str) -> Drone | EdgeNode:
    """Parse the manifest of a node's Drone or EdgeNode.

    Raises:
        InvalidDescription: The manifest is invalid, or describes another node.
    """
    described = parse_description(text, Drone, EdgeNode)
    if described is None:
        raise InvalidDescription("is empty; write this node's Drone or EdgeNode manifest to it")
    if described.name != node:
        raise InvalidDescription(f"metadata.name: is {described.name}, but this node is {node}")
    return described


def description_hash(described: Drone | EdgeNode) -> str:
    """Return the digest of a description. Comments and layout do not matter."""
    content = {
        "kind": described.kind,
        "labels": described.metadata.labels,
        "spec": described.spec.model_dump(mode="json"),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


class Registration:
    """Keeps the node registered.

    The object is written only if it is missing, or if the description on the node has changed since it was last applied
    (annotation fractus.dev/description-hash). Otherwise the owner's edits stay.

    Args:
        store: The node's objects at the API server.
        path: File of the description.
        node: Name of the node.
        object_file: File of the node's object, for the services of the node.
        on_change: Called when the object or the condition has changed.

    Attributes:
        body: The object at the API server, None if missing.
        resource: The last valid object, None before the first.
        description_problem: Condition Described if the description is invalid, otherwise None.
    """

    def __init__(
        self,
        store: Store,
        path: Path,
        node: str,
        object_file: NodeObjectFile,
        *,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self._store = store
        self._path = path
        self._node = node
        self._object_file = object_file
        self._on_change = on_change
        self._stamp: object = None
        self._gone = asyncio.Event()
        self._resync_s = 0.0
        self.body: Object | None = None
        self.resource: Drone | EdgeNode | None = None
        self.description_problem: ConditionUpdate | None = None

    async def run(self) -> None:
        """Keep the node registered until cancelled."""
        await repeat("registration", self._check, self._gone)

    async def _check(self) -> float:
        now_s = asyncio.get_running_loop().time()
        if self._file_changed() or self.body is None or now_s >= self._resync_s:
            try:
                await self.step()
            except KubeError:
                self._stamp = None  # the next check repeats the registration even if the file stays the same
                raise
            self._resync_s = now_s + RESYNC_INTERVAL_S
        return DESCRIPTION_CHECK_INTERVAL_S

    def on_status_written(self, body: Object | None) -> None:
        """Handle the object that a status write returned, None if it does not exist."""
        if body is None:
            log.warning("registration: node object deleted")
            self.body = None
            self._gone.set()
            return
        old = self.body
        self.body = body
        if old is None or old["metadata"].get("generation") != body["metadata"].get("generation"):
            self._parse(body)

    async def step(self) -> None:
        """Synchronize the object with the description once.

        Raises:
            Conflict: The object was changed in between.
            Invalid: The API server refused the object.
            KubeError: The API server is unreachable.
        """
        described = self._read_description()
        labels = await self._store.node_labels()
        kind = _KIND_OF_CLASS.get((labels or {}).get(CLASS_LABEL, ""))
        if described is not None and kind not in (None, described.kind):
            self._set_invalid(f"kind: is {described.kind}, but the node's label {CLASS_LABEL} requires {kind}")
            described = None
        kind = described.kind if described is not None else kind
        if kind is None:
            log.debug("registration: node kind unknown (description=%s label=%s)", self._path, CLASS_LABEL)
            return
        body = await self._store.node_object(kind)
        if described is not None:
            body = await self._register(described, body)
        self._set_body(body)

    async def _register(self, described: Drone | EdgeNode, body: Object | None) -> Object:
        digest = description_hash(described)
        try:
            if body is None:
                metadata: Object = {
                    "name": self._node,
                    "labels": described.metadata.labels,
                    "annotations": described.metadata.annotations | {HASH_ANNOTATION: digest},
                }
                manifest = {key: value for key, value in described.to_dict().items() if key != "status"}
                created = await self._store.create(manifest | {"metadata": metadata})
                log.info("registration: created (kind=%s node=%s)", described.kind, self._node)
                return created
            applied = body["metadata"].get("annotations", {}).get(HASH_ANNOTATION)
            if applied == digest:
                return body
            metadata = dict(body["metadata"])
            metadata["annotations"] = metadata.get("annotations", {}) | {HASH_ANNOTATION: digest}
            changed = body | {"metadata": metadata}
            if applied is not None:
                # A changed description overrides the owner's edits, because its author has access to the hardware.
                metadata["labels"] = metadata.get("labels", {}) | described.metadata.labels
                changed["spec"] = described.to_dict()["spec"]
                log.info("registration: description changed (kind=%s node=%s)", described.kind, self._node)
            return await self._store.replace(changed)
        except Invalid as error:
            self._set_invalid(f"the API server refused it: {error}")
            self._set_body(body)
            raise

    def _set_body(self, body: Object | None) -> None:
        self.body = body
        if body is None:
            if self.description_problem is None:
                log.debug("registration: waiting for the owner to create the object (node=%s)", self._node)
            return
        self._parse(body)

    def _parse(self, body: Object) -> None:
        try:
            self.resource = _KINDS[body["kind"]].from_body({k: v for k, v in body.items() if k != "status"})
        except InvalidObject as error:
            log.warning("registration: invalid node object (error=%s)", error)
            self._object_file.clear(f"The agent cannot parse the object: {error}.")
        else:
            self._object_file.write(self.resource)
        self._on_change()

    def _file_changed(self) -> bool:
        try:
            status = self._path.stat()
            stamp: object = (status.st_ino, status.st_mtime_ns, status.st_size)
        except OSError:
            stamp = "absent"
        changed = stamp != self._stamp
        self._stamp = stamp
        return changed

    def _read_description(self) -> Drone | EdgeNode | None:
        try:
            described = parse_node_description(read_file(self._path).decode(), self._node)
        except FileNotFoundError:
            self.description_problem = None
            return None
        except (OSError, UnicodeDecodeError, InvalidDescription) as error:
            self._set_invalid(str(error))
            return None
        self.description_problem = None
        return described

    def _set_invalid(self, problem: str) -> None:
        condition = ConditionUpdate("Described", "False", "InvalidDescription", f"{self._path}: {problem}.")
        if condition != self.description_problem:
            log.error("registration: invalid description (file=%s error=%s)", self._path, problem)
            self.description_problem = condition
            self._on_change()
