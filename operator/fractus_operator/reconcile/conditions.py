"""Conditions of an object's status: how observations become them, and which of them are transitions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from fractus_core.api import Condition


@dataclass(frozen=True, slots=True)
class ConditionUpdate:
    """What was observed of one condition of an object, before it is known whether that is a transition.

    Attributes:
        reason: CamelCase.
        message: one sentence.
        progress: whether a status other than True is only a step on the way, not a problem.
        adverse: whether True is the problem.
    """

    type: str
    status: Literal["True", "False", "Unknown"]
    reason: str
    message: str = ""
    progress: bool = False
    adverse: bool = False

    @property
    def warning(self) -> bool:
        """Whether people should be warned of it."""
        return (self.status == "True") == self.adverse and not self.progress


def merge(
    previous: Sequence[Condition], updates: Iterable[ConditionUpdate], generation: int | None, now: datetime
) -> tuple[tuple[Condition, ...], tuple[ConditionUpdate, ...]]:
    """Conditions after new observations.

    lastTransitionTime moves only with the status; conditions without an update are removed.

    Returns:
        The conditions in the order of the updates, and the transitions: the updates whose status or reason is new.
    """
    before = {condition.type: condition for condition in previous}
    merged: list[Condition] = []
    transitions: list[ConditionUpdate] = []
    for update in updates:
        old = before.get(update.type)
        same_status = old is not None and old.status == update.status
        merged.append(
            Condition(
                type=update.type,
                status=update.status,
                reason=update.reason,
                message=update.message[:32768],
                last_transition_time=old.last_transition_time if old is not None and same_status else now,
                observed_generation=generation,
            )
        )
        if old is None or not same_status or old.reason != update.reason:
            transitions.append(update)
    return tuple(merged), tuple(transitions)
