"""Readiness of the vehicle for a mission."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_core.control.state import Authority, ControlState

NOT_CONNECTED = "the autopilot is not connected"


@dataclass(frozen=True, slots=True)
class Readiness:
    """Preconditions of a flight that are not part of the control state. Empty reasons mean that there is no problem.

    Attributes:
        unverified: Reason why the autopilot's failsafes are not verified.
        unready: Reason why the autopilot would refuse to arm.
        located: True if position and home are known.
        link: Problem of the link to the autopilot.
        absent: Reason why received messages do not come from the autopilot. Empty while the autopilot is connected.
        awaited: Reason why the mission must not begin yet.
        contact: Reason why the mission waits for contact with the API server.
    """

    unverified: str
    unready: str
    located: bool
    link: str = ""
    absent: str = ""
    awaited: str = ""
    contact: str = ""


def not_ready_reason(state: ControlState, key: str, readiness: Readiness) -> str | None:
    """Return why the vehicle cannot fly for a mission now, or None if it can."""
    vehicle = state.vehicle
    reasons = (
        (not vehicle.connected, readiness.absent or NOT_CONNECTED),
        (not state.decided, "it is not known yet who has control of the drone"),
        (state.armed_for_other(key), "another application has the drone"),
        (bool(readiness.unverified), f"the autopilot's failsafes are not verified: {readiness.unverified}"),
        (state.authority is Authority.PILOT, f"a human pilot has the drone ({vehicle.mode.name})"),
        (state.home_for_good, "the system brings the drone home"),
        (
            not vehicle.armed and bool(readiness.unready),
            f"the autopilot is not ready to arm: {readiness.unready}",
        ),
        (not readiness.located, "position and home are not known yet"),
        (bool(readiness.contact), readiness.contact),
        (not vehicle.armed and bool(readiness.link), readiness.link),
        (not vehicle.armed and bool(readiness.awaited), readiness.awaited),
    )
    return next((reason for holds, reason in reasons if holds), None)
