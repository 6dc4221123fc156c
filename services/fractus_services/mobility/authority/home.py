"""Home position: where the mission armed for its first takeoff, also if another station moves it in flight.

Altitudes are measured from home, and every return flight leads there.
"""

from __future__ import annotations

import math

from fractus_core.control import Authority, ControlState
from fractus_core.geo import LocalFrame
from fractus_core.policy.decision_types import Home

from fractus_services.errors import AutopilotError
from fractus_services.mobility.authority.mode_controller import ControlAccess
from fractus_services.mobility.autopilot import Autopilot, VehicleState
from fractus_services.mobility.settings import SETTINGS


def home_moved(state: ControlState, vehicle: VehicleState) -> bool:
    """Return True if another station moved home under a drone in flight. A pilot may move it.

    Until home is restored, neither the altitude above home nor the destination of the autopilot's return is known.
    """
    home = vehicle.home
    mission = state.mission
    if home is None or mission is None or mission.home is None:
        return False
    if not vehicle.in_air or state.authority is Authority.PILOT:
        return False
    return _differs(home, mission.home)


def home_altitude_inconsistent(state: ControlState, vehicle: VehicleState) -> bool:
    """Return True if home is not where the flight began, so that altitudes are not measured from the ground there.

    The same holds if home was not reported since the vehicle armed. A home moved by a pilot counts too.
    """
    home = vehicle.home
    mission = state.mission
    ground = vehicle.ground_home
    if home is None or not vehicle.in_air:
        return False
    origin = mission.home if mission is not None and not state.armed_by_others else None
    if origin is None and ground is not None:
        origin = ground.lat, ground.lon, ground.amsl_m
    return origin is None or _differs(home, origin)


def _differs(home: Home, origin: tuple[float, float, float]) -> bool:
    lat, lon, amsl_m = origin
    return math.hypot(*LocalFrame(lat, lon).xy(home.lat, home.lon), home.amsl_m - amsl_m) > SETTINGS.home_moved_m


async def restore_home(autopilot: Autopilot, control: ControlAccess) -> None:
    """Set home back to where the mission armed for its first takeoff, if it was moved.

    Raises:
        AutopilotError: The autopilot refused, or reported no new home.
    """
    mission = control.state.mission
    if mission is None or mission.home is None or not home_moved(control.state, autopilot.vehicle):
        return
    await autopilot.set_home(*mission.home)
    await autopilot.request_home()
    deadline = autopilot.now + SETTINGS.home_timeout_s
    while home_moved(control.state, autopilot.vehicle):
        if autopilot.now > deadline:
            raise AutopilotError("autopilot acknowledged DO_SET_HOME but sent no HOME_POSITION", link=True)
        await autopilot.update(SETTINGS.home_timeout_s)
