"""Handlers of COMMAND_LONG and COMMAND_INT: check preconditions, execute, and acknowledge with a MAV_RESULT."""

from __future__ import annotations

import math
from collections.abc import Callable

from fractus_runtime.mavlink_codec import Message
from fractus_services.mavlink_server.channel import Channel
from fractus_services.mavlink_server.coordinates import (
    ABSOLUTE_FRAMES,
    ALTITUDE_MAX_M,
    GLOBAL_FRAMES,
    valid_coordinates,
)
from fractus_services.mavlink_server.mission_items import Item
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.accessories import (
    FENCE_SWITCH,
    SWITCH_HIGH,
    SWITCH_LOW,
    SWITCHED_MODES,
)
from fractus_vehicle.copter import (
    FORCE_ARM_MAGIC,
    FORCE_MAGIC,
    GUIDED_MODES,
    SUPPORTED_MODES,
    TAKEOFF_MODES,
    UNAVAILABLE,
)
from fractus_vehicle.guided import GuidedFlight
from fractus_vehicle.home import set_home_at, set_home_to_position
from fractus_vehicle.mission_commands import item_target, switch_fence
from fractus_vehicle.mission_orders import (
    begin_landing_sequence,
    begin_return_path,
    jump_to_tag,
    pause,
    set_mission_current,
    start_mission,
)
from fractus_vehicle.orders import Command, read_command
from fractus_vehicle.readiness import arming_refusals, mandatory_refusals, mode_refusal
from fractus_vehicle.requests import REQUEST_HANDLERS
from fractus_vehicle.state import VehicleState
from fractus_vehicle.vehicle import Vehicle


def _arm_disarm(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    want = o.params[0]
    magic = o.params[1]
    if want == 1.0:
        if v.armed:
            return mavlink.MAV_RESULT_ACCEPTED
        forced = magic == FORCE_ARM_MAGIC
        refusals = mandatory_refusals(v) if forced else arming_refusals(v)
        unsuited = None if forced or refusals else mode_refusal(v)
        for refusal in (*refusals, *((unsuited,) if unsuited else ())):
            v.send_text(mavlink.MAV_SEVERITY_CRITICAL, f"Arm: {refusal}")
        if refusals or unsuited:
            return mavlink.MAV_RESULT_FAILED
        vehicle.arm()
        return mavlink.MAV_RESULT_ACCEPTED
    if want == 0.0:
        if v.armed and not v.landed and magic != FORCE_MAGIC:
            return mavlink.MAV_RESULT_FAILED
        v.disarm(force=magic == FORCE_MAGIC)
        return mavlink.MAV_RESULT_ACCEPTED
    return mavlink.MAV_RESULT_UNSUPPORTED


def _takeoff(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    if o.frame != mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT:
        return mavlink.MAV_RESULT_DENIED
    # The third parameter is not zero if the client accepts a takeoff without horizontal position, as in ALT_HOLD.
    may_take_off = v.mode in TAKEOFF_MODES or (v.mode == mavlink.COPTER_MODE_ALT_HOLD and o.params[2] != 0.0)
    if not v.armed or not v.landed or not may_take_off or not max(v.altitude_m, 0.0) < o.z < ALTITUDE_MAX_M:
        return mavlink.MAV_RESULT_FAILED
    origin = v.origin or v.start
    flight = vehicle.modes.flight
    if not isinstance(flight, GuidedFlight):
        v.begin_takeoff(v.est.down - min(o.z, PILOT_TAKEOFF_MAX_M))
    elif v.mode == mavlink.COPTER_MODE_GUIDED:
        flight.take_off(v, origin.alt_m - (v.home or origin).alt_m - o.z)
    return mavlink.MAV_RESULT_ACCEPTED


def _mode_command(mode: int) -> Callable[[Vehicle, Command, Channel], int]:
    def change(vehicle: Vehicle, _o: Command, _c: Channel) -> int:
        return mavlink.MAV_RESULT_ACCEPTED if vehicle.modes.change(mode) else mavlink.MAV_RESULT_FAILED

    return change


def set_mode_number(vehicle: Vehicle, base_mode: int, custom_mode: int) -> int:
    """Handle DO_SET_MODE and SET_MODE. Only custom modes are accepted, as in ArduPilot."""
    v = vehicle.state
    if not base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return mavlink.MAV_RESULT_DENIED
    if custom_mode not in SUPPORTED_MODES | UNAVAILABLE.keys():
        v.send_text(mavlink.MAV_SEVERITY_WARNING, f"No such mode {custom_mode}")
        return mavlink.MAV_RESULT_FAILED
    return mavlink.MAV_RESULT_ACCEPTED if vehicle.modes.change(custom_mode) else mavlink.MAV_RESULT_FAILED


def _set_mode(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    if not all(math.isfinite(value) for value in o.params[:2]):
        return mavlink.MAV_RESULT_DENIED
    return set_mode_number(vehicle, int(o.params[0]), int(o.params[1]))


def _change_speed(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    # ArduPilot uses these thresholds for the floating-point parameter.
    kind = 0
    if o.params[0] > 2.9:
        kind = 3
    elif o.params[0] > 1.9:
        kind = 2
    takes = v.mode in SPEED_MODES and v.control.limits.change_speed(kind, o.params[1])
    return mavlink.MAV_RESULT_ACCEPTED if takes else mavlink.MAV_RESULT_FAILED


def _has_valid_position(v: VehicleState, o: Command) -> bool:
    """Return True if the altitude and frame define a position. Report an unknown frame in a STATUSTEXT."""
    if not abs(o.z) < ALTITUDE_MAX_M:
        return False
    if o.frame not in GLOBAL_FRAMES:
        v.send_text(mavlink.MAV_SEVERITY_INFO, f"Unknown mavlink coordinate frame {o.frame}")
    return v.altitude_base_m(o.frame) is not None


def _reposition(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    switch = (
        bool(int(o.params[1]) & mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE) if math.isfinite(o.params[1]) else False
    )
    if v.mode not in GUIDED_MODES and not switch:
        return mavlink.MAV_RESULT_DENIED
    if not valid_coordinates(o.x, o.y) or not _has_valid_position(v, o):
        return mavlink.MAV_RESULT_DENIED
    # A zero for the coordinates, or for the height above home or ground, would stand for the current value. ArduPilot
    # denies such a command.
    if not o.has_place or (o.frame not in ABSOLUTE_FRAMES and abs(o.z) < CENTIMETRE):
        return mavlink.MAV_RESULT_DENIED
    north, east, down = item_target(v, o.item)
    if v.outside_fence(north, east, down):
        return mavlink.MAV_RESULT_FAILED
    if v.mode not in GUIDED_MODES and not vehicle.modes.change(mavlink.COPTER_MODE_GUIDED):
        return mavlink.MAV_RESULT_FAILED
    flight = vehicle.modes.flight
    # On the ground, the target is ignored, because the takeoff would replace it.
    if isinstance(flight, GuidedFlight) and not v.landed:
        flight.go_to(v, north, east, down)
        v.heading.follow_course()  # the yaw parameter of the command is ignored
    return mavlink.MAV_RESULT_ACCEPTED


def _yaw(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    """Handle CONDITION_YAW. It is accepted in every mode, but has an effect in automatic modes only."""
    v = vehicle.state
    angle, rate, direction, relative = o.params
    if relative not in (0.0, 1.0) or not 0.0 <= angle <= 360.0:
        return mavlink.MAV_RESULT_FAILED
    if v.mode in HEADING_MODES and math.isfinite(rate) and math.isfinite(direction):
        v.heading.turn_to(angle, rate, int(direction), relative=relative == 1.0)
    return mavlink.MAV_RESULT_ACCEPTED


def _roi(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    if o.command != mavlink.MAV_CMD_DO_SET_ROI_NONE:
        if not _has_valid_position(v, o):
            return mavlink.MAV_RESULT_DENIED
        if not valid_coordinates(o.x, o.y):
            return mavlink.MAV_RESULT_FAILED
        if o.has_place or o.z != 0.0:
            north, east, _ = item_target(v, Item(command=o.command, frame=o.frame, x=o.x, y=o.y))
            v.heading.look_at((north, east))
            return mavlink.MAV_RESULT_ACCEPTED
    v.heading.look_at(None)
    return mavlink.MAV_RESULT_ACCEPTED


def _set_home(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    if o.params[0] == 1.0 or not o.has_place:
        return mavlink.MAV_RESULT_ACCEPTED if set_home_to_position(v) else mavlink.MAV_RESULT_FAILED
    if o.params[0] != 0.0:
        return mavlink.MAV_RESULT_FAILED
    if not _has_valid_position(v, o):
        return mavlink.MAV_RESULT_DENIED
    altitude = o.z + (v.altitude_base_m(o.frame) or 0.0)
    return mavlink.MAV_RESULT_ACCEPTED if set_home_at(v, o.x, o.y, altitude) else mavlink.MAV_RESULT_FAILED


def _fence_enable(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    return mavlink.MAV_RESULT_ACCEPTED if switch_fence(v, o.params[0]) else mavlink.MAV_RESULT_FAILED


def _terminate(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    if o.params[0] <= 0.5:
        return mavlink.MAV_RESULT_FAILED
    v.disarm(force=True)
    return mavlink.MAV_RESULT_ACCEPTED


def _reboot(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    if v.armed:
        return mavlink.MAV_RESULT_FAILED
    if o.params[0] not in (mavlink.REBOOT_SHUTDOWN_ACTION_REBOOT, mavlink.REBOOT_SHUTDOWN_ACTION_REBOOT_TO_BOOTLOADER):
        return mavlink.MAV_RESULT_UNSUPPORTED
    vehicle.reboot_requested = True
    return mavlink.MAV_RESULT_ACCEPTED


def _prearm(vehicle: Vehicle, _o: Command, _c: Channel) -> int:
    v = vehicle.state
    if v.armed:
        return mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    for refusal in arming_refusals(v):
        v.send_text(mavlink.MAV_SEVERITY_CRITICAL, f"PreArm: {refusal}")
    return mavlink.MAV_RESULT_ACCEPTED


def _calibrate(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    """Handle PREFLIGHT_CALIBRATION.

    Accepts calibrations during which nobody has to move the vehicle: gyroscopes, barometer, level. They have no effect
    because simulated sensors do not drift.
    """
    v = vehicle.state
    if v.armed or v.motor_test_until_s is not None:
        v.send_text(mavlink.MAV_SEVERITY_NOTICE, "Disarm to allow calibration")
        return mavlink.MAV_RESULT_FAILED
    if o.params[0] == 1.0:
        return mavlink.MAV_RESULT_ACCEPTED
    if o.params[2] == 1.0:
        v.send_text(mavlink.MAV_SEVERITY_INFO, "Updating barometer calibration")
        v.send_text(mavlink.MAV_SEVERITY_INFO, "Barometer calibration complete")
        return mavlink.MAV_RESULT_ACCEPTED
    if o.x == LEVEL:
        v.send_text(mavlink.MAV_SEVERITY_INFO, "Trim OK: roll=0.00 pitch=0.00 yaw=0.00")
        return mavlink.MAV_RESULT_ACCEPTED
    taken = o.x in (SIMPLE_ACCELEROMETER, FORCE_SAVE) or o.params[1] == FORCE_SAVE
    return mavlink.MAV_RESULT_ACCEPTED if taken else mavlink.MAV_RESULT_UNSUPPORTED


def _storage(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    v = vehicle.state
    if o.params[0] != 2.0 or v.armed:
        return mavlink.MAV_RESULT_DENIED
    v.params.erase()
    v.send_text(mavlink.MAV_SEVERITY_WARNING, "All parameters reset, reboot board")
    return mavlink.MAV_RESULT_ACCEPTED


def _switch(vehicle: Vehicle, o: Command, _c: Channel) -> int:
    """Handle DO_AUX_FUNCTION: act like an RC switch. Only mode and fence functions have an effect."""
    function, position = o.params[:2]
    if not (math.isfinite(function) and math.isfinite(position)) or not SWITCH_LOW <= int(position) <= SWITCH_HIGH:
        return mavlink.MAV_RESULT_DENIED
    if int(function) == FENCE_SWITCH:
        switch_fence(vehicle.state, 1.0 if int(position) == SWITCH_HIGH else 0.0)
    elif int(function) in SWITCHED_MODES and int(position) == SWITCH_HIGH:
        vehicle.modes.change(SWITCHED_MODES[int(function)])
    return mavlink.MAV_RESULT_ACCEPTED


# Modes whose speed a client may change, and modes that control the heading.
SPEED_MODES = GUIDED_MODES | {mavlink.COPTER_MODE_AUTO, mavlink.COPTER_MODE_RTL, mavlink.COPTER_MODE_SMART_RTL}
HEADING_MODES = frozenset({mavlink.COPTER_MODE_GUIDED, mavlink.COPTER_MODE_AUTO, mavlink.COPTER_MODE_SMART_RTL})
CENTIMETRE = 0.01
# Maximum climb of a takeoff in a pilot mode.
PILOT_TAKEOFF_MAX_M = 10.0
# Values of the fifth parameter of PREFLIGHT_CALIBRATION. FORCE_SAVE is also a value of the second parameter.
LEVEL = 2
SIMPLE_ACCELEROMETER = 4
FORCE_SAVE = 76

HANDLERS: dict[int, Callable[[Vehicle, Command, Channel], int]] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mavlink.MAV_CMD_NAV_TAKEOFF: _takeoff,
    mavlink.MAV_CMD_NAV_LAND: _mode_command(mavlink.COPTER_MODE_LAND),
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: _mode_command(mavlink.COPTER_MODE_RTL),
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: _mode_command(mavlink.COPTER_MODE_LOITER),
    mavlink.MAV_CMD_DO_SET_MODE: _set_mode,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    mavlink.MAV_CMD_DO_REPOSITION: _reposition,
    mavlink.MAV_CMD_CONDITION_YAW: _yaw,
    mavlink.MAV_CMD_DO_SET_ROI: _roi,
    mavlink.MAV_CMD_DO_SET_ROI_LOCATION: _roi,
    mavlink.MAV_CMD_DO_SET_ROI_NONE: _roi,
    mavlink.MAV_CMD_DO_SET_HOME: _set_home,
    mavlink.MAV_CMD_DO_FENCE_ENABLE: _fence_enable,
    mavlink.MAV_CMD_MISSION_START: start_mission,
    mavlink.MAV_CMD_DO_SET_MISSION_CURRENT: set_mission_current,
    mavlink.MAV_CMD_DO_JUMP_TAG: jump_to_tag,
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: pause,
    mavlink.MAV_CMD_DO_LAND_START: begin_landing_sequence,
    mavlink.MAV_CMD_DO_RETURN_PATH_START: begin_return_path,
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
    mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    mavlink.MAV_CMD_RUN_PREARM_CHECKS: _prearm,
    mavlink.MAV_CMD_PREFLIGHT_CALIBRATION: _calibrate,
    mavlink.MAV_CMD_PREFLIGHT_STORAGE: _storage,
    mavlink.MAV_CMD_NAV_VTOL_TAKEOFF: _takeoff,
    mavlink.MAV_CMD_NAV_VTOL_LAND: _mode_command(mavlink.COPTER_MODE_LAND),
    mavlink.MAV_CMD_DO_AUX_FUNCTION: _switch,
}
# Commands that ArduPilot accepts in COMMAND_INT only.
INT_ONLY = frozenset({mavlink.MAV_CMD_DO_REPOSITION})


def handle_command(vehicle: Vehicle, message: Message, channel: Channel) -> None:
    """Execute a command and send COMMAND_ACK."""
    order = read_command(message)
    handler = HANDLERS.get(order.command)
    answer = REQUEST_HANDLERS.get(order.command)
    if answer is not None:
        result = answer(vehicle.state, order, channel)
    elif handler is None or (order.command in INT_ONLY and not order.integer):
        result = mavlink.MAV_RESULT_UNSUPPORTED
    else:
        result = handler(vehicle, order, channel)
    channel.send(
        "COMMAND_ACK",
        {
            "command": order.command,
            "result": int(result),
            "target_system": message.sysid,
            "target_component": message.compid,
        },
    )
