"""Conditions of an object's status: how observations become them, and which of them are news."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from fractus_core.api import Condition


@dataclass(frozen=True, slots=True)
class Fact:
    """One observed fact about an object, before it is known whether it is news.

    Attributes:
        reason: CamelCase.
        message: one sentence.
        progress: whether a status other than True is only a step on the way, not a trouble.
    """

    type: str
    status: Literal["True", "False", "Unknown"]
    reason: str
    message: str = ""
    progress: bool = False

    @property
    def warning(self) -> bool:
        """Whether people should be warned of it."""
        return self.status != "True" and not self.progress


def merge(
    previous: Sequence[Condition], facts: Iterable[Fact], generation: int | None, now: datetime
) -> tuple[tuple[Condition, ...], tuple[Fact, ...]]:
    """Conditions after new observations.

    lastTransitionTime moves only with the status; conditions without a new fact go.

    Returns:
        The conditions in the order of the facts, and the facts that are news: those whose status or
        reason differs from before.
    """
    before = {condition.type: condition for condition in previous}
    merged: list[Condition] = []
    news: list[Fact] = []
    for fact in facts:
        old = before.get(fact.type)
        same_status = old is not None and old.status == fact.status
        merged.append(
            Condition(
                type=fact.type,
                status=fact.status,
                reason=fact.reason,
                message=fact.message[:32768],
                last_transition_time=old.last_transition_time if old is not None and same_status else now,
                observed_generation=generation,
            )
        )
        if old is None or not same_status or old.reason != fact.reason:
            news.append(fact)
    return tuple(merged), tuple(news)
