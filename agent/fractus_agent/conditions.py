"""What the agent has found out about its node: the material of conditions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal


@dataclass(frozen=True, slots=True)
class Finding:
    """One observed fact; becomes a Kubernetes condition."""

    type: str
    status: Literal["True", "False", "Unknown"]
    reason: str
    message: str = ""

    @property
    def holds(self) -> bool:
        """Whether the status is True."""
        return self.status == "True"


def timestamp(moment: datetime) -> str:
    """A moment as Kubernetes writes it, in whole seconds UTC."""
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def conditions(
    findings: Iterable[Finding], previous: Sequence[dict[str, Any]], generation: int | None, now: datetime
) -> list[dict[str, Any]]:
    """Findings as conditions; lastTransitionTime is kept while the status stays the same."""
    before = {condition.get("type"): condition for condition in previous}
    result = []
    for finding in findings:
        old = before.get(finding.type, {})
        since = old.get("lastTransitionTime") if old.get("status") == finding.status else None
        condition = {
            "type": finding.type,
            "status": finding.status,
            "reason": finding.reason,
            "message": finding.message,
            "lastTransitionTime": since or timestamp(now),
        }
        if generation is not None:
            condition["observedGeneration"] = generation
        result.append(condition)
    return result
