"""What measurements teach about a link: how far it really reaches, and how much of what it offers it delivers."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import replace

from fractus_core.linking.values import Reach

MIN_FACTOR, MAX_FACTOR = 0.2, 2.0
SMOOTHING = 0.3
"""Weight of a new measurement of the rate."""
MARGIN = 1.02
"""A link that is heard from somewhere is expected to be heard a little further, too."""


FIRST_RETRY_S, MAX_RETRY_S = 1.0, 60.0
"""A peer that does not answer is tried again after this long, doubled for each failure, and at most this long."""
MAX_IDLE_RETRY_S = 4.0
"""At most this long without a link: an attempt costs nothing then, and what kept the peer from answering may be gone."""


def heard(reach: Reach, distance: float, now_s: float) -> Reach:
    """The peer was heard, or its link carried traffic, at a distance in units of its declared reach."""
    factor = max(reach.range_factor, min(distance * MARGIN, MAX_FACTOR))
    return replace(reach, range_factor=factor, heard_s=now_s)


def lost(reach: Reach, distance: float) -> Reach:
    """The link broke at a distance in units of its declared reach: it reaches no further."""
    return replace(reach, range_factor=max(min(reach.range_factor, distance / MARGIN), MIN_FACTOR))


def connected(reach: Reach) -> Reach:
    """The link came up."""
    return replace(reach, failures=0)


def failed(reach: Reach, now_s: float) -> Reach:
    """An attempt to connect failed, though the peer should be in reach."""
    return replace(reach, failures=reach.failures + 1, failed_s=now_s)


def retry_s(reach: Reach, *, linked: bool) -> float:
    """When the next attempt to connect may be made.

    Args:
        reach: of the peer.
        linked: whether there is a link to another peer, or one comes up, which the attempt would end.
    """
    if not reach.failures:
        return float("-inf")
    wait_s = FIRST_RETRY_S * 2.0 ** min(reach.failures - 1, 16)
    return reach.failed_s + min(wait_s, MAX_RETRY_S if linked else MAX_IDLE_RETRY_S)


def measured(reach: Reach, rate: float) -> Reach:
    """The link delivered this share of what it offers, well inside its reach."""
    rate = min(max(rate, 0.0), MAX_FACTOR)
    return replace(reach, rate_factor=reach.rate_factor + SMOOTHING * (rate - reach.rate_factor))


def expected(reaches: Mapping[str, Reach], peer: str) -> Reach:
    """What is known of a peer's link; of one never heard, what the others of the fleet's radios teach on average.

    Radios of one kind in one place err alike: a reach that was declared too long is too long for all of them.
    """
    own = reaches.get(peer, Reach())
    if own.heard_s > float("-inf") or own.range_factor != 1.0:
        return own
    others = [reach.range_factor for reach in reaches.values() if reach.range_factor != 1.0]
    return replace(own, range_factor=statistics.median(others)) if others else own
