"""Evidence of a run: delivery of each picture, state of each link, and positions of the drone."""

from __future__ import annotations

import itertools
import json
import re
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

from fractus_core.linking import LocalPosition

VIEWER = "aerial-viewer"
CHECKER = "image-checker"
AGENT = "agent"
CLOUD = "cloud"
LATE_S = 1.0
NOTICE_S = 1.0

_STATE = re.compile(r"links: (?P<phase>none|connecting|up) \(peer=(?P<peer>\S*) reason=(?P<reason>.*)\)")
_MEASURED = re.compile(r"links: measured \(peer=(?P<peer>\S+) mbps=(?P<mbps>[\d.]+)")
_TO_LINK = "the direct link scores"
_LOST = "NoDirectLink"
_DECIDED = re.compile(r"links: decided \(on=(?P<on>\S+) peer=(?P<peer>\S+)\): (?P<why>.*)")


@dataclass(slots=True)
class Picture:
    """Delivery of a picture. Times are Unix seconds.

    Attributes:
        received: Time of the first reception by each instance, by node.
        answered_s: Time when the sender received the response. None if it never did.
        took_s: Time from sending to the response.
        by: Node that responded.
    """

    number: int
    sent_s: float
    size: int
    received: dict[str, float] = field(default_factory=dict)
    twice_at_one: bool = False
    answered_s: float | None = None
    took_s: float = 0.0
    by: str = ""

    @property
    def received_s(self) -> float | None:
        """Time of the first reception."""
        return min(self.received.values(), default=None)


@dataclass(slots=True)
class Switch:
    """One direct link from the decision to its end. Times are Unix seconds, or None if the event never happened.

    Attributes:
        peer: Node.
        reason: Reason of the decision.
        decided_s: The drone's agent decided to connect.
        up_s: Pairing completed.
        measured_s: First bandwidth measurement.
        mbps: Measured bandwidth.
        spans: Time spans with traffic on the link. The end is None while it lasts.
        first_s: First picture that the node received.
        left: Reason of the end.
        ended_s: End of the link.
        lost: True if the link was lost while it carried traffic.
    """

    peer: str
    decided_s: float
    reason: str = ""
    up_s: float | None = None
    measured_s: float | None = None
    mbps: float | None = None
    spans: list[tuple[float, float | None]] = field(default_factory=list)
    first_s: float | None = None
    left: str = ""
    ended_s: float | None = None
    lost: bool = False

    @property
    def redirected_s(self) -> float | None:
        """Time when traffic first moved to the link."""
        return self.spans[0][0] if self.spans else None

    @property
    def back_s(self) -> float | None:
        """Time when traffic finally moved back to the cloud."""
        return self.spans[-1][1] if self.spans else None

    @property
    def leads(self) -> bool:
        """True while traffic uses the link."""
        return bool(self.spans) and self.spans[-1][1] is None

    def lead(self, at_s: float, *, direct: bool) -> None:
        """Move traffic to the link or back to the cloud at a time."""
        if direct and not self.leads:
            self.spans.append((at_s, None))
        elif not direct and self.leads:
            self.spans[-1] = (self.spans[-1][0], at_s)


@dataclass(frozen=True)
class Evidence:
    """Evidence of one run.

    Attributes:
        pictures: Pictures in sending order.
        switches: Links in decision order.
        track: Unix seconds and position, in metres east and north of the start and above it.
        cloud: Name of the cloud node.
    """

    pictures: tuple[Picture, ...]
    switches: tuple[Switch, ...]
    track: tuple[tuple[float, LocalPosition], ...]

    @property
    def longest_gap_s(self) -> float:
        """Longest time between two receptions."""
        return max(self.gap_s(abrupt=False), self.gap_s(abrupt=True))

    def gap_s(self, *, abrupt: bool) -> float:
        """Return the longest time between two receptions while a link with traffic was lost, or at all other times."""
        at = sorted(p.received_s for p in self.pictures if p.received_s is not None)
        lost = [s.ended_s for s in self.switches if s.lost and s.ended_s is not None]
        gaps = ((b - a, any(a - NOTICE_S <= when <= b for when in lost)) for a, b in itertools.pairwise(at))
        return max((gap for gap, at_loss in gaps if at_loss == abrupt), default=0.0)

    def counts(self) -> dict[str, int]:
        """Return the numbers of sent, received, lost, duplicated and late pictures.

        A picture is late if its response takes more than one second.
        """
        received = [p for p in self.pictures if p.received]
        return {
            "sent": len(self.pictures),
            "received": len(received),
            "lost": len(self.pictures) - len(received),
            "doubled": sum(p.twice_at_one for p in self.pictures),
            "repeated_elsewhere": sum(len(p.received) > 1 for p in self.pictures),
            "late": sum(p.answered_s is None or p.took_s > LATE_S for p in self.pictures),
        }

    def by_node(self) -> dict[str, int]:
        """Return the number of pictures that each node received first."""
        first = [min(p.received, key=p.received.__getitem__) for p in self.pictures if p.received]
        return dict(sorted(Counter(first).items()))


def read(lines: Sequence[Line], track: Iterable[tuple[float, LocalPosition]], drone: str) -> Evidence:
    """Read a run from its logs."""
    pictures = _pictures(lines)
    switches = _switches(line for line in lines if line.container == AGENT and line.node == drone)
    for switch in switches:
        own = (p.received[switch.peer] for p in pictures if switch.peer in p.received)
        end = switch.ended_s or float("inf")
        switch.first_s = min((at for at in own if switch.decided_s <= at <= end), default=None)
    return Evidence(tuple(pictures), tuple(switches), tuple(track))


def _pictures(lines: Iterable[Line]) -> list[Picture]:
    found: dict[int, Picture] = {}
    received: list[tuple[Line, dict[str, Any]]] = []
    for line in lines:
        if line.container not in (VIEWER, CHECKER) or not line.text.startswith("{"):
            continue
        try:
            said = json.loads(line.text)
        except ValueError:
            continue
        if said.get("event") == "sent":
            found[said["picture"]] = Picture(said["picture"], said["at"], said["bytes"])
        elif said.get("event") == "answered" and said["picture"] in found:
            picture = found[said["picture"]]
            picture.answered_s = said["at"]
            picture.took_s = said["took_s"]
            picture.by = said["by"]
        elif said.get("event") == "received":
            received.append((line, said))
    for line, said in received:
        picture_ = found.get(said["picture"])
        if picture_ is not None:
            picture_.twice_at_one |= line.node in picture_.received
            picture_.received.setdefault(line.node, said["at"])
    return sorted(found.values(), key=lambda picture: picture.number)


def _switches(lines: Iterable[Line]) -> list[Switch]:
    """Return the links from the agent's log: decisions, connections, measurements and traffic changes."""
    found: list[Switch] = []
    for line in lines:
        if (state := _STATE.search(line.text)) is not None:
            _state(found, line.at_s, state)
        elif (measured := _MEASURED.search(line.text)) is not None:
            last = _latest(found, measured["peer"])
            if last is not None and last.measured_s is None:
                last.measured_s = line.at_s
                last.mbps = float(measured["mbps"])
        elif (decided := _DECIDED.search(line.text)) is not None:
            _decided(found, line.at_s, decided)
    return found


def _latest(found: Iterable[Switch], peer: str) -> Switch | None:
    """Return the active link to a peer."""
    return next((s for s in found if s.peer == peer and s.ended_s is None), None)


def _state(found: list[Switch], at_s: float, state: re.Match[str]) -> None:
    phase = state["phase"]
    peer = state["peer"]
    own = _latest(found, peer)
    if own is None:
        if phase == "connecting":
            found.append(Switch(peer, at_s))
    elif phase == "up":
        own.up_s = at_s
    elif phase == "none":
        own.ended_s = at_s
        own.left = own.left or state["reason"]
        own.lost |= own.leads and "wanted" not in state["reason"]
        own.lead(at_s, direct=False)


def _decided(found: list[Switch], at_s: float, decided: re.Match[str]) -> None:
    """Record a decision on the link, or on the traffic of an application, which is identified by its namespace."""
    on = decided["on"]
    peer = decided["peer"]
    why = decided["why"]
    if on == "link":
        if peer != "-" and _latest(found, peer) is None:
            found.append(Switch(peer, at_s, why))
        return
    direct = _TO_LINK in why
    for own in found:
        if own.ended_s is None and own.up_s is not None and (not direct or own.peer == peer):
            # The decision on the traffic path can be logged before the end of the link.
            own.lost |= own.leads and why.startswith(_LOST)
            own.lead(at_s, direct=direct)
            own.left = "" if direct else own.left or why


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
