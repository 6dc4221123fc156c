"""File of the node's Drone or EdgeNode, for the services of the node, which never access the API server."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

from fractus_core.api.conditions import ConditionUpdate
from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_runtime.files import UnsuitableFile, open_regular, read_file, read_json, remove_temporary, write_file

log = logging.getLogger(__name__)


class NodeObjectFile:
    """Writes the node's object to the file that its services read, and checks the camera's description.

    Args:
        path: The file. Its content decides which area the camera is assumed to see, so only the agent may write it.

    Attributes:
        condition: Condition CameraDescribed if privacy policies cannot use the camera's real footprint, otherwise None.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.condition: ConditionUpdate | None = None
        remove_temporary(path)

    def read(self) -> Drone | EdgeNode | None:
        """Return the stored object, None if it is missing or invalid."""
        try:
            body = read_json(self._path)
            return Drone.from_body(body) if body["kind"] == "Drone" else EdgeNode.from_body(body)
        except (OSError, ValueError, KeyError, TypeError, InvalidObject):
            return None

    def write(self, resource: Drone | EdgeNode) -> None:
        """Write the object."""
        content = serialize_node_object(resource)
        problem = self._camera_problem(resource)
        try:
            if not self._contains(content):
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_file(self._path, content)
                log.info("registration: node object stored for the services (file=%s)", self._path)
        except OSError as error:
            problem = f"The node cannot store its description for its services: {error.strerror or error}."
            self.clear()
        self._set_condition(problem)

    def clear(self, problem: str = "") -> None:
        """Empty the file, because its content is outdated.

        The file is not removed: without it the services would use the owner's description, which may be older and
        describe a camera with a smaller footprint.

        Args:
            problem: Message of the condition, empty for none.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._truncate()
        except OSError as error:
            log.warning("registration: cannot empty the node object file (file=%s error=%s)", self._path, error)
        self._set_condition(problem)

    def _contains(self, content: bytes) -> bool:
        try:
            return read_file(self._path) == content
        except (FileNotFoundError, UnsuitableFile):
            return False

    def _truncate(self) -> None:
        """Empty the file in place, because this works even if the disk is full."""
        try:
            descriptor = open_regular(self._path, os.O_WRONLY | os.O_CREAT, 0o600)
        except UnsuitableFile:
            write_file(self._path, b"")
            return
        try:
            os.ftruncate(descriptor, 0)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def _set_condition(self, problem: str) -> None:
        condition = ConditionUpdate("CameraDescribed", "False", "ViewUnknown", problem) if problem else None
        if condition is not None and condition != self.condition:
            log.warning("registration: camera description incomplete (problem=%s)", problem)
        self.condition = condition

    def _camera_problem(self, resource: Drone | EdgeNode) -> str:
        """Return the missing parts of the camera's description, empty if it is complete."""
        camera = resource.spec.services.camera
        missing = camera.unknown_view(isinstance(resource, EdgeNode)) if camera is not None else ""
        if not missing:
            return ""
        return (
            f"spec.services.camera has no {missing}: privacy policies assume that the camera sees everything around it,"
            " and apply within 10 km of their zones."
        )


def serialize_node_object(resource: Drone | EdgeNode) -> bytes:
    """Serialize the manifest for the services.

    Defaults are left out, so that a newer agent does not write fields that older services do not know. Characters above
    U+FFFF are not escaped, because YAML does not accept surrogate pairs.
    """
    spec = resource.spec.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    body = {
        "apiVersion": resource.api_version,
        "kind": resource.kind,
        "metadata": {"name": resource.name},
        "spec": spec,
    }
    text = json.dumps(body, sort_keys=True, indent=1, ensure_ascii=False) + "\n"
    return "".join(c if c == "\n" or " " <= c <= "~" or c > "\uffff" else f"\\u{ord(c):04x}" for c in text).encode()
