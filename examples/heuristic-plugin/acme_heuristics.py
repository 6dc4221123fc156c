"""User-defined heuristic: use the mobile network only if the direct link is too slow for the pictures."""

from __future__ import annotations

from fractus_core.linking import PathMetrics

NEEDED_MBPS = 6.0
"""Bandwidth of the pictures. More bandwidth does not improve a path."""

MOBILE_COST_MBPS = 2.0
"""Bandwidth that is worth giving up to avoid the cost of the mobile network."""


def least_cost(path: PathMetrics) -> float:
    """Return the score of a path. Higher is better.

    Scores add up over time: a score of 2 for ten seconds is as good as a score of 4 for five seconds.
    """
    useful = min(path.ingress_mbps, NEEDED_MBPS)
    return useful if path.direct else useful - MOBILE_COST_MBPS
