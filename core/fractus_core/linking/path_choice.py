"""Choice of the path for a hybrid component's traffic: the direct link or the cloud path."""

from __future__ import annotations

import math

from fractus_core.linking.heuristics import PathHeuristic
from fractus_core.linking.prediction import predict
from fractus_core.linking.values import (
    LearnedRange,
    LinkPhase,
    LinkSettings,
    LinkState,
    PathDecision,
    PathMetrics,
    Peer,
    Track,
)


def choose_path(
    heuristic: PathHeuristic,
    cloud: PathMetrics | None,
    direct: PathMetrics | None,
    *,
    is_direct: bool,
    leaving: bool,
    settings: LinkSettings,
) -> PathDecision:
    """Choose the path with the better score.

    Args:
        heuristic: Scores a path.
        cloud: Performance of the cloud path, None while it does not respond.
        direct: Measured performance of the direct link, None without a link or before its first measurement.
        is_direct: True if traffic takes the direct link now.
        leaving: True if the drone is about to leave the link's range, or to connect to another peer.
        settings: Link settings, of which `hysteresis` is used.
    """
    if direct is None:
        return PathDecision(False, is_direct, False, "NoDirectLink", "there is no direct link")
    if cloud is None:
        # A link that the drone is about to leave keeps its traffic while it works, but no more traffic moves to it.
        takes = is_direct or not leaving
        return PathDecision(takes, takes != is_direct, True, "CloudSilent", "the cloud path does not respond")
    if leaving:
        return PathDecision(False, is_direct, True, "LeavingLink", "the drone is about to leave the direct link")
    current = heuristic(direct if is_direct else cloud)
    other = heuristic(cloud if is_direct else direct)
    if other > current + settings.hysteresis * max(abs(current), abs(other)):
        path = "cloud path" if is_direct else "direct link"
        reason = f"the {path} scores {other:g}, the current path {current:g}"
        return PathDecision(not is_direct, True, True, "BetterPath", reason)
    return PathDecision(is_direct, False, True, "Keep", f"the current path scores {current:g}, the other {other:g}")


def leaves_range(track: Track, peer: Peer, learned: LearnedRange, link: LinkState, settings: LinkSettings) -> bool:
    """Return True if the drone leaves the link's range within `drain_s`, so that traffic must leave the link now."""
    if link.phase is not LinkPhase.UP or link.peer != peer.name:
        return False
    steps = math.ceil(settings.drain_s / settings.step_s)
    range_m = peer.range_m * learned.range_factor
    positions = predict(track, settings)[: steps + 1]
    return any(math.dist(position, peer.position) > range_m for position in positions)
