"""A heuristic of a user's own: spend as little on the mobile network as the pictures allow."""

from __future__ import annotations

from fractus_core.linking import PathMetrics

NEEDED_MBPS = 6.0
"""What our pictures take; a path that offers more is no better for it."""

MOBILE_COST_MBPS = 2.0
"""So much bandwidth we give up for not paying the mobile network."""


def least_cost(path: PathMetrics) -> float:
    """How good a path is; higher is better.

    The same numbers always give the same score, and differences add up over time: a path that scores 2 for ten seconds is as
    good as one that scores 4 for five.
    """
    useful = min(path.ingress_mbps, NEEDED_MBPS)
    return useful if path.direct else useful - MOBILE_COST_MBPS
