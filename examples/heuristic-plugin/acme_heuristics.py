"""User-defined heuristic: use the mobile network only if the direct link is too slow for the pictures."""

from __future__ import annotations

from fractus_core.linking import PathMetrics

REQUIRED_MBPS = 6.0
"""Bandwidth that the pictures need. More bandwidth does not improve a path."""

MOBILE_COST_MBPS = 2.0
"""Cost of the mobile network, expressed as bandwidth: a direct link is preferred if it is slower by less than this."""


def least_cost(path: PathMetrics) -> float:
    """Return the score of a path. Higher is better.

    The agent compares sums of scores over time: a score of 2 for ten seconds is as good as a score of 4 for five seconds.
    """
    useful = min(path.ingress_mbps, REQUIRED_MBPS)
    return useful if path.direct else useful - MOBILE_COST_MBPS
