"""Who may command a vehicle: transition(state, event, now) -> (state, actions), in `machine`.

Here are its values alone: who only reads how a mission ended, as an agent, does without the megabyte of the rest.
"""

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
]
