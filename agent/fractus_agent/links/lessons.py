"""What the drone's end learns of its peers' links while it flies: from beacons, from links that came up, and from those lost."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from fractus_core.linking import PathMetrics, Peer, Position, Reach, Settings
from fractus_core.linking.learning import connected, expected, failed, heard, lost, measured
from fractus_core.linking.prediction import offered, strength

HEARD_AGAIN = 0.98
"""From this share of the distance at which a link broke, a beacon shows that it broke for another reason."""


@dataclass(slots=True)
class Lessons:
    """The reaches of peers as they were learned, with where the drone and the peers are.

    Attributes:
        reaches: by peer.
        here: the drone; None while that is not known.
        peers: by name.
    """

    settings: Settings
    reaches: dict[str, Reach] = field(default_factory=dict)
    here: Position | None = None
    peers: Mapping[str, Peer] = field(default_factory=dict)
    _before_loss: dict[str, tuple[float, float]] = field(default_factory=dict)

    def keep(self, names: Collection[str]) -> None:
        """Forget all peers but these."""
        for learned in (self.reaches, self._before_loss):
            for name in learned.keys() - set(names):
                del learned[name]

    def beacon(self, name: str, now_s: float) -> None:
        """A peer was heard; where its link broke no nearer than here, that was not for the distance.

        Anyone can send a beacon: it gives back what a peer declares, and no more than that.
        """
        distance = self._distance(name) or 0.0
        before = self._before_loss.get(name)
        if before is not None and distance >= before[0]:
            del self._before_loss[name]
            factor = max(self._own(name).range_factor, min(before[1], 1.0))
            self.reaches[name] = replace(self._own(name), range_factor=factor)
        self.reaches[name] = replace(self._own(name), heard_s=now_s)

    def came_up(self, name: str, now_s: float) -> None:
        """The link to a peer came up."""
        self.reaches[name] = heard(connected(self._own(name)), self._distance(name) or 0.0, now_s)

    def not_paired(self, name: str, now_s: float) -> None:
        """An attempt to pair failed."""
        self.reaches[name] = failed(self._own(name), now_s)

    def broke(self, name: str, now_s: float) -> None:
        """The link to a peer broke; one that broke well inside its reach is no sign of how far it reaches."""
        distance, factor = self._distance(name), self._own(name).range_factor
        self.reaches[name] = failed(self._own(name), now_s)
        if distance is not None and distance / factor >= self.settings.edge / 2:
            self.reaches[name] = lost(self._own(name), distance)
            self._before_loss[name] = (distance * HEARD_AGAIN, factor)

    def delivered(self, name: str, path: PathMetrics) -> None:
        """The link to a peer was measured."""
        distance, peer = self._distance(name), self.peers.get(name)
        if distance is None or peer is None or peer.offers.ingress_mbps <= 0:
            return
        if distance > 1:
            self.reaches[name] = heard(self._own(name), distance, self._own(name).heard_s)
        share = strength(distance / self._own(name).range_factor, self.settings.edge)
        if share >= 1:
            self.reaches[name] = measured(self._own(name), path.ingress_mbps / peer.offers.ingress_mbps)

    def offers(self) -> dict[Peer, PathMetrics | None]:
        """What the links to all peers are expected to offer from here; None out of reach."""
        if self.here is None:
            return {}
        return {
            peer: offered(peer, expected(self.reaches, peer.name), self.here, self.settings)
            for peer in self.peers.values()
        }

    def _own(self, name: str) -> Reach:
        return self.reaches.get(name, Reach())

    def _distance(self, name: str) -> float | None:
        """How far a peer is, in units of its declared reach."""
        peer = self.peers.get(name)
        return (
            math.dist(self.here, peer.position) / peer.range_m if self.here is not None and peer is not None else None
        )
