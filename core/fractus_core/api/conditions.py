"""Merging of new observations into the conditions of an object's status, and detection of transitions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from fractus_core.api.model import Condition

_MAX_MESSAGE_LENGTH = 32768


@dataclass(frozen=True, slots=True)
class ConditionUpdate:
    """The observed value of one condition.

    Attributes:
        type: Condition type.
        reason: CamelCase.
        message: Details for people.
        progress: True if a status other than True is an expected step and not a problem.
        adverse: True if status True is the problem.
    """

    type: str
    status: Literal["True", "False", "Unknown"]
    reason: str
    message: str = ""
    progress: bool = False
    adverse: bool = False

    @property
    def warning(self) -> bool:
        """True if an Event about the condition should be a warning."""
        return (self.status == "True") == self.adverse and not self.progress


def merge_conditions(
    previous: Iterable[Condition], updates: Iterable[ConditionUpdate], generation: int | None, now: datetime
) -> tuple[tuple[Condition, ...], tuple[ConditionUpdate, ...]]:
    """Merge new observations into the conditions of an object.

    lastTransitionTime changes only with the status. Conditions without an update are removed.

    Args:
        previous: Conditions as last written.
        updates: New observations.
        generation: metadata.generation that the observations refer to, or None if unknown.
        now: Current time. Fractions of a second are dropped, as Kubernetes does.

    Returns:
        The conditions in the order of the updates, and the updates whose status or reason is new.
    """
    before = {condition.type: condition for condition in previous}
    merged: list[Condition] = []
    transitions: list[ConditionUpdate] = []
    for update in updates:
        old = before.get(update.type)
        since = now.replace(microsecond=0)
        if old is not None and old.status == update.status:
            since = old.last_transition_time
        merged.append(
            Condition(
                type=update.type,
                status=update.status,
                reason=update.reason,
                message=update.message[:_MAX_MESSAGE_LENGTH],
                last_transition_time=since,
                observed_generation=generation,
            )
        )
        if old is None or (old.status, old.reason) != (update.status, update.reason):
            transitions.append(update)
    return tuple(merged), tuple(transitions)
