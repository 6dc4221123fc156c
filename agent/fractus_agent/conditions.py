"""Conditions of the node and of its DirectLinks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Literal


@dataclass(frozen=True, slots=True)
class Condition:
    """Condition without timestamps.

    Attributes:
        type: Condition type.
        status: Condition status.
        reason: Reason in CamelCase.
        message: Details for people.
    """

    type: str
    status: Literal["True", "False", "Unknown"]
    reason: str
    message: str = ""

    @property
    def is_true(self) -> bool:
        """True if the status is "True"."""
        return self.status == "True"


def timestamp(moment: datetime) -> str:
    """Format a time as Kubernetes does, in whole seconds UTC."""
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def to_kubernetes(
    conditions: Iterable[Condition], previous: Sequence[dict[str, Any]], generation: int | None, now: datetime
) -> list[dict[str, Any]]:
    """Convert conditions to Kubernetes objects. lastTransitionTime stays while the status stays the same."""
    before = {condition.get("type"): condition for condition in previous}
    result = []
    for condition in conditions:
        old = before.get(condition.type, {})
        since = old.get("lastTransitionTime") if old.get("status") == condition.status else None
        result.append({**asdict(condition), "lastTransitionTime": since or timestamp(now)})
        if generation is not None:
            result[-1]["observedGeneration"] = generation
    return result
