"""Heuristics that score network paths for an application (thesis 8.6).

A heuristic is a function from path metrics to a score. Higher is better, and differences of scores add up over time.
A package can provide a heuristic as an entry point of the group `fractus.linking`. An Application selects the heuristic
by the name of the entry point in `heuristic.kind`.
"""

from __future__ import annotations

import importlib.metadata
import math
from typing import Protocol

from fractus_core.linking.values import PathMetrics

GROUP = "fractus.linking"

DIRECT_BONUS = 1e3
"""With `preferDirect` a direct link beats any bandwidth. Among direct links the faster link wins."""


class PathHeuristic(Protocol):
    """Function that scores a path."""

    def __call__(self, path: PathMetrics) -> float:
        """Return the score of a path. Higher is better. The score must be finite."""


def max_ingress_bandwidth(path: PathMetrics) -> float:
    """Score by Mbit/s towards the component that provides the service."""
    return path.ingress_mbps


def max_egress_bandwidth(path: PathMetrics) -> float:
    """Score by Mbit/s from the component that provides the service."""
    return path.egress_mbps


def min_ingress_latency(path: PathMetrics) -> float:
    """Score by low latency towards the component that provides the service."""
    return -path.ingress_latency_ms


def min_egress_latency(path: PathMetrics) -> float:
    """Score by low latency from the component that provides the service."""
    return -path.egress_latency_ms


def prefer_direct(path: PathMetrics) -> float:
    """Prefer any direct link, because direct links save the cost of the mobile network."""
    return (DIRECT_BONUS if path.direct else 0.0) + min(path.ingress_mbps, path.egress_mbps)


_BUILT_IN: dict[tuple[str, str | None], PathHeuristic] = {
    ("max", "ingress-bandwidth"): max_ingress_bandwidth,
    ("max", "egress-bandwidth"): max_egress_bandwidth,
    ("min", "ingress-latency"): min_ingress_latency,
    ("min", "egress-latency"): min_egress_latency,
    ("preferDirect", None): prefer_direct,
}


class UnknownHeuristic(ValueError):
    """No usable heuristic has this name."""


def find_heuristic(kind: str, metric: str | None = None) -> PathHeuristic:
    """Return the heuristic that an Application selects.

    Args:
        kind: `max`, `min`, `preferDirect`, or the name of an entry point.
        metric: Metric of `max` and `min`.

    Raises:
        UnknownHeuristic: No heuristic has this name.
    """
    built_in = _BUILT_IN.get((kind, metric if kind in {"max", "min"} else None))
    if built_in is not None:
        return built_in
    plugins = {entry.name: entry for entry in importlib.metadata.entry_points(group=GROUP)}
    if kind not in plugins:
        known = ", ".join(sorted({f"{k} {m}" if m else k for k, m in _BUILT_IN} | set(plugins)))
        name = f"{kind} {metric or ''}".rstrip()
        raise UnknownHeuristic(f"unknown heuristic {name}; known heuristics are {known}")
    loaded: PathHeuristic = plugins[kind].load()
    return loaded


_Name = tuple[str, str | None]


class HeuristicRegistry:
    """Loads each heuristic once, and isolates failures of user plug-ins.

    A heuristic that raises, or returns a score that is not finite, counts as unknown from then on. So a broken
    plug-in does not end the links of other applications.
    """

    def __init__(self) -> None:
        self._loaded: dict[_Name, PathHeuristic] = {}
        self._failed: dict[_Name, str] = {}

    def find(self, kind: str, metric: str | None) -> PathHeuristic:
        """Return the heuristic that an Application selects. Its scores are finite, and 0 if it fails.

        Args:
            kind: `max`, `min`, `preferDirect`, or the name of an entry point.
            metric: Metric of `max` and `min`.

        Raises:
            UnknownHeuristic: No heuristic has this name, it cannot be loaded, or it has failed.
        """
        name = (kind, metric)
        if name not in self._loaded and name not in self._failed:
            try:
                self._loaded[name] = self._guard(name, find_heuristic(kind, metric))
            except UnknownHeuristic as error:
                self._failed[name] = str(error)
            except Exception as error:
                self._failed[name] = f"cannot load the heuristic {kind}: {error}"
        if name in self._failed:
            raise UnknownHeuristic(self._failed[name])
        return self._loaded[name]

    def _guard(self, name: _Name, heuristic: PathHeuristic) -> PathHeuristic:
        def guarded(path: PathMetrics) -> float:
            if name in self._failed:
                return 0.0
            try:
                score = float(heuristic(path))
            except Exception as error:
                self._failed[name] = f"the heuristic {name[0]} failed: {error}"
                return 0.0
            if math.isfinite(score):
                return score
            self._failed[name] = f"the heuristic {name[0]} returned {score}"
            return 0.0

        return guarded
