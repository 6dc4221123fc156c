"""The node's Drone or EdgeNode: made from the description on the node, then left to its owner."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import yaml
from fractus_core.api.model import GROUP, InvalidObject
from fractus_core.api.nodes import Drone, EdgeNode

from fractus_agent.cluster.store import Backoff, Invalid, KubeError, Object
from fractus_agent.conditions import Finding

LOG = logging.getLogger(__name__)

HASH_ANNOTATION = f"{GROUP}/description-hash"
CLASS_LABEL = f"{GROUP}/class"
LOOK_S = 10.0
"""Seconds between looks at the description on the node."""
RESYNC_S = 300.0
"""Seconds between looks at the object, beside what every status write tells of it."""
_KINDS: dict[str, type[Drone] | type[EdgeNode]] = {"Drone": Drone, "EdgeNode": EdgeNode}
_KIND_OF_CLASS = {"drone": "Drone", "edge": "EdgeNode"}


class InvalidDescription(Exception):
    """The description on the node cannot be used; the message says what to mend."""


class NodeStore(Protocol):
    """What registration needs of the store."""

    async def node_labels(self) -> dict[str, str] | None:
        """Labels of the Kubernetes Node."""

    async def described(self, kind: str) -> Object | None:
        """The node's object."""

    async def create(self, body: Object) -> Object:
        """Create it."""

    async def replace(self, body: Object) -> Object:
        """Replace it."""


def parse_description(text: str, node: str) -> Drone | EdgeNode:
    """The Drone or EdgeNode that a manifest describes.

    Raises:
        InvalidDescription: it is not one, or another node's.
    """
    try:
        body = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InvalidDescription(f"is not YAML: {error}") from error
    kind = _KINDS.get(body.get("kind", "")) if isinstance(body, dict) else None
    if kind is None:
        raise InvalidDescription("kind: must be Drone or EdgeNode")
    try:
        described = kind.from_body(body)
    except InvalidObject as error:
        raise InvalidDescription(str(error)) from error
    if described.name != node:
        raise InvalidDescription(f"metadata.name: is {described.name}, but this node is {node}")
    return described


def description_hash(described: Drone | EdgeNode) -> str:
    """Digest of what the description says; comments and layout do not count."""
    said = {"kind": described.kind, "labels": described.metadata.labels, "spec": described.spec.model_dump(mode="json")}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]


class Registration:
    """Sees to it that the node has its object.

    The object is written in two cases only: it is absent, or the description on the node changed since it was last
    taken over (annotation fractus.dev/description-hash). The owner's edits of an object stay.
    """

    def __init__(self, store: NodeStore, path: Path, node: str, *, changed: Callable[[], None] = lambda: None) -> None:
        self._store = store
        self._path = path
        self._node = node
        self._changed = changed
        self._stamp: object = None
        self._again = asyncio.Event()
        self.body: Object | None = None
        self.resource: Drone | EdgeNode | None = None
        self.described: Finding | None = None

    async def run(self) -> None:
        """Keep the node registered, for ever."""
        backoff = Backoff(0.5, 15.0)
        loop = asyncio.get_running_loop()
        resync_s = loop.time()
        while True:
            self._again.clear()
            try:
                if self._file_changed() or self.body is None or loop.time() >= resync_s:
                    await self.step()
                    resync_s = loop.time() + RESYNC_S
                    backoff.succeeded()
            except KubeError as error:
                LOG.log(logging.DEBUG if backoff.attempts else logging.WARNING, "registration waits: %s", error)
                self._stamp = None
                await asyncio.sleep(backoff.delay_s())
                continue
            try:
                await asyncio.wait_for(self._again.wait(), LOOK_S)
            except TimeoutError:
                continue

    def seen(self, body: Object | None) -> None:
        """Take the object as a write of its status returned it; None when it is gone."""
        if body is None:
            LOG.info("the node's object is gone")
            self.body = None
            self._again.set()
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
            self._undescribed(f"kind: is {described.kind}, but the node's label {CLASS_LABEL} calls for {kind}")
            described = None
        kind = described.kind if described is not None else kind
        if kind is None:
            LOG.debug("neither %s nor the label %s tells what this node is", self._path, CLASS_LABEL)
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
                LOG.info("registered %s %s", described.kind, self._node)
                return created
            known = body["metadata"].get("annotations", {}).get(HASH_ANNOTATION)
            if known == digest:
                return body
            metadata = dict(body["metadata"])
            metadata["annotations"] = metadata.get("annotations", {}) | {HASH_ANNOTATION: digest}
            changed = body | {"metadata": metadata}
            if known is not None:
                # The description changed on the node: the newest word on the hardware.
                metadata["labels"] = metadata.get("labels", {}) | described.metadata.labels
                changed["spec"] = described.to_dict()["spec"]
                LOG.info("took over the changed description of %s %s", described.kind, self._node)
            return await self._store.replace(changed)
        except Invalid as error:
            self._undescribed(f"the API server refuses it: {error}")
            self._take(body)
            raise

    def _take(self, body: Object | None) -> None:
        self.body = body
        if body is None:
            if self.described is None:
                LOG.debug("waiting for the owner's object of %s", self._node)
            return
        self._read(body)

    def _read(self, body: Object) -> None:
        try:
            self.resource = _KINDS[body["kind"]].from_body({k: v for k, v in body.items() if k != "status"})
        except InvalidObject as error:
            LOG.warning("the agent cannot read the node's object: %s", error)
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
            described = parse_description(self._path.read_text(encoding="utf-8"), self._node)
        except FileNotFoundError:
            self.described = None
            return None
        except (OSError, UnicodeDecodeError, InvalidDescription) as error:
            self._undescribed(str(error))
            return None
        self.described = None
        return described

    def _undescribed(self, problem: str) -> None:
        found = Finding("Described", "False", "InvalidDescription", f"{self._path}: {problem}.")
        if found != self.described:
            LOG.error("the description of this node cannot be used: %s: %s", self._path, problem)
            self.described = found
            self._changed()
