"""States of a flight plan and the permitted changes between them (ASTM F3548)."""

from __future__ import annotations

from fractus_core.api.flight_plans import PlanState
from fractus_core.exhaustive import exhaustive

NEXT_STATES: dict[PlanState, tuple[PlanState, ...]] = exhaustive(
    PlanState,
    {
        "Draft": ("Draft", "Accepted", "Rejected"),
        "Rejected": ("Rejected", "Draft"),
        "Accepted": ("Accepted", "Activated", "Ended", "Rejected"),
        "Activated": ("Activated", "Nonconforming", "Contingent", "Ended"),
        "Nonconforming": ("Nonconforming", "Activated", "Contingent", "Ended"),
        "Contingent": ("Contingent", "Ended"),
        "Ended": ("Ended",),
    },
)
"""States that a plan may have next. The same state means a changed plan. A changed plan that was Rejected becomes a Draft."""

NOMINAL: frozenset[PlanState] = frozenset({"Accepted", "Activated"})
"""States in which a plan keeps to its volumes, so that conflicts are checked."""

OFF_NOMINAL: frozenset[PlanState] = frozenset({"Nonconforming", "Contingent"})
"""States in which a plan may have off-nominal volumes, and in which nothing is refused because a drone is in the air."""

RESERVING: frozenset[PlanState] = NOMINAL | OFF_NOMINAL
"""States in which a plan uses airspace."""


def transition_problem(before: PlanState, after: PlanState) -> str:
    """Return why a plan must not change from a state to another state, or an empty string if it may."""
    if after in NEXT_STATES[before]:
        return ""
    possible = " or ".join(state for state in NEXT_STATES[before] if state != before)
    remedy = f"its next state can be {possible}" if possible else "create another flight plan"
    return f"the flight plan is {before} and cannot become {after}; {remedy}"
