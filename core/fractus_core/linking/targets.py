"""Which path the traffic of a hybrid component takes now: the direct link, or the cloud path."""

from __future__ import annotations

import math

from fractus_core.linking.heuristics import TargetHeuristic
from fractus_core.linking.prediction import predict
from fractus_core.linking.values import Link, PathMetrics, Peer, Phase, Reach, Settings, TargetDecision, Track


def choose_target(
    heuristic: TargetHeuristic,
    cloud: PathMetrics | None,
    direct: PathMetrics | None,
    *,
    is_direct: bool,
    leaving: bool,
    settings: Settings,
) -> TargetDecision:
    """Choose the path with the better score.

    Args:
        heuristic: what makes a path good.
        cloud: what the cloud path offers; None while it does not answer.
        direct: what was measured of the direct link; None while there is none, or it has not been measured.
        is_direct: whether traffic takes the direct link now.
        leaving: whether the drone is about to leave the reach of the link, or to connect to another peer.
        settings: hysteresis.
    """
    if direct is None:
        return TargetDecision(False, is_direct, False, "NoDirectLink", "there is no direct link")
    if cloud is None:
        # A link that is about to be left carries what it can until it is gone, and takes nothing more.
        takes = is_direct or not leaving
        return TargetDecision(takes, takes != is_direct, True, "CloudSilent", "the cloud path does not answer")
    if leaving:
        return TargetDecision(False, is_direct, True, "LeavingLink", "the direct link is about to be left")
    ours, theirs = (direct, cloud) if is_direct else (cloud, direct)
    present, other = heuristic(ours), heuristic(theirs)
    if other > present + settings.hysteresis * max(abs(present), abs(other)):
        path = "cloud path" if is_direct else "direct link"
        reason = f"the {path} scores {other:g}, the present path {present:g}"
        return TargetDecision(not is_direct, True, True, "BetterPath", reason)
    return TargetDecision(is_direct, False, True, "Keep", f"the present path scores {present:g}, the other {other:g}")


def leaves_reach(track: Track, peer: Peer, reach: Reach, link: Link, settings: Settings) -> bool:
    """Whether the link's reach ends before connections on it could finish, so that traffic must leave it now."""
    if link.phase is not Phase.UP or link.peer != peer.name:
        return False
    steps = math.ceil(settings.drain_s / settings.step_s)
    limit = peer.range_m * reach.range_factor
    return any(math.dist(at, peer.position) > limit for at in predict(track, settings)[: steps + 1])
