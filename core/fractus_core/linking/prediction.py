"""Where the drone will be, and what a direct link will offer there."""

from __future__ import annotations

import math
from dataclasses import replace

from fractus_core.linking.values import PathMetrics, Peer, Position, Reach, Settings, Track


def predict(track: Track, settings: Settings) -> list[Position]:
    """Positions at each step of the horizon, the present one first.

    With waypoints the drone flies from one to the next with its speed and stays at the last (path navigation, thesis
    8.6). Without, it keeps its velocity for as long as that is believed, and then stays (region navigation).
    """
    steps = round(settings.horizon_s / settings.step_s)
    if track.waypoints and track.speed_mps > 0:
        return _along(track, steps, settings.step_s)
    found = []
    for step in range(steps + 1):
        elapsed = min(step * settings.step_s, settings.region_trust_s)
        x, y, z = (p + v * elapsed for p, v in zip(track.position, track.velocity_mps, strict=True))
        found.append((x, y, z))
    return found


def _along(track: Track, steps: int, step_s: float) -> list[Position]:
    at, coming = track.position, list(reversed(track.waypoints))
    found = [at]
    for _ in range(steps):
        left = track.speed_mps * step_s
        while coming and left > 0:
            goal = coming[-1]
            away = math.dist(at, goal)
            if away <= left:
                at, left = goal, left - away
                coming.pop()
            else:
                share = left / away
                x, y, z = (a + (b - a) * share for a, b in zip(at, goal, strict=True))
                at, left = (x, y, z), 0.0
        found.append(at)
    return found


def offered(peer: Peer, reach: Reach, position: Position, settings: Settings) -> PathMetrics | None:
    """What the direct link to a peer is expected to offer from a position; None out of its reach."""
    reach_m = peer.range_m * reach.range_factor
    share = strength(math.dist(position, peer.position) / reach_m, settings.edge) if reach_m > 0 else 0.0
    if share <= 0:
        return None
    factor = share * reach.rate_factor
    return replace(
        peer.offers, ingress_mbps=peer.offers.ingress_mbps * factor, egress_mbps=peer.offers.egress_mbps * factor
    )


def strength(distance: float, edge: float) -> float:
    """Share of its bandwidth that a link offers at a distance, in units of its reach: all inside the edge, none beyond 1."""
    if distance <= edge:
        return 1.0
    return max((1.0 - distance) / (1.0 - edge), 0.0) if edge < 1 else 0.0
