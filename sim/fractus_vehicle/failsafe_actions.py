"""What a failsafe may do, by the numbers that ArduCopter's parameters have for it, and what it falls back on."""

from __future__ import annotations

from enum import IntEnum

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.landing import Land
from fractus_vehicle.modes import FlightModes
from fractus_vehicle.state import VehicleState


class Action(IntEnum):
    """BATT_FS_*_ACT; the other parameters have tables of their own."""

    NONE = 0
    LAND = 1
    RTL = 2
    SMART_RTL = 3
    SMART_RTL_LAND = 4
    TERMINATE = 5
    AUTO_LAND_START = 6
    BRAKE_LAND = 7


# FS_GCS_ENABLE; a value that is none of these returns.
GCS_ACTIONS = {
    3: Action.SMART_RTL,
    4: Action.SMART_RTL_LAND,
    5: Action.LAND,
    6: Action.AUTO_LAND_START,
    7: Action.BRAKE_LAND,
}
# FS_THR_ENABLE; a value that is none of these lands.
RADIO_ACTIONS = {
    1: Action.RTL,
    2: Action.RTL,
    4: Action.SMART_RTL,
    5: Action.SMART_RTL_LAND,
    6: Action.AUTO_LAND_START,
    7: Action.BRAKE_LAND,
}
# FENCE_ACTION; 0 only reports.
FENCE_ACTIONS = {
    1: Action.RTL,
    2: Action.LAND,
    3: Action.SMART_RTL,
    4: Action.BRAKE_LAND,
    5: Action.SMART_RTL_LAND,
}


def act(v: VehicleState, modes: FlightModes, action: Action) -> None:
    """Carry an action out; a mode that cannot be flown now gives way to the next best, LAND in the end."""
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
                v.say(mavlink.MAV_SEVERITY_WARNING, "SmartRTL Unavailable, Trying RTL Mode")
                _return(v, modes)
        case Action.SMART_RTL_LAND:
            if not modes.change(mavlink.COPTER_MODE_SMART_RTL):
                v.say(mavlink.MAV_SEVERITY_WARNING, "SmartRTL Unavailable, Using Land Mode")
                _land(v, modes)
        case Action.AUTO_LAND_START:
            # Missions with a landing sequence to jump to are not flown here: the autopilot's own fallback.
            v.say(mavlink.MAV_SEVERITY_WARNING, "Trying RTL Mode")
            _return(v, modes)
        case Action.BRAKE_LAND:
            if not modes.change(mavlink.COPTER_MODE_BRAKE):
                v.say(mavlink.MAV_SEVERITY_WARNING, "Trying Land Mode")
                _land(v, modes)


def _return(v: VehicleState, modes: FlightModes) -> None:
    if not modes.change(mavlink.COPTER_MODE_RTL):
        _land(v, modes)


def _land(v: VehicleState, modes: FlightModes) -> None:
    modes.change(mavlink.COPTER_MODE_LAND)
    if isinstance(modes.flight, Land):
        modes.flight.pause(v)
