"""Control authority over a vehicle: a pure state machine, `machine.transition(state, event, now) -> (state, actions)`.

This package exports the values only. A process that merely reads mission outcomes, such as the agent, does not load the
state machine.
"""

from fractus_core.control.state import (
    Authority,
    ControlEvent,
    ControlState,
    Mission,
    Outcome,
    OutcomeKind,
    StreamState,
    WaypointCounts,
)

__all__ = [
    "Authority",
    "ControlEvent",
    "ControlState",
    "Mission",
    "Outcome",
    "OutcomeKind",
    "StreamState",
    "WaypointCounts",
]
