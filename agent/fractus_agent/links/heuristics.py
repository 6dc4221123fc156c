"""The heuristics of applications, which may be a user's: one that does not work must not end the links of others."""

from __future__ import annotations

import math

from fractus_core.linking import PathMetrics, TargetHeuristic, UnknownHeuristic, heuristic

_Name = tuple[str, str | None]


class Heuristics:
    """Loads each heuristic once, and takes it as unknown from its first failure on."""

    def __init__(self) -> None:
        self._found: dict[_Name, TargetHeuristic] = {}
        self._failed: dict[_Name, str] = {}

    def find(self, kind: str, metric: str | None) -> TargetHeuristic:
        """The heuristic that an Application names; its scores are finite, and 0 where it fails.

        Args:
            kind: max, min, preferDirect, or the name of an entry point.
            metric: for max and min.

        Raises:
            UnknownHeuristic: there is none of that name, it cannot be loaded, or it has failed.
        """
        name = (kind, metric)
        if name not in self._found and name not in self._failed:
            try:
                self._found[name] = self._guarded(name, heuristic(kind, metric))
            except UnknownHeuristic as error:
                self._failed[name] = str(error)
            except Exception as error:
                self._failed[name] = f"the heuristic {kind} cannot be loaded: {error}"
        if name in self._failed:
            raise UnknownHeuristic(self._failed[name])
        return self._found[name]

    def _guarded(self, name: _Name, score: TargetHeuristic) -> TargetHeuristic:
        def guarded(path: PathMetrics) -> float:
            if name in self._failed:
                return 0.0
            try:
                found = float(score(path))
            except Exception as error:
                self._failed[name] = f"the heuristic {name[0]} fails: {error}"
                return 0.0
            if math.isfinite(found):
                return found
            self._failed[name] = f"the heuristic {name[0]} gives {found}"
            return 0.0

        return guarded
