"""What this node is, as its agent hands it over or as its owner's file says; read again when that changes."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

from fractus_core.api.nodes import Drone, EdgeNode, InvalidDescription, parse_description

from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

POLL_INTERVAL_S = 1.0


class NodeDescription:
    """The manifest that describes this node.

    What the agent hands over is the node's object as the API server has it, with its owner's edits; it counts before the
    file. What cannot be read, or is another node's, describes nothing: the camera then counts as seeing everything.

    Args:
        node: this node's name; None where only the description tells it.
        handed: where the agent stores the object.
        file: the owner's.
        kinds: which kinds of node there may be.

    Attributes:
        value: the manifest; None where there is none.

    Raises:
        CannotServe: the owner's file is not a valid manifest of one of these kinds.
    """

    def __init__(self, node: str | None, handed: Path, file: Path, *kinds: type[Drone | EdgeNode]) -> None:
        self._node = node
        self._paths = (handed, file)
        self._kinds = kinds
        self._stamps = self._stamps_now()
        self.value = self._read()
        if self.value is None:
            log.warning("description: this node has none, using defaults (files=%s,%s)", *self._paths)

    async def changed(self) -> None:
        """Wait until the manifest says something else."""
        while True:
            await asyncio.sleep(POLL_INTERVAL_S)
            stamps = self._stamps_now()
            if stamps == self._stamps:
                continue
            self._stamps, before = stamps, self.value
            try:
                self.value = self._read()
            except CannotServe as error:
                log.critical("description: cannot be used, the node counts as not described: %s", error)
                self.value = None
            if self.value != before:
                log.warning("description: changed (described=%s)", self.value is not None)
                return

    def _stamps_now(self) -> tuple[object, ...]:
        return tuple(_stamp(path) for path in self._paths)

    def _read(self) -> Drone | EdgeNode | None:
        handed, file = self._paths
        try:
            found = _parsed(handed, self._kinds)
            if found is None and handed.is_file():
                raise CannotServe(f"{handed}: is empty")
            if found is not None and self._node not in (None, found.name):
                raise CannotServe(f"{handed}: is of {found.name}, and this node is {self._node}")
        except CannotServe as error:
            # Not the file instead: it may be older, and describe a camera that sees less.
            log.critical("description: the agent's cannot be used, the node counts as not described: %s", error)
            return None
        return found or _parsed(file, self._kinds, "--description ")


def _stamp(path: Path) -> object:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def _parsed(path: Path, kinds: tuple[type[Drone | EdgeNode], ...], option: str = "") -> Drone | EdgeNode | None:
    try:
        return parse_description(path.read_text(encoding="utf-8"), *kinds)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise CannotServe(f"{option}{path}: cannot be read: {error}") from None
    except InvalidDescription as error:
        raise CannotServe(f"{option}{path}: {error}") from None
