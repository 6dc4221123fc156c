"""Whether the vehicle can fly for a mission now, and what it waits for."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_core.control.values import Authority, ControlState

NOT_CONNECTED = "the autopilot is not connected"


@dataclass(frozen=True, slots=True)
class Readiness:
    """What else an application must wait for.

    Attributes:
        unverified: why the autopilot's failsafes do not count as set; empty when they do.
        unready: why the autopilot would not arm; empty when it would.
        located: whether position and home are known.
        link: what is wrong with the link to the autopilot; empty when nothing is.
        absent: why what is heard is not the autopilot, while that is not connected; empty when nothing is heard.
    """

    unverified: str
    unready: str
    located: bool
    link: str = ""
    absent: str = ""


def not_ready_reason(state: ControlState, key: str, readiness: Readiness) -> str | None:
    """Why the vehicle cannot fly for a mission now; None when it can."""
    vehicle = state.vehicle
    reasons = (
        (not vehicle.connected, readiness.absent or NOT_CONNECTED),
        (not state.decided, "it is not known yet what the drone does"),
        (state.taken(key), "another application has the drone"),
        (bool(readiness.unverified), f"the autopilot's failsafes are not verified: {readiness.unverified}"),
        (state.authority is Authority.PILOT, f"a human pilot has the drone ({vehicle.mode.name})"),
        (state.home_for_good, "the system brings the drone home"),
        (
            not vehicle.armed and bool(readiness.unready),
            f"the autopilot is not ready to arm: {readiness.unready}",
        ),
        (not readiness.located, "position and home are not known yet"),
        (not vehicle.armed and bool(readiness.link), readiness.link),
    )
    return next((reason for holds, reason in reasons if holds), None)
