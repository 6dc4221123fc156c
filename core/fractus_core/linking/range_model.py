"""Range model of direct links: the real range and bandwidth of each peer's link, learned in flight.

The functions update one `LearnedRange`. `RangeModel` applies them to the events of the drone's links: beacons,
links that come up, links that break, failed attempts and measurements.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from fractus_core.linking.prediction import bandwidth_share, expected_metrics
from fractus_core.linking.values import LearnedRange, LinkSettings, LocalPosition, PathMetrics, Peer

MIN_FACTOR = 0.2
MAX_FACTOR = 2.0
RATE_SMOOTHING = 0.3
"""Weight of a new bandwidth measurement."""
RANGE_MARGIN = 1.02
"""A link that works at a distance is also expected to work at the distance multiplied by this factor."""
RECOVERY_SHARE = 0.98
"""If a beacon is received at this share of the distance at which a link broke, or farther, the range did not cause the break."""

FIRST_RETRY_S = 1.0
MAX_RETRY_S = 60.0
"""Shortest and longest delay before another attempt to connect to a peer. The delay doubles with each failure."""
MAX_IDLE_RETRY_S = 4.0
"""Longest delay while the drone has no link. An attempt interrupts no traffic in this state."""


def with_contact(learned: LearnedRange, distance: float, now_s: float) -> LearnedRange:
    """Record a beacon or carried traffic at a distance, in units of the declared range."""
    factor = max(learned.range_factor, min(distance * RANGE_MARGIN, MAX_FACTOR))
    return replace(learned, range_factor=factor, last_beacon_s=now_s)


def with_loss(learned: LearnedRange, distance: float) -> LearnedRange:
    """Record that the link broke at a distance, in units of the declared range: the range ends at this distance."""
    return replace(learned, range_factor=max(min(learned.range_factor, distance / RANGE_MARGIN), MIN_FACTOR))


def with_connection(learned: LearnedRange) -> LearnedRange:
    """Record that the link came up."""
    return replace(learned, failures=0)


def with_failure(learned: LearnedRange, now_s: float) -> LearnedRange:
    """Record a failed attempt to connect to a peer that should be in range."""
    return replace(learned, failures=learned.failures + 1, last_failure_s=now_s)


def with_rate(learned: LearnedRange, rate: float) -> LearnedRange:
    """Record the share of the declared bandwidth that the link delivered well inside its range."""
    rate = min(max(rate, 0.0), MAX_FACTOR)
    return replace(learned, rate_factor=learned.rate_factor + RATE_SMOOTHING * (rate - learned.rate_factor))


def next_attempt_s(learned: LearnedRange, *, linked: bool) -> float:
    """Return the earliest time of the next attempt to connect, negative infinity if no attempt has failed.

    Args:
        learned: Experience with the peer.
        linked: True if a link to another peer is up or coming up. The attempt would end that link.
    """
    if not learned.failures:
        return float("-inf")
    wait_s = FIRST_RETRY_S * 2.0 ** min(learned.failures - 1, 16)
    return learned.last_failure_s + min(wait_s, MAX_RETRY_S if linked else MAX_IDLE_RETRY_S)


def expected_range(ranges: Mapping[str, LearnedRange], peer: str) -> LearnedRange:
    """Return the experience with a peer's link, or the median range factor of all peers for an unknown peer.

    The declared ranges of similar radios in one place have similar errors.
    """
    learned = ranges.get(peer, LearnedRange())
    if learned.last_beacon_s > float("-inf") or learned.range_factor != 1.0:
        return learned
    factors = [other.range_factor for other in ranges.values() if other.range_factor != 1.0]
    return replace(learned, range_factor=statistics.median(factors)) if factors else learned


@dataclass(slots=True)
class RangeModel:
    """Learned ranges of all peers, together with the positions of the drone and its peers.

    Attributes:
        settings: Link settings, of which `edge` is used.
        ranges: Learned range by peer.
        position: Position of the drone, None if unknown.
        peers: Peers by name.
    """

    settings: LinkSettings
    ranges: dict[str, LearnedRange] = field(default_factory=dict)
    position: LocalPosition | None = None
    peers: Mapping[str, Peer] = field(default_factory=dict)
    _before_loss: dict[str, tuple[float, float]] = field(default_factory=dict)

    def retain(self, names: Collection[str]) -> None:
        """Forget all peers except the named peers."""
        for by_name in (self.ranges, self._before_loss):
            for name in by_name.keys() - set(names):
                del by_name[name]

    def on_beacon(self, name: str, now_s: float) -> None:
        """Record a beacon. Restore the learned range if the peer is now at least as far away as when its link broke.

        Anyone can send a beacon, so a beacon restores at most the declared range.
        """
        distance = self._distance(name) or 0.0
        before = self._before_loss.get(name)
        if before is not None and distance >= before[0]:
            del self._before_loss[name]
            factor = max(self._learned(name).range_factor, min(before[1], 1.0))
            self.ranges[name] = replace(self._learned(name), range_factor=factor)
        self.ranges[name] = replace(self._learned(name), last_beacon_s=now_s)

    def on_link_up(self, name: str, now_s: float) -> None:
        """Record that the link to a peer came up."""
        self.ranges[name] = with_contact(with_connection(self._learned(name)), self._distance(name) or 0.0, now_s)

    def on_pairing_failed(self, name: str, now_s: float) -> None:
        """Record a failed pairing attempt."""
        self.ranges[name] = with_failure(self._learned(name), now_s)

    def on_link_lost(self, name: str, now_s: float) -> None:
        """Record that the link to a peer broke. A loss well inside the range does not shorten the range."""
        distance = self._distance(name)
        factor = self._learned(name).range_factor
        self.ranges[name] = with_failure(self._learned(name), now_s)
        if distance is not None and distance / factor >= self.settings.edge / 2:
            self.ranges[name] = with_loss(self._learned(name), distance)
            self._before_loss[name] = (distance * RECOVERY_SHARE, factor)

    def on_measurement(self, name: str, metrics: PathMetrics) -> None:
        """Record a measurement of the link to a peer."""
        distance = self._distance(name)
        peer = self.peers.get(name)
        if distance is None or peer is None or peer.offers.ingress_mbps <= 0:
            return
        if distance > 1:
            self.ranges[name] = with_contact(self._learned(name), distance, self._learned(name).last_beacon_s)
        share = bandwidth_share(distance / self._learned(name).range_factor, self.settings.edge)
        if share >= 1:
            self.ranges[name] = with_rate(self._learned(name), metrics.ingress_mbps / peer.offers.ingress_mbps)

    def expected_metrics(self) -> dict[Peer, PathMetrics | None]:
        """Return the expected performance of the links to all peers from the current position, None out of range."""
        if self.position is None:
            return {}
        return {
            peer: expected_metrics(peer, expected_range(self.ranges, peer.name), self.position, self.settings)
            for peer in self.peers.values()
        }

    def _learned(self, name: str) -> LearnedRange:
        return self.ranges.get(name, LearnedRange())

    def _distance(self, name: str) -> float | None:
        """Return the distance of a peer in units of its declared range, None if a position is unknown."""
        peer = self.peers.get(name)
        if self.position is None or peer is None:
            return None
        return math.dist(self.position, peer.position) / peer.range_m
