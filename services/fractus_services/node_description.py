"""Description of this node from its agent or from a local file. It is read again when it changes."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

from fractus_core.api.nodes import Drone, EdgeNode, InvalidDescription, parse_description
from fractus_runtime.files import read_file

from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

POLL_INTERVAL_S = 1.0


class NodeDescription:
    """The manifest that describes this node.

    The agent stores the node's object from the API server, with its owner's edits. It takes precedence over the local file. An
    object that is unreadable or belongs to another node counts as no description. The camera then counts as seeing everything.

    Args:
        node: Name of this node, or None to take it from the description.
        agent_file: File in which the agent stores the object.
        local_file: File of the node's owner.
        kinds: Permitted kinds of nodes.

    Attributes:
        value: The manifest, or None if there is no description.

    Raises:
        CannotServe: The local file is not a valid manifest of one of the kinds.
    """

    def __init__(self, node: str | None, agent_file: Path, local_file: Path, *kinds: type[Drone | EdgeNode]) -> None:
        self._node = node
        self._paths = (agent_file, local_file)
        self._kinds = kinds
        self._stamps = self._stamps_now()
        self.value = self._read()
        if self.value is None:
            log.warning("description: missing, using defaults (files=%s,%s)", *self._paths)

    async def changed(self) -> None:
        """Wait until the manifest changes."""
        while True:
            await asyncio.sleep(POLL_INTERVAL_S)
            stamps = self._stamps_now()
            if stamps == self._stamps:
                continue
            self._stamps = stamps
            before = self.value
            try:
                self.value = self._read()
            except CannotServe as error:
                log.critical("description: invalid, the node counts as not described (error=%s)", error)
                self.value = None
            if self.value != before:
                log.warning("description: changed (described=%s)", self.value is not None)
                return

    def _stamps_now(self) -> tuple[object, ...]:
        return tuple(_stamp(path) for path in self._paths)

    def _read(self) -> Drone | EdgeNode | None:
        agent_file, local_file = self._paths
        try:
            manifest = _parse(agent_file, self._kinds)
            if manifest is None and agent_file.is_file():
                raise CannotServe(f"{agent_file}: is empty")
            if manifest is not None and self._node not in (None, manifest.name):
                raise CannotServe(f"{agent_file}: describes {manifest.name}, but this node is {self._node}")
        except CannotServe as error:
            # Do not fall back to the local file: it may be older, and describe a camera with a smaller view.
            log.critical("description: agent's file invalid, the node counts as not described (error=%s)", error)
            return None
        return manifest or _parse(local_file, self._kinds, "--description ")


def _stamp(path: Path) -> object:
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_ino, stat.st_mtime_ns, stat.st_size


def _parse(path: Path, kinds: tuple[type[Drone | EdgeNode], ...], option: str = "") -> Drone | EdgeNode | None:
    try:
        return parse_description(read_file(path).decode(), *kinds)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise CannotServe(f"{option}{path}: cannot be read: {error}") from None
    except InvalidDescription as error:
        raise CannotServe(f"{option}{path}: {error}") from None
