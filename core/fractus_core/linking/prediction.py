"""Predicted positions of the drone, and the expected performance of a direct link at a position."""

from __future__ import annotations

import math
from dataclasses import replace

from fractus_core.linking.values import LearnedRange, LinkSettings, LocalPosition, PathMetrics, Peer, Track


def predict(track: Track, settings: LinkSettings) -> list[LocalPosition]:
    """Return the positions at each step of the horizon, starting with the current one.

    With waypoints, the drone flies from waypoint to waypoint with its speed, and stays at the last waypoint (path navigation,
    thesis 8.6). Without waypoints, it keeps its velocity for `region_trust_s` and then stays (region navigation).
    """
    steps = round(settings.horizon_s / settings.step_s)
    if track.waypoints and track.speed_mps > 0:
        return _predict_along_waypoints(track, steps, settings.step_s)
    positions = []
    for step in range(steps + 1):
        elapsed_s = min(step * settings.step_s, settings.region_trust_s)
        x, y, z = (p + v * elapsed_s for p, v in zip(track.position, track.velocity_mps, strict=True))
        positions.append((x, y, z))
    return positions


def _predict_along_waypoints(track: Track, steps: int, step_s: float) -> list[LocalPosition]:
    position = track.position
    remaining = list(reversed(track.waypoints))
    positions = [position]
    for _ in range(steps):
        left_m = track.speed_mps * step_s
        while remaining and left_m > 0:
            waypoint = remaining[-1]
            distance_m = math.dist(position, waypoint)
            if distance_m <= left_m:
                position = waypoint
                left_m -= distance_m
                remaining.pop()
            else:
                share = left_m / distance_m
                x, y, z = (a + (b - a) * share for a, b in zip(position, waypoint, strict=True))
                position = (x, y, z)
                left_m = 0.0
        positions.append(position)
    return positions


def expected_metrics(
    peer: Peer, learned: LearnedRange, position: LocalPosition, settings: LinkSettings
) -> PathMetrics | None:
    """Return the expected performance of the direct link to a peer, None outside its range.

    Args:
        peer: The peer.
        learned: Experience with the peer's link.
        position: Position of the drone.
        settings: Link settings, of which `edge` is used.
    """
    range_m = peer.range_m * learned.range_factor
    share = bandwidth_share(math.dist(position, peer.position) / range_m, settings.edge) if range_m > 0 else 0.0
    if share <= 0:
        return None
    factor = share * learned.rate_factor
    return replace(
        peer.offers, ingress_mbps=peer.offers.ingress_mbps * factor, egress_mbps=peer.offers.egress_mbps * factor
    )


def bandwidth_share(distance: float, edge: float) -> float:
    """Return the share of its bandwidth that a link offers: 1 inside the edge, 0 beyond its range.

    Args:
        distance: Distance in units of the link's range.
        edge: Distance at which the bandwidth begins to fade, in the same unit.
    """
    if distance <= edge:
        return 1.0
    return max((1.0 - distance) / (1.0 - edge), 0.0) if edge < 1 else 0.0
