"""Whether the drone can fly for a mission now, and why not."""

from __future__ import annotations

from fractus_core.control import readiness as core
from fractus_core.control.readiness import NOT_CONNECTED, Readiness

from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.autopilot import BEING_SET


def not_ready_reason(control: Control, key: str) -> str | None:
    """Why the drone cannot fly for a mission now; None when it can."""
    autopilot, checked = control.autopilot, control.checked
    vehicle = autopilot.vehicle
    located = vehicle.lat is not None and vehicle.home is not None
    # In flight what was known before stands for what cannot be verified at the moment.
    unverified = BEING_SET if checked is None else "" if vehicle.armed else checked.problem
    readiness = Readiness(unverified, vehicle.unready(autopilot.now), located, autopilot.link_problem, vehicle.unclear)
    return core.not_ready_reason(control.state, key, readiness)


def arming_problem(control: Control) -> str:
    """Why the motors could not be started now, for any caller; empty when they could."""
    autopilot, checked = control.autopilot, control.checked
    if not autopilot.connected:
        return autopilot.vehicle.unclear or NOT_CONNECTED
    unverified = BEING_SET if checked is None else checked.problem
    if unverified:
        return f"the autopilot's failsafes are not verified: {unverified}"
    return autopilot.vehicle.unready(autopilot.now) or autopilot.link_problem
