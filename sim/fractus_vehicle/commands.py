"""Answers to COMMAND_LONG and COMMAND_INT: what is allowed when, and the result that goes back."""

from __future__ import annotations

import math
from collections.abc import Callable

from fractus_mavlink import Message
from fractus_mavlink.enums import (
    COPTER_MODE,
    MAV_CMD,
    MAV_DO_REPOSITION_FLAGS,
    MAV_FRAME,
    MAV_MODE_FLAG,
    MAV_RESULT,
    MAV_SEVERITY,
    REBOOT_SHUTDOWN_ACTION,
)

from fractus_vehicle.accessories import (
    FENCE_SWITCH,
    SWITCH_HIGH,
    SWITCH_LOW,
    SWITCHED_MODES,
)
from fractus_vehicle.channel import Channel
from fractus_vehicle.copter import (
    ABSOLUTE_FRAMES,
    FORCE_ARM_MAGIC,
    FORCE_MAGIC,
    GLOBAL_FRAMES,
    GUIDED_MODES,
    SUPPORTED_MODES,
    TAKES_OFF,
    UNAVAILABLE,
)
from fractus_vehicle.earth import ALTITUDE_MAX_M, valid_coordinates
from fractus_vehicle.guided import GuidedFlight
from fractus_vehicle.home import set_home_at, set_home_here
from fractus_vehicle.mission_commands import item_target, switch_fence
from fractus_vehicle.mission_items import Item
from fractus_vehicle.mission_orders import (
    begin_landing_sequence,
    begin_return_path,
    choose_item,
    jump_to_tag,
    pause,
    start_mission,
)
from fractus_vehicle.orders import Order, read_order
from fractus_vehicle.readiness import arming_refusals, mandatory_refusals, mode_refusal
from fractus_vehicle.requests import ANSWERS
from fractus_vehicle.state import VehicleState
from fractus_vehicle.vehicle import Vehicle


def _arm_disarm(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    want, magic = o.params[0], o.params[1]
    if want == 1.0:
        if v.armed:
            return MAV_RESULT.ACCEPTED
        forced = magic == FORCE_ARM_MAGIC
        refusals = mandatory_refusals(v) if forced else arming_refusals(v)
        unsuited = None if forced or refusals else mode_refusal(v)
        for refusal in (*refusals, *((unsuited,) if unsuited else ())):
            v.say(MAV_SEVERITY.CRITICAL, f"Arm: {refusal}")
        if refusals or unsuited:
            return MAV_RESULT.FAILED
        vehicle.arm()
        return MAV_RESULT.ACCEPTED
    if want == 0.0:
        if v.armed and not v.landed and magic != FORCE_MAGIC:
            return MAV_RESULT.FAILED
        v.disarm(force=magic == FORCE_MAGIC)
        return MAV_RESULT.ACCEPTED
    return MAV_RESULT.UNSUPPORTED


def _takeoff(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if o.frame != MAV_FRAME.GLOBAL_RELATIVE_ALT:
        return MAV_RESULT.DENIED
    # ALT_HOLD takes off where the client does not ask to keep the position.
    takes_off = v.mode in TAKES_OFF or (v.mode is COPTER_MODE.ALT_HOLD and o.params[2] != 0.0)
    if not v.armed or not v.landed or not takes_off or not v.altitude_m < o.z < ALTITUDE_MAX_M:
        return MAV_RESULT.FAILED
    origin = v.origin or v.start
    flight = vehicle.modes.flight
    if not isinstance(flight, GuidedFlight):
        v.begin_takeoff(v.est.down - min(o.z, PILOT_TAKEOFF_MAX_M))
    elif v.mode is COPTER_MODE.GUIDED:
        flight.take_off(v, origin.alt_m - (v.home or origin).alt_m - o.z)
    return MAV_RESULT.ACCEPTED


def _mode_command(mode: COPTER_MODE) -> Callable[[Vehicle, Order, Channel], MAV_RESULT]:
    def change(vehicle: Vehicle, _o: Order, _c: Channel) -> MAV_RESULT:
        return MAV_RESULT.ACCEPTED if vehicle.modes.change(mode) else MAV_RESULT.FAILED

    return change


def set_mode_number(vehicle: Vehicle, base_mode: int, custom_mode: int) -> MAV_RESULT:
    """DO_SET_MODE and SET_MODE: only custom modes, as ArduPilot."""
    v = vehicle.state
    if not base_mode & MAV_MODE_FLAG.CUSTOM_MODE_ENABLED:
        return MAV_RESULT.DENIED
    if custom_mode not in SUPPORTED_MODES | UNAVAILABLE.keys():
        v.say(MAV_SEVERITY.WARNING, f"No such mode {custom_mode}")
        return MAV_RESULT.FAILED
    return MAV_RESULT.ACCEPTED if vehicle.modes.change(COPTER_MODE(custom_mode)) else MAV_RESULT.FAILED


def _set_mode(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    if not all(math.isfinite(value) for value in o.params[:2]):
        return MAV_RESULT.DENIED
    return set_mode_number(vehicle, int(o.params[0]), int(o.params[1]))


def _change_speed(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    kind = 3 if o.params[0] > 2.9 else 2 if o.params[0] > 1.9 else 0  # as the autopilot compares it
    takes = v.mode in CHANGES_SPEED and v.control.limits.change_speed(kind, o.params[1])
    return MAV_RESULT.ACCEPTED if takes else MAV_RESULT.FAILED


def _readable_place(v: VehicleState, o: Order) -> bool:
    """Whether a command's altitude and frame say where it means; a frame that is none is complained about."""
    if not abs(o.z) < ALTITUDE_MAX_M:
        return False
    if o.frame not in GLOBAL_FRAMES:
        v.say(MAV_SEVERITY.INFO, f"Unknown mavlink coordinate frame {o.frame}")
    return v.altitude_base_m(o.frame) is not None


def _reposition(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    switch = bool(int(o.params[1]) & MAV_DO_REPOSITION_FLAGS.CHANGE_MODE) if math.isfinite(o.params[1]) else False
    if v.mode not in GUIDED_MODES and not switch:
        return MAV_RESULT.DENIED
    if not valid_coordinates(o.x, o.y) or not _readable_place(v, o):
        return MAV_RESULT.DENIED
    # No place, or no height above home or ground, would mean the present one, which is not taken here.
    if not o.has_place or (o.frame not in ABSOLUTE_FRAMES and abs(o.z) < CENTIMETRE):
        return MAV_RESULT.DENIED
    north, east, down = item_target(v, o.item)
    if v.outside_fence(north, east, down):
        return MAV_RESULT.FAILED
    if v.mode not in GUIDED_MODES and not vehicle.modes.change(COPTER_MODE.GUIDED):
        return MAV_RESULT.FAILED
    flight = vehicle.modes.flight
    # On the ground it is noted, and a takeoff sets another target.
    if isinstance(flight, GuidedFlight) and not v.landed:
        flight.go_to(v, north, east, down)
        v.heading.follow_course()  # its own heading is not looked at
    return MAV_RESULT.ACCEPTED


def _yaw(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    """Taken in every mode; those that fly by themselves turn."""
    v = vehicle.state
    angle, rate, direction, relative = o.params
    if relative not in (0.0, 1.0) or not 0.0 <= angle <= 360.0:
        return MAV_RESULT.FAILED
    if v.mode in TURNS and math.isfinite(rate) and math.isfinite(direction):
        v.heading.turn_to(angle, rate, int(direction), relative=relative == 1.0)
    return MAV_RESULT.ACCEPTED


def _roi(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if o.command != MAV_CMD.DO_SET_ROI_NONE:
        if not _readable_place(v, o):
            return MAV_RESULT.DENIED
        if not valid_coordinates(o.x, o.y):
            return MAV_RESULT.FAILED
        if o.has_place or o.z != 0.0:
            north, east, _ = item_target(v, Item(command=o.command, frame=o.frame, x=o.x, y=o.y))
            v.heading.look_at((north, east))
            return MAV_RESULT.ACCEPTED
    v.heading.look_at(None)
    return MAV_RESULT.ACCEPTED


def _set_home(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if o.params[0] == 1.0 or not o.has_place:
        return MAV_RESULT.ACCEPTED if set_home_here(v) else MAV_RESULT.FAILED
    if o.params[0] != 0.0:
        return MAV_RESULT.FAILED
    if not _readable_place(v, o):
        return MAV_RESULT.DENIED
    altitude = o.z + (v.altitude_base_m(o.frame) or 0.0)
    return MAV_RESULT.ACCEPTED if set_home_at(v, o.x, o.y, altitude) else MAV_RESULT.FAILED


def _fence_enable(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    return MAV_RESULT.ACCEPTED if switch_fence(v, o.params[0]) else MAV_RESULT.FAILED


def _terminate(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if o.params[0] <= 0.5:
        return MAV_RESULT.FAILED
    v.disarm(force=True)
    return MAV_RESULT.ACCEPTED


def _reboot(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if v.armed:
        return MAV_RESULT.FAILED
    if o.params[0] not in (REBOOT_SHUTDOWN_ACTION.REBOOT, REBOOT_SHUTDOWN_ACTION.REBOOT_TO_BOOTLOADER):
        return MAV_RESULT.UNSUPPORTED
    vehicle.reboot_wanted = True
    return MAV_RESULT.ACCEPTED


def _prearm(vehicle: Vehicle, _o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if v.armed:
        return MAV_RESULT.TEMPORARILY_REJECTED
    for refusal in arming_refusals(v):
        v.say(MAV_SEVERITY.CRITICAL, f"PreArm: {refusal}")
    return MAV_RESULT.ACCEPTED


def _calibrate(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    """Takes what needs no pilot's hands, and has no effect on sensors that do not drift: gyroscopes, barometer, level."""
    v = vehicle.state
    if v.armed or v.motor_test_until_s is not None:
        v.say(MAV_SEVERITY.NOTICE, "Disarm to allow calibration")
        return MAV_RESULT.FAILED
    if o.params[0] == 1.0:
        return MAV_RESULT.ACCEPTED
    if o.params[2] == 1.0:
        v.say(MAV_SEVERITY.INFO, "Updating barometer calibration")
        v.say(MAV_SEVERITY.INFO, "Barometer calibration complete")
        return MAV_RESULT.ACCEPTED
    if o.x == LEVEL:
        v.say(MAV_SEVERITY.INFO, "Trim OK: roll=0.00 pitch=0.00 yaw=0.00")
        return MAV_RESULT.ACCEPTED
    taken = o.x in (SIMPLE_ACCELEROMETER, FORCE_SAVE) or o.params[1] == FORCE_SAVE
    return MAV_RESULT.ACCEPTED if taken else MAV_RESULT.UNSUPPORTED


def _storage(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if o.params[0] != 2.0 or v.armed:
        return MAV_RESULT.DENIED
    v.params.erase()
    v.say(MAV_SEVERITY.WARNING, "All parameters reset, reboot board")
    return MAV_RESULT.ACCEPTED


def _switch(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    """DO_AUX_FUNCTION: what a switch of a radio would do; of the functions only modes and the fence have an effect."""
    function, position = o.params[:2]
    if not (math.isfinite(function) and math.isfinite(position)) or not SWITCH_LOW <= int(position) <= SWITCH_HIGH:
        return MAV_RESULT.DENIED
    if int(function) == FENCE_SWITCH:
        switch_fence(vehicle.state, 1.0 if int(position) == SWITCH_HIGH else 0.0)
    elif int(function) in SWITCHED_MODES and int(position) == SWITCH_HIGH:
        vehicle.modes.change(SWITCHED_MODES[int(function)])
    return MAV_RESULT.ACCEPTED


# The modes that fly with speeds a client may change, and those that turn the nose by themselves.
CHANGES_SPEED = GUIDED_MODES | {COPTER_MODE.AUTO, COPTER_MODE.RTL, COPTER_MODE.SMART_RTL}
TURNS = frozenset({COPTER_MODE.GUIDED, COPTER_MODE.AUTO, COPTER_MODE.SMART_RTL})
CENTIMETRE = 0.01
# What a takeoff in a pilot's mode climbs at most.
PILOT_TAKEOFF_MAX_M = 10.0
# PREFLIGHT_CALIBRATION, fifth parameter (the last one also the second).
LEVEL, SIMPLE_ACCELEROMETER, FORCE_SAVE = 2, 4, 76

HANDLERS: dict[int, Callable[[Vehicle, Order, Channel], MAV_RESULT]] = {
    MAV_CMD.COMPONENT_ARM_DISARM: _arm_disarm,
    MAV_CMD.NAV_TAKEOFF: _takeoff,
    MAV_CMD.NAV_LAND: _mode_command(COPTER_MODE.LAND),
    MAV_CMD.NAV_RETURN_TO_LAUNCH: _mode_command(COPTER_MODE.RTL),
    MAV_CMD.NAV_LOITER_UNLIM: _mode_command(COPTER_MODE.LOITER),
    MAV_CMD.DO_SET_MODE: _set_mode,
    MAV_CMD.DO_CHANGE_SPEED: _change_speed,
    MAV_CMD.DO_REPOSITION: _reposition,
    MAV_CMD.CONDITION_YAW: _yaw,
    MAV_CMD.DO_SET_ROI: _roi,
    MAV_CMD.DO_SET_ROI_LOCATION: _roi,
    MAV_CMD.DO_SET_ROI_NONE: _roi,
    MAV_CMD.DO_SET_HOME: _set_home,
    MAV_CMD.DO_FENCE_ENABLE: _fence_enable,
    MAV_CMD.MISSION_START: start_mission,
    MAV_CMD.DO_SET_MISSION_CURRENT: choose_item,
    MAV_CMD.DO_JUMP_TAG: jump_to_tag,
    MAV_CMD.DO_PAUSE_CONTINUE: pause,
    MAV_CMD.DO_LAND_START: begin_landing_sequence,
    MAV_CMD.DO_RETURN_PATH_START: begin_return_path,
    MAV_CMD.DO_FLIGHTTERMINATION: _terminate,
    MAV_CMD.PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    MAV_CMD.RUN_PREARM_CHECKS: _prearm,
    MAV_CMD.PREFLIGHT_CALIBRATION: _calibrate,
    MAV_CMD.PREFLIGHT_STORAGE: _storage,
    MAV_CMD.NAV_VTOL_TAKEOFF: _takeoff,
    MAV_CMD.NAV_VTOL_LAND: _mode_command(COPTER_MODE.LAND),
    MAV_CMD.DO_AUX_FUNCTION: _switch,
}
# Commands that ArduPilot takes only with integer coordinates.
INT_ONLY = frozenset({MAV_CMD.DO_REPOSITION})


def handle_command(vehicle: Vehicle, message: Message, channel: Channel) -> None:
    """Carry out a command and acknowledge it."""
    order = read_order(message)
    handler, answer = HANDLERS.get(order.command), ANSWERS.get(order.command)
    if answer is not None:
        result = answer(vehicle.state, order, channel)
    elif handler is None or (order.command in INT_ONLY and not order.integer):
        result = MAV_RESULT.UNSUPPORTED
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
