"""Heuristics: what makes one network path better than another for an application (thesis 8.6).

A heuristic is a function from what a path offers to a score; higher is better, and differences of scores add up over
time. A package adds its own as an entry point of the group `fractus.linking`, whose name an Application's
`heuristic.kind` then gives.
"""

from __future__ import annotations

import importlib.metadata
from typing import Protocol

from fractus_core.linking.values import PathMetrics

GROUP = "fractus.linking"

DIRECT_BONUS = 1e3
"""With `preferDirect` a direct link beats any bandwidth; among direct links the faster one wins."""


class TargetHeuristic(Protocol):
    """Scores a path."""

    def __call__(self, path: PathMetrics) -> float:
        """How good a path is; higher is better, and finite."""


def max_ingress_bandwidth(path: PathMetrics) -> float:
    """Mbit/s towards the component that provides the service."""
    return path.ingress_mbps


def max_egress_bandwidth(path: PathMetrics) -> float:
    """Mbit/s from the component that provides the service."""
    return path.egress_mbps


def min_ingress_latency(path: PathMetrics) -> float:
    """The less time towards the component that provides the service, the better."""
    return -path.ingress_latency_ms


def min_egress_latency(path: PathMetrics) -> float:
    """The less time from the component that provides the service, the better."""
    return -path.egress_latency_ms


def prefer_direct(path: PathMetrics) -> float:
    """Direct links save the cost of the mobile network, so that they are used wherever there are some."""
    return (DIRECT_BONUS if path.direct else 0.0) + min(path.ingress_mbps, path.egress_mbps)


_BUILT_IN: dict[tuple[str, str | None], TargetHeuristic] = {
    ("max", "ingress-bandwidth"): max_ingress_bandwidth,
    ("max", "egress-bandwidth"): max_egress_bandwidth,
    ("min", "ingress-latency"): min_ingress_latency,
    ("min", "egress-latency"): min_egress_latency,
    ("preferDirect", None): prefer_direct,
}


class UnknownHeuristic(ValueError):
    """No heuristic has this name."""


def heuristic(kind: str, metric: str | None = None) -> TargetHeuristic:
    """The heuristic that an Application names.

    Args:
        kind: max, min, preferDirect, or the name of an entry point.
        metric: for max and min.

    Raises:
        UnknownHeuristic: there is none of that name.
    """
    found = _BUILT_IN.get((kind, metric if kind in {"max", "min"} else None))
    if found is not None:
        return found
    plugins = {entry.name: entry for entry in importlib.metadata.entry_points(group=GROUP)}
    if kind not in plugins:
        known = ", ".join(sorted({f"{k} {m}" if m else k for k, m in _BUILT_IN} | set(plugins)))
        raise UnknownHeuristic(f"there is no heuristic {kind} {metric or ''}".rstrip() + f"; known are {known}")
    loaded: TargetHeuristic = plugins[kind].load()
    return loaded
