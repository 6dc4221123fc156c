"""Failsafe actions: parameter values of ArduCopter, execution, and fallbacks."""

from __future__ import annotations

from enum import IntEnum

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.landing import Land
from fractus_vehicle.modes import FlightModes
from fractus_vehicle.state import VehicleState


class Action(IntEnum):
    """Failsafe actions, with the values of BATT_FS_*_ACT. The tables below map the values of other parameters."""

    NONE = 0
    LAND = 1
    RTL = 2
    SMART_RTL = 3
    SMART_RTL_LAND = 4
    TERMINATE = 5
    AUTO_LAND_START = 6
    BRAKE_LAND = 7


# Values of FS_GCS_ENABLE. Any other value selects RTL.
GCS_ACTIONS = {
    3: Action.SMART_RTL,
    4: Action.SMART_RTL_LAND,
    5: Action.LAND,
    6: Action.AUTO_LAND_START,
    7: Action.BRAKE_LAND,
}
# Values of FS_THR_ENABLE. Any other value selects LAND.
RADIO_ACTIONS = {
    1: Action.RTL,
    2: Action.RTL,
    4: Action.SMART_RTL,
    5: Action.SMART_RTL_LAND,
    6: Action.AUTO_LAND_START,
    7: Action.BRAKE_LAND,
}
# Values of FENCE_ACTION. 0 only reports the breach.
FENCE_ACTIONS = {
    1: Action.RTL,
    2: Action.LAND,
    3: Action.SMART_RTL,
    4: Action.BRAKE_LAND,
    5: Action.SMART_RTL_LAND,
}


def execute_action(v: VehicleState, modes: FlightModes, action: Action) -> None:
    """Execute an action. If its mode is unavailable, fall back to the next best mode and finally to LAND."""
    match action:
        case Action.NONE:
            return
        case Action.TERMINATE:
            v.disarm(force=True)
        case Action.LAND:
            _land(v, modes)
        case Action.RTL:
            _return(v, modes)
        case Action.SMART_RTL:
            if not modes.change(mavlink.COPTER_MODE_SMART_RTL):
                v.send_text(mavlink.MAV_SEVERITY_WARNING, "SmartRTL Unavailable, Trying RTL Mode")
                _return(v, modes)
        case Action.SMART_RTL_LAND:
            if not modes.change(mavlink.COPTER_MODE_SMART_RTL):
                v.send_text(mavlink.MAV_SEVERITY_WARNING, "SmartRTL Unavailable, Using Land Mode")
                _land(v, modes)
        case Action.AUTO_LAND_START:
            # Landing sequences in missions are not simulated. Without a landing sequence, ArduPilot falls back to RTL.
            v.send_text(mavlink.MAV_SEVERITY_WARNING, "Trying RTL Mode")
            _return(v, modes)
        case Action.BRAKE_LAND:
            if not modes.change(mavlink.COPTER_MODE_BRAKE):
                v.send_text(mavlink.MAV_SEVERITY_WARNING, "Trying Land Mode")
                _land(v, modes)


def _return(v: VehicleState, modes: FlightModes) -> None:
    if not modes.change(mavlink.COPTER_MODE_RTL):
        _land(v, modes)


def _land(v: VehicleState, modes: FlightModes) -> None:
    modes.change(mavlink.COPTER_MODE_LAND)
    if isinstance(modes.flight, Land):
        modes.flight.pause(v)
