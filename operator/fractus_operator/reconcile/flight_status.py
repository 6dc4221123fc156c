"""How far an application's flight is, from what its drone's agent reports. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from fractus_core.api import Drone

from fractus_operator.reconcile.conditions import ConditionUpdate

FlightPhase = Literal["Waiting", "TakingOff", "Flying", "Returning", "Landed", "Unknown"]
BEGUN = "MissionBegun"


@dataclass(frozen=True, slots=True)
class Flight:
    """The flight of an application that has a drone.

    Attributes:
        phase: Waiting before the takeoff, Landed after it; Unknown while nothing is heard of the drone.
        does: what the drone does, as a part of a sentence.
        controller: who flies, while it is in the air: system, pilot, or a component.
        begun: whether the drone has taken off for the application.
    """

    phase: FlightPhase
    does: str
    controller: str | None
    begun: bool


def flight(name: str, drone: Drone | None, reported: dict[str, Any]) -> Flight:
    """How far the flight is.

    Args:
        name: Of the drone of the application's plan.
        drone: The drone, None where its object is gone.
        reported: The application's status so far.
    """
    status = drone.status if drone is not None else None
    in_air = status is not None and status.in_air
    begun = in_air or (reported.get("drone") == name and _has_begun(reported))
    if status is None or status.flight_state == "unknown":
        was = f"was {_WORDS[status.last_flight_state]}" if status is not None and status.last_flight_state else "stood"
        return Flight("Unknown", f"{name} {was} when it was last heard of, what it does now is not known", None, begun)
    if not in_air:
        after = "has landed" if begun else "stands, its mission has not begun"
        return Flight("Landed" if begun else "Waiting", f"{name} {after}", None, begun)
    controller = pilot_of(status.controller)
    does = f"{name} is {_WORDS[status.flight_state]}" + (f", flown by {controller}" if controller else "")
    return Flight("TakingOff" if status.flight_state == "takingOff" else "Flying", does, controller, begun)


_WORDS = {
    "unknown": "somewhere",
    "inactive": "on the ground",
    "charging": "charging",
    "takingOff": "taking off",
    "flying": "flying",
    "landing": "landing",
}


def pilot_of(controller: str | None) -> str | None:
    """A drone's controller as people call it: of an identity, the component."""
    if not controller:
        return None
    return controller.partition("/component/")[2].partition("/")[0] or controller


def mission_condition(found: Flight) -> ConditionUpdate:
    """MissionComplete while the mission goes on."""
    reason = BEGUN if found.begun else "MissionWaiting"
    message = "the drone has taken off" if found.begun else "the drone has not taken off yet"
    return ConditionUpdate("MissionComplete", "False", reason, message, progress=True)


def _has_begun(reported: dict[str, Any]) -> bool:
    conditions = reported.get("conditions") or ()
    return any(c["type"] == "MissionComplete" and c["reason"] == BEGUN for c in conditions)
