"""Who may command a vehicle: transition(state, event, now) -> (state, actions)."""

from fractus_core.control.machine import transition
from fractus_core.control.readiness import not_ready_reason
from fractus_core.control.values import (
    Authority,
    ControlEvent,
    ControlState,
    Mission,
    Outcome,
    OutcomeKind,
    StreamState,
)

__all__ = [
    "Authority",
    "ControlEvent",
    "ControlState",
    "Mission",
    "Outcome",
    "OutcomeKind",
    "StreamState",
    "not_ready_reason",
    "transition",
]
