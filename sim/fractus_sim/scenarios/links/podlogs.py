"""Collection of container logs by line with timestamps. Lines are kept even if the pod is deleted early."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

POLL_S = 0.5
PODS = Path("var-log") / "pods"
_LINE = re.compile(r"(?P<at>\S+) (?:stdout|stderr) [FP] (?P<text>.*)")


@dataclass(frozen=True, slots=True)
class Line:
    """A log line of a container.

    Attributes:
        at_s: Unix seconds. All nodes share one clock.
        node: Node where the container ran.
        container: Name of the container.
        text: Line without line end.
    """

    at_s: float
    node: str
    container: str
    text: str


class PodLogs:
    """Follows container logs on the disks of the nodes in a thread.

    Args:
        nodes: Directory of each node.
        wanted: Names of the containers.
    """

    def __init__(self, nodes: Mapping[str, Path], wanted: Callable[[str], bool]) -> None:
        self._nodes = nodes
        self._wanted = wanted
        self._lines: list[Line] = []
        self._open: dict[Path, tuple[BinaryIO, str, str]] = {}
        self._rest: dict[Path, bytes] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pod logs", daemon=True)

    def start(self) -> None:
        """Start to follow the logs."""
        self._thread.start()

    def close(self) -> list[Line]:
        """Stop, and return all lines ordered by time."""
        self._over.set()
        self._thread.join()
        self.look()
        for file, _, _ in self._open.values():
            file.close()
        return sorted(self._lines, key=lambda line: line.at_s)

    def look(self) -> None:
        """Read new lines."""
        for node, directory in self._nodes.items():
            for path in sorted((directory / PODS).glob("*/*/*.log")):
                if path not in self._open and self._wanted(path.parent.name):
                    self._open[path] = (path.open("rb"), node, path.parent.name)
        for path, (file, node, container) in self._open.items():
            *whole, rest = (self._rest.get(path, b"") + file.read()).split(b"\n")
            self._rest[path] = rest
            self._lines += [line for raw in whole if (line := parse(raw, node, container)) is not None]

    def _run(self) -> None:
        while not self._over.wait(POLL_S):
            self.look()


def parse(raw: bytes, node: str, container: str) -> Line | None:
    """Parse a log line of the container runtime. Return None for any other line."""
    found = _LINE.fullmatch(raw.decode("utf-8", "replace"))
    if found is None:
        return None
    try:
        at_s = datetime.fromisoformat(found["at"]).timestamp()
    except ValueError:
        return None
    return Line(at_s, node, container, found["text"])
