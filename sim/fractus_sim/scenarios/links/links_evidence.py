"""Evidence of a run: delivery of each picture, state of each link, and positions of the drone."""

from __future__ import annotations

import itertools
import json
import re
import threading
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

from fractus_core.linking import LocalPosition

POLL_S = 0.5
PODS = Path("var-log") / "pods"
_LINE = re.compile(r"(?P<at>\S+) (?:stdout|stderr) [FP] (?P<text>.*)")


@dataclass(frozen=True, slots=True)
class LogLine:
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

    def to_json(self) -> str:
        """Return the fields as a JSON list."""
        return json.dumps([self.at_s, self.node, self.container, self.text])


class PodLogFollower:
    """Follows container logs on the disks of the nodes in a thread.

    Args:
        nodes: Directory of each node.
        containers: Names of the containers.
    """

    def __init__(self, nodes: Mapping[str, Path], containers: Collection[str]) -> None:
        self._nodes = nodes
        self._containers = containers
        self._lines: list[LogLine] = []
        self._open: dict[Path, tuple[BinaryIO, str, str]] = {}
        self._incomplete: dict[Path, bytes] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pod logs", daemon=True)

    def start(self) -> None:
        """Start to follow the logs."""
        self._thread.start()

    def close(self) -> list[LogLine]:
        """Stop, and return all lines ordered by time."""
        self._stop.set()
        self._thread.join()
        self.read_new_lines()
        for file, _, _ in self._open.values():
            file.close()
        return sorted(self._lines, key=lambda line: line.at_s)

    def read_new_lines(self) -> None:
        """Read new lines."""
        for node, directory in self._nodes.items():
            for path in sorted((directory / PODS).glob("*/*/*.log")):
                if path not in self._open and path.parent.name in self._containers:
                    self._open[path] = (path.open("rb"), node, path.parent.name)
        for path, (file, node, container) in self._open.items():
            *lines, incomplete = (self._incomplete.get(path, b"") + file.read()).split(b"\n")
            self._incomplete[path] = incomplete
            self._lines += [line for raw in lines if (line := parse_log_line(raw, node, container)) is not None]

    def _run(self) -> None:
        while not self._stop.wait(POLL_S):
            self.read_new_lines()


def parse_log_line(raw: bytes, node: str, container: str) -> LogLine | None:
    """Parse a log line of the container runtime. Return None for any other line."""
    match = _LINE.fullmatch(raw.decode("utf-8", "replace"))
    if match is None:
        return None
    try:
        at_s = datetime.fromisoformat(match["at"]).timestamp()
    except ValueError:
        return None
    return LogLine(at_s, node, container, match["text"])


VIEWER = "aerial-viewer"
CHECKER = "image-checker"
AGENT = "agent"
CLOUD = "cloud"
LATE_S = 1.0
"""Response time above which a picture is late."""

NOTICE_S = 1.0
"""Maximum time between the loss of a link and the log entry about it."""

_STATE_CHANGE = re.compile(r"links: (?P<phase>none|connecting|up) \(peer=(?P<peer>\S*) reason=(?P<reason>.*)\)")
_MEASURED = re.compile(r"links: measured \(peer=(?P<peer>\S+) mbps=(?P<mbps>[\d.]+)")
_LINK_SELECTED = "the direct link scores"
_LINK_MISSING = "NoDirectLink"
_DECIDED = re.compile(r"links: decided \(on=(?P<on>\S+) peer=(?P<peer>\S+)\): (?P<reason>.*)")


@dataclass(slots=True)
class Picture:
    """Delivery of a picture. Times are Unix seconds.

    Attributes:
        received: Time of the first reception on each node, by node.
        answered_s: Time when the sender received the response. None: no response.
        received_twice: True if one instance received the picture more than once.
        took_s: Time from sending to the response, seconds.
        responder: Node that responded.
    """

    number: int
    sent_s: float
    size: int
    received: dict[str, float] = field(default_factory=dict)
    received_twice: bool = False
    answered_s: float | None = None
    took_s: float = 0.0
    responder: str = ""

    @property
    def received_s(self) -> float | None:
        """Time of the first reception."""
        return min(self.received.values(), default=None)


@dataclass(slots=True)
class LinkUse:
    """Use of a direct link from the decision to its end. Times are Unix seconds, or None if the event never happened.

    Attributes:
        peer: Node.
        reason: Reason of the decision.
        decided_s: Time when the drone's agent decided to connect.
        up_s: Time when pairing was complete.
        measured_s: Time of the first bandwidth measurement.
        mbps: Measured bandwidth.
        spans: Time spans with traffic on the link. The end of a span is None while traffic uses the link.
        first_s: Time when the node received the first picture.
        left: Reason for the end of the link.
        ended_s: Time when the link ended.
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
    def carries_traffic(self) -> bool:
        """True while traffic uses the link."""
        return bool(self.spans) and self.spans[-1][1] is None

    def set_traffic(self, at_s: float, *, direct: bool) -> None:
        """Record that traffic moved to the link or back to the cloud."""
        if direct and not self.carries_traffic:
            self.spans.append((at_s, None))
        elif not direct and self.carries_traffic:
            self.spans[-1] = (self.spans[-1][0], at_s)


@dataclass(frozen=True)
class Evidence:
    """Evidence of one run.

    Attributes:
        pictures: Pictures in sending order.
        link_uses: Uses of direct links in decision order.
        track: Unix seconds, and position in metres east, north and up from the start.
    """

    pictures: tuple[Picture, ...]
    link_uses: tuple[LinkUse, ...]
    track: tuple[tuple[float, LocalPosition], ...]

    @property
    def longest_gap_s(self) -> float:
        """Longest time between two receptions."""
        return max(self.gap_s(abrupt=False), self.gap_s(abrupt=True))

    def gap_s(self, *, abrupt: bool) -> float:
        """Return the longest time between two receptions.

        Args:
            abrupt: Consider only the times at which a link with traffic was lost. False: consider only all other times.
        """
        receptions = sorted(p.received_s for p in self.pictures if p.received_s is not None)
        losses = [s.ended_s for s in self.link_uses if s.lost and s.ended_s is not None]
        gaps = ((b - a, any(a - NOTICE_S <= when <= b for when in losses)) for a, b in itertools.pairwise(receptions))
        return max((gap for gap, at_loss in gaps if at_loss == abrupt), default=0.0)

    def counts(self) -> dict[str, int]:
        """Return the numbers of sent, received, lost, duplicated and late pictures.

        A picture is late if its response takes more than LATE_S.
        """
        received = [p for p in self.pictures if p.received]
        return {
            "sent": len(self.pictures),
            "received": len(received),
            "lost": len(self.pictures) - len(received),
            "doubled": sum(p.received_twice for p in self.pictures),
            "repeated_elsewhere": sum(len(p.received) > 1 for p in self.pictures),
            "late": sum(p.answered_s is None or p.took_s > LATE_S for p in self.pictures),
        }

    def by_node(self) -> dict[str, int]:
        """Return for each node the number of pictures that it received first."""
        first = [min(p.received, key=p.received.__getitem__) for p in self.pictures if p.received]
        return dict(sorted(Counter(first).items()))


def read_evidence(lines: Sequence[LogLine], track: Iterable[tuple[float, LocalPosition]], drone: str) -> Evidence:
    """Read a run from its logs.

    Args:
        lines: Log lines of the pods, ordered by time.
        track: Unix seconds and position of the drone.
        drone: Name of the drone.
    """
    pictures = _read_pictures(lines)
    link_uses = _read_link_uses(line for line in lines if line.container == AGENT and line.node == drone)
    for use in link_uses:
        receptions = (p.received[use.peer] for p in pictures if use.peer in p.received)
        end = use.ended_s or float("inf")
        use.first_s = min((at for at in receptions if use.decided_s <= at <= end), default=None)
    return Evidence(tuple(pictures), tuple(link_uses), tuple(track))


def _read_pictures(lines: Iterable[LogLine]) -> list[Picture]:
    pictures: dict[int, Picture] = {}
    receptions: list[tuple[str, dict[str, Any]]] = []
    for line in lines:
        if line.container not in (VIEWER, CHECKER) or not line.text.startswith("{"):
            continue
        try:
            event = json.loads(line.text)
        except ValueError:
            continue
        kind = event.get("event")
        if kind == "sent":
            pictures[event["picture"]] = Picture(event["picture"], event["at"], event["bytes"])
        elif kind == "answered" and event["picture"] in pictures:
            answered = pictures[event["picture"]]
            answered.answered_s = event["at"]
            answered.took_s = event["took_s"]
            answered.responder = event["by"]
        elif kind == "received":
            receptions.append((line.node, event))
    # The receiver can log a picture before the sender does, so receptions are assigned to pictures last.
    for node, event in receptions:
        received = pictures.get(event["picture"])
        if received is not None:
            received.received_twice |= node in received.received
            received.received.setdefault(node, event["at"])
    return sorted(pictures.values(), key=lambda picture: picture.number)


def _read_link_uses(lines: Iterable[LogLine]) -> list[LinkUse]:
    """Return the uses of direct links from the agent's log, with their decisions, measurements and traffic changes."""
    uses: list[LinkUse] = []
    for line in lines:
        if (state := _STATE_CHANGE.search(line.text)) is not None:
            _apply_state(uses, line.at_s, state)
        elif (measured := _MEASURED.search(line.text)) is not None:
            use = _active_use(uses, measured["peer"])
            if use is not None and use.measured_s is None:
                use.measured_s = line.at_s
                use.mbps = float(measured["mbps"])
        elif (decided := _DECIDED.search(line.text)) is not None:
            _apply_decision(uses, line.at_s, decided)
    return uses


def _active_use(uses: Iterable[LinkUse], peer: str) -> LinkUse | None:
    """Return the use of the active link to a peer."""
    return next((s for s in uses if s.peer == peer and s.ended_s is None), None)


def _apply_state(uses: list[LinkUse], at_s: float, state: re.Match[str]) -> None:
    phase = state["phase"]
    peer = state["peer"]
    use = _active_use(uses, peer)
    if use is None:
        if phase == "connecting":
            uses.append(LinkUse(peer, at_s))
    elif phase == "up":
        use.up_s = at_s
    elif phase == "none":
        use.ended_s = at_s
        use.left = use.left or state["reason"]
        use.lost |= use.carries_traffic and "wanted" not in state["reason"]
        use.set_traffic(at_s, direct=False)


def _apply_decision(uses: list[LinkUse], at_s: float, decided: re.Match[str]) -> None:
    """Record a decision of the agent. It is about the link, or about the traffic of an application (by namespace)."""
    on = decided["on"]
    peer = decided["peer"]
    reason = decided["reason"]
    if on == "link":
        if peer != "-" and _active_use(uses, peer) is None:
            uses.append(LinkUse(peer, at_s, reason))
        return
    direct = _LINK_SELECTED in reason
    for use in uses:
        if use.ended_s is None and use.up_s is not None and (not direct or use.peer == peer):
            # If a link is lost, the agent can log the change of the traffic path before the end of the link.
            use.lost |= use.carries_traffic and reason.startswith(_LINK_MISSING)
            use.set_traffic(at_s, direct=direct)
            use.left = "" if direct else use.left or reason
