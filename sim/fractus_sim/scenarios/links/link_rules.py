"""Gain of link selection rules on a flight: the planner of Fractus, the rule of the thesis, and the maximum possible gain."""

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
"""Steps from a decision until the link is up and its bandwidth is measured (0.92 s)."""

DECIDE_STEPS = 5
BEACON_STEPS = 10
"""Interval of beacons, about one second."""

AHEAD_M = 20.0
"""Look-ahead distance of the rule of the thesis: it selects the peer nearest to a point this far ahead of the drone."""

INGRESS = find_heuristic("max", "ingress-bandwidth")
SETTINGS = LinkSettings()


@dataclass(frozen=True, slots=True)
class RecordedFlight:
    """A flight with peers, and the actual bandwidth of all paths.

    Attributes:
        positions: Positions of the drone at intervals of `STEP_S`.
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
        """Return the actual bandwidth of a link to a peer at a step, in Mbit/s."""
        inside = math.dist(self.positions[step], node.position) <= node.range_m * self.factor
        return self.direct_mbps if inside else 0.0

    @property
    def gain_mbps(self) -> float:
        """Gain of a direct link over the cloud path, Mbit/s."""
        return self.direct_mbps - self.cloud.ingress_mbps


def constant_speed_flight(
    path: Sequence[LocalPosition], speed: float
) -> tuple[list[LocalPosition], list[tuple[LocalPosition, ...]]]:
    """Simulate a flight along a path at constant speed. Return position and remaining waypoints for each `STEP_S`."""
    position = path[0]
    remaining = list(path[1:])
    positions = []
    waypoints = []
    while remaining:
        positions.append(position)
        waypoints.append(tuple(remaining))
        step_m = speed * STEP_S
        while remaining and step_m > 0:
            distance_m = math.dist(position, remaining[0])
            if distance_m <= step_m:
                position = remaining.pop(0)
                step_m -= distance_m
            else:
                share = step_m / distance_m
                x, y, z = (a + (b - a) * share for a, b in zip(position, remaining[0], strict=True))
                position = (x, y, z)
                step_m = 0.0
    return positions, waypoints


def best_gain(flight: RecordedFlight) -> float:
    """Return the gain in Mbit over the cloud path of the best sequence of links.

    It is found with the whole flight known.
    """
    n = len(flight.positions)
    up = {node.name: [flight.rate(i, node) > 0 for i in range(n)] for node in flight.peers}
    value = {"": [0.0] * (n + 1), **{name: [0.0] * (n + 1) for name in up}}
    for i in range(n - 1, -1, -1):
        j = min(i + LINK_UP_STEPS, n)
        new = max((value[name][j] for name in up if all(up[name][i:j])), default=0.0)
        value[""][i] = max(value[""][i + 1], new)
        for name, rows in up.items():
            stay = flight.gain_mbps * STEP_S + value[name][i + 1] if rows[i] else 0.0
            value[name][i] = max(stay, value[""][i])
    return value[""][0]


Rule = Callable[[RecordedFlight, int, LinkState, dict[str, LearnedRange]], str]


def planner_rule(flight: RecordedFlight, step: int, link: LinkState, ranges: dict[str, LearnedRange]) -> str:
    """Select the peer that the planner of Fractus (receding horizon) selects."""
    track = Track(flight.positions[step], flight.speed, flight.waypoints[step])
    return plan_link(
        track, flight.peers, flight.cloud, link, step * STEP_S, heuristic=INGRESS, settings=SETTINGS, ranges=ranges
    ).peer


def thesis_rule(flight: RecordedFlight, step: int, _link: LinkState, _ranges: dict[str, LearnedRange]) -> str:
    """Select the peer in declared range that is nearest to a point ahead of the drone (thesis 8.6)."""
    position = flight.positions[step]
    waypoint = flight.waypoints[step][0]
    share = min(AHEAD_M / max(math.dist(position, waypoint), 1e-9), 1.0)
    ahead = tuple(a + (b - a) * share for a, b in zip(position, waypoint, strict=True))
    near = [node for node in flight.peers if math.dist(position, node.position) <= node.range_m]
    return min(near, key=lambda node: math.dist(ahead, node.position)).name if near else ""


def gain_of_rule(flight: RecordedFlight, rule: Rule) -> tuple[float, int]:
    """Simulate a rule that decides twice a second.

    Return its gain over the cloud path in Mbit, and its number of links.
    """
    link = NO_LINK
    gain = 0.0
    links = 0
    steps_until_up = 0
    ranges: dict[str, LearnedRange] = {}
    nodes = {node.name: node for node in flight.peers}
    for step in range(len(flight.positions)):
        now_s = step * STEP_S
        node = nodes.get(link.peer)
        if node is not None and not flight.rate(step, node):
            _learn_loss(flight, step, node, link, ranges)
            link = NO_LINK
        elif link.phase is LinkPhase.CONNECTING:
            steps_until_up -= 1
            if steps_until_up <= 0:
                link = LinkState(LinkPhase.UP, link.peer, now_s)
        elif node is not None:
            gain += flight.gain_mbps * STEP_S
        if step % BEACON_STEPS == 0:
            _learn_beacons(flight, step, ranges)
        if step % DECIDE_STEPS == 0:
            selected = rule(flight, step, link, ranges)
            if selected != link.peer:
                link = LinkState(LinkPhase.CONNECTING, selected, now_s) if selected else NO_LINK
                steps_until_up = LINK_UP_STEPS
                links += bool(selected)
    return gain, links


def _learn_loss(
    flight: RecordedFlight, step: int, node: Peer, link: LinkState, ranges: dict[str, LearnedRange]
) -> None:
    """Reduce the learned range of a peer after the loss of a link, or record a failed attempt to connect."""
    known = ranges.get(node.name, LearnedRange())
    if link.phase is LinkPhase.UP:
        ranges[node.name] = with_loss(known, math.dist(flight.positions[step], node.position) / node.range_m)
    else:
        ranges[node.name] = with_failure(known, step * STEP_S)


def _learn_beacons(flight: RecordedFlight, step: int, ranges: dict[str, LearnedRange]) -> None:
    """Extend the learned ranges of the peers whose beacons the drone receives at a step."""
    for other in flight.peers:
        if flight.rate(step, other):
            distance = math.dist(flight.positions[step], other.position) / other.range_m
            ranges[other.name] = with_contact(ranges.get(other.name, LearnedRange()), distance, step * STEP_S)
