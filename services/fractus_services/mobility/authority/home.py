"""Home, from which altitudes count and to which all ways home lead: where the mission armed for its first takeoff, also when others move it."""

from __future__ import annotations

import math
from collections.abc import Callable

from fractus_core.control import Authority, ControlState
from fractus_core.geo import LocalFrame
from fractus_core.policy.decision_types import Home

from fractus_services.errors import AutopilotError
from fractus_services.mobility.autopilot import Autopilot, VehicleState

MOVED_M = 2.0
"""A home further away than this, in space, was moved; less is within what legs keep from zones and limits anyway."""

TOLD_TIMEOUT_S = 2.0


def home_moved(state: ControlState, vehicle: VehicleState) -> bool:
    """Whether another station has moved home under a flying drone; under a pilot that is the pilot's affair.

    Until it is set back, neither is it known how high above home the drone is, nor where the autopilot would return to.
    """
    home, mission = vehicle.home, state.mission
    if home is None or mission is None or mission.home is None:
        return False
    if not vehicle.in_air or state.authority is Authority.PILOT:
        return False
    return _apart(home, mission.home)


def heights_mislead(state: ControlState, vehicle: VehicleState) -> bool:
    """Whether home is not where the flight began, also where a pilot moved it: altitudes do not count from the ground then.

    So it is with a home that was not told since the vehicle was armed.
    """
    home, mission, ground = vehicle.home, state.mission, vehicle.ground_home
    if home is None or not vehicle.in_air:
        return False
    began = mission.home if mission is not None and not state.armed_by_others else None
    if began is None and ground is not None:
        began = ground.lat, ground.lon, ground.amsl_m
    return began is None or _apart(home, began)


def _apart(home: Home, began: tuple[float, float, float]) -> bool:
    lat, lon, amsl_m = began
    return math.hypot(*LocalFrame(lat, lon).xy(home.lat, home.lon), home.amsl_m - amsl_m) > MOVED_M


async def keep_home(autopilot: Autopilot, state: Callable[[], ControlState]) -> None:
    """Set home back to where the mission armed for its first takeoff, if it was moved.

    Args:
        autopilot: the link.
        state: of control, at any moment.

    Raises:
        AutopilotError: the autopilot refuses, or does not tell its home.
    """
    mission = state().mission
    if mission is None or mission.home is None or not home_moved(state(), autopilot.vehicle):
        return
    await autopilot.set_home(*mission.home)
    await autopilot.ask_home()
    deadline = autopilot.now + TOLD_TIMEOUT_S
    while home_moved(state(), autopilot.vehicle):
        if autopilot.now > deadline:
            raise AutopilotError("the autopilot accepted its home and does not tell it", link=True)
        await autopilot.update(TOLD_TIMEOUT_S)
