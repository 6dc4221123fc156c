"""The node's object for the services of the node, which never ask the API server."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_runtime.files import remove_temporary, write_file

from fractus_agent.conditions import Condition

LOG = logging.getLogger(__name__)


class Handover:
    """Stores the node's object where its services read it, and says what they cannot judge.

    Args:
        path: the file; who can write it decides what the camera is taken to see, as with the grants beside it.

    Attributes:
        condition: why privacy policies are not judged by what the camera really sees; None while they are.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.condition: Condition | None = None
        remove_temporary(path)

    def stored(self) -> Drone | EdgeNode | None:
        """The object as it was handed over last; None when none was, or it cannot be read."""
        try:
            body = json.loads(self._path.read_bytes())
            return Drone.from_body(body) if body["kind"] == "Drone" else EdgeNode.from_body(body)
        except (OSError, ValueError, KeyError, TypeError, RecursionError, InvalidObject):
            return None

    def put(self, resource: Drone | EdgeNode) -> None:
        """Store the object."""
        content, found = stored_form(resource), self._described(resource)
        try:
            if not self._path.exists() or self._path.read_bytes() != content:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_file(self._path, content)
                LOG.info("registration: handed over to the services (file=%s)", self._path)
        except OSError as error:
            found = f"The node cannot store its description for its services: {error.strerror or error}."
            self.drop()
        self._set(found)

    def drop(self, why: str = "") -> None:
        """Empty the file: what the services have is not what holds.

        Without a file they would go by the owner's description, which may be older and of a camera that sees less.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("wb") as file:  # in place, as a full disk still lets a file become shorter
                os.fsync(file.fileno())
        except OSError as error:
            LOG.warning("registration: cannot empty what was handed over (file=%s): %s", self._path, error)
        self._set(why)

    def _set(self, problem: str) -> None:
        found = Condition("CameraDescribed", "False", "ViewUnknown", problem) if problem else None
        if found is not None and found != self.condition:
            LOG.warning("registration: %s", problem)
        self.condition = found

    def _described(self, resource: Drone | EdgeNode) -> str:
        camera = resource.spec.services.camera
        missing = camera.unknown_view(isinstance(resource, EdgeNode)) if camera is not None else ""
        if not missing:
            return ""
        return (
            f"spec.services.camera has no {missing}: privacy policies take the camera to see everything around it, and"
            " hold wherever it is within 10 km of their zones."
        )


def stored_form(resource: Drone | EdgeNode) -> bytes:
    """The manifest as services read it.

    Defaults are left out, so that an agent which knows a new field does not write it for services that do not. What JSON
    would escape as two surrogates is no character in YAML, and is written as it is.
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
