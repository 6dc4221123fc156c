"""Commands that control mission execution: start, select item, jump, pause."""

from __future__ import annotations

import math

from fractus_services.mavlink_server.channel import Channel
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.auto import AutoFlight
from fractus_vehicle.guided import GuidedFlight
from fractus_vehicle.orders import Command
from fractus_vehicle.telemetry import send
from fractus_vehicle.vehicle import Vehicle

MAX_TAG = 65535


def start_mission(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    """Handle MISSION_START. Only the whole mission can be started."""
    if o.params[:2] != (0.0, 0.0):
        return mavlink.MAV_RESULT_DENIED
    if not vehicle.modes.change(mavlink.COPTER_MODE_AUTO):
        return mavlink.MAV_RESULT_FAILED
    flight = vehicle.modes.flight
    if isinstance(flight, AutoFlight):
        flight.start_by_command(vehicle.state)
    return mavlink.MAV_RESULT_ACCEPTED


def set_mission_current(vehicle: Vehicle, o: Command, c: Channel) -> int:
    """Handle DO_SET_MISSION_CURRENT. Reset the mission first if the second parameter is 1."""
    v = vehicle.state
    number = o.params[0]
    if not (math.isfinite(number) and 0 <= int(number) < len(v.mission.items)):
        return mavlink.MAV_RESULT_DENIED
    if o.params[1] == 1.0:
        v.mission.rewind()
    if not set_current(vehicle, int(number)):
        return mavlink.MAV_RESULT_FAILED
    send(v, c, "MISSION_CURRENT")
    return mavlink.MAV_RESULT_ACCEPTED


def jump_to_tag(vehicle: Vehicle, o: Command, c: Channel) -> int:
    """Handle DO_JUMP_TAG."""
    v = vehicle.state
    tag = o.params[0]
    if not 0.0 <= tag <= MAX_TAG:
        return mavlink.MAV_RESULT_DENIED
    index = v.mission.find_tag(int(tag))
    if index is None or not set_current(vehicle, index):
        return mavlink.MAV_RESULT_FAILED
    send(v, c, "MISSION_CURRENT")
    return mavlink.MAV_RESULT_ACCEPTED


def set_current(vehicle: Vehicle, index: int) -> bool:
    """Set the current item. In flight, AUTO mode continues at this item.

    Returns:
        False if there is no such item.
    """
    v = vehicle.state
    if not 0 <= index < len(v.mission.items) or len(v.mission.items) == 1:
        return False
    if index == 0 or v.mission.complete:
        v.mission.rewind()
    if isinstance(vehicle.modes.flight, AutoFlight) and v.armed:
        vehicle.modes.flight.jump_to(v, max(index, 1))
        return True
    first = v.mission.first_navigating(index)
    v.mission.current = first or 0
    return first is not None


def pause(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    """Handle DO_PAUSE_CONTINUE in AUTO and GUIDED modes."""
    v = vehicle.state
    flight = vehicle.modes.flight
    if not math.isfinite(o.params[0]) or int(o.params[0]) not in (0, 1):
        return mavlink.MAV_RESULT_DENIED
    paused = int(o.params[0]) == 0
    if not isinstance(flight, (AutoFlight, GuidedFlight)):
        v.send_text(mavlink.MAV_SEVERITY_INFO, f"Failed to {'pause' if paused else 'resume'}")
        return mavlink.MAV_RESULT_FAILED
    flight.pause(v, paused=paused)
    return mavlink.MAV_RESULT_ACCEPTED


def begin_landing_sequence(vehicle: Vehicle, _o: Command, _c: Channel) -> int:
    """Handle DO_LAND_START. Landing sequences are not simulated."""
    vehicle.state.send_text(mavlink.MAV_SEVERITY_WARNING, "Unable to start landing sequence")
    vehicle.state.send_text(mavlink.MAV_SEVERITY_WARNING, "Mode change to AUTO RTL failed: No landing sequence found")
    return mavlink.MAV_RESULT_FAILED


def begin_return_path(vehicle: Vehicle, _o: Command, _c: Channel) -> int:
    """Handle DO_RETURN_PATH_START. Return paths are not simulated."""
    vehicle.state.send_text(mavlink.MAV_SEVERITY_WARNING, "Mode change to AUTO RTL failed: No return path found")
    return mavlink.MAV_RESULT_FAILED
