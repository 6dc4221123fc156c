"""Gain of link selection rules on a flight: the planner of Fractus, the thesis' rule, and an oracle."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fractus_core.linking import (
    NO_LINK,
    LearnedRange,
    LinkPhase,
    LinkSettings,
    LinkState,
    LocalPosition,
    PathMetrics,
    Peer,
    Track,
    find_heuristic,
    plan_link,
)
from fractus_core.linking.range_model import with_contact, with_failure, with_loss

STEP_S = 0.1
LINK_UP_STEPS = 9
"""0.92 s until a link is up and measured."""
DECIDE_STEPS = 5
BEACON_STEPS = 10
AHEAD_M = 20.0
INGRESS = find_heuristic("max", "ingress-bandwidth")
SETTINGS = LinkSettings()


@dataclass(frozen=True, slots=True)
class Scene:
    """A flight with peers, and the actual bandwidth of all paths.

    Attributes:
        positions: Positions of the drone, one every `STEP_S`.
        waypoints: Remaining waypoints at each step.
        speed: Speed along the waypoints, m/s.
        peers: Peers with their declared range.
        cloud: Cloud path.
        factor: Actual range divided by declared range.
        direct_mbps: Actual bandwidth of a direct link in range.
    """

    positions: Sequence[LocalPosition]
    waypoints: Sequence[tuple[LocalPosition, ...]]
    speed: float
    peers: Sequence[Peer]
    cloud: PathMetrics
    factor: float = 1.0
    direct_mbps: float = 14.7

    def rate(self, step: int, node: Peer) -> float:
        """Return the actual bandwidth of the link to a peer at a step, in Mbit/s."""
        inside = math.dist(self.positions[step], node.position) <= node.range_m * self.factor
        return self.direct_mbps if inside else 0.0

    @property
    def gain_mbps(self) -> float:
        """Return the gain of a direct link over the cloud path."""
        return self.direct_mbps - self.cloud.ingress_mbps


def along(path: Sequence[LocalPosition], speed: float) -> tuple[list[LocalPosition], list[tuple[LocalPosition, ...]]]:
    """Return positions and remaining waypoints, one every `STEP_S`, for a constant speed along a path."""
    at = path[0]
    coming = list(path[1:])
    positions = []
    waypoints = []
    while coming:
        positions.append(at)
        waypoints.append(tuple(coming))
        left = speed * STEP_S
        while coming and left > 0:
            away = math.dist(at, coming[0])
            if away <= left:
                at = coming.pop(0)
                left = left - away
            else:
                x, y, z = (a + (b - a) * left / away for a, b in zip(at, coming[0], strict=True))
                at = (x, y, z)
                left = 0.0
    return positions, waypoints


def oracle(scene: Scene) -> float:
    """Return the maximum gain in Mbit over the cloud path for any sequence of links, with the whole flight known."""
    n = len(scene.positions)
    up = {node.name: [scene.rate(i, node) > 0 for i in range(n)] for node in scene.peers}
    value = {"": [0.0] * (n + 1), **{name: [0.0] * (n + 1) for name in up}}
    for i in range(n - 1, -1, -1):
        j = min(i + LINK_UP_STEPS, n)
        new = max((value[name][j] for name in up if all(up[name][i:j])), default=0.0)
        value[""][i] = max(value[""][i + 1], new)
        for name, rows in up.items():
            stay = scene.gain_mbps * STEP_S + value[name][i + 1] if rows[i] else 0.0
            value[name][i] = max(stay, value[""][i])
    return value[""][0]


Rule = Callable[[Scene, int, LinkState, dict[str, LearnedRange]], str]


def ours(scene: Scene, step: int, link: LinkState, ranges: dict[str, LearnedRange]) -> str:
    """Select the peer of the receding-horizon plan."""
    track = Track(scene.positions[step], scene.speed, scene.waypoints[step])
    return plan_link(
        track, scene.peers, scene.cloud, link, step * STEP_S, heuristic=INGRESS, settings=SETTINGS, ranges=ranges
    ).peer


def thesis(scene: Scene, step: int, _link: LinkState, _reaches: dict[str, LearnedRange]) -> str:
    """Select the nearest peer in declared range in the direction of the next waypoint (thesis 8.6)."""
    at = scene.positions[step]
    goal = scene.waypoints[step][0]
    share = min(AHEAD_M / max(math.dist(at, goal), 1e-9), 1.0)
    ahead = tuple(a + (b - a) * share for a, b in zip(at, goal, strict=True))
    near = [node for node in scene.peers if math.dist(at, node.position) <= node.range_m]
    return min(near, key=lambda node: math.dist(ahead, node.position)).name if near else ""


def carried(scene: Scene, rule: Rule) -> tuple[float, int]:
    """Return the gain in Mbit of a rule that decides twice a second, and its number of links."""
    link = NO_LINK
    gain = 0.0
    links = 0
    coming = 0
    ranges: dict[str, LearnedRange] = {}
    nodes = {node.name: node for node in scene.peers}
    for step in range(len(scene.positions)):
        now_s = step * STEP_S
        node = nodes.get(link.peer)
        if node is not None and not scene.rate(step, node):
            _learn_loss(scene, step, node, link, ranges)
            link = NO_LINK
        elif link.phase is LinkPhase.CONNECTING:
            coming -= 1
            if coming <= 0:
                link = LinkState(LinkPhase.UP, link.peer, now_s)
        elif node is not None:
            gain += scene.gain_mbps * STEP_S
        if step % BEACON_STEPS == 0:
            _hear(scene, step, ranges)
        if step % DECIDE_STEPS == 0:
            wanted = rule(scene, step, link, ranges)
            if wanted != link.peer:
                link = LinkState(LinkPhase.CONNECTING, wanted, now_s) if wanted else NO_LINK
                coming = LINK_UP_STEPS
                links = links + bool(wanted)
    return gain, links


def _learn_loss(scene: Scene, step: int, node: Peer, link: LinkState, ranges: dict[str, LearnedRange]) -> None:
    known = ranges.get(node.name, LearnedRange())
    if link.phase is LinkPhase.UP:
        ranges[node.name] = with_loss(known, math.dist(scene.positions[step], node.position) / node.range_m)
    else:
        ranges[node.name] = with_failure(known, step * STEP_S)


def _hear(scene: Scene, step: int, ranges: dict[str, LearnedRange]) -> None:
    """Interval of peer discovery. A radio receives the beacons of its neighbours about once a second."""
    for other in scene.peers:
        if scene.rate(step, other):
            distance = math.dist(scene.positions[step], other.position) / other.range_m
            ranges[other.name] = with_contact(ranges.get(other.name, LearnedRange()), distance, step * STEP_S)
