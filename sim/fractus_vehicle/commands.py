"""Answers to COMMAND_LONG and COMMAND_INT: what is allowed when, and the result that goes back."""

from __future__ import annotations

import math
from collections.abc import Callable

from fractus_mavlink import Message, layout_of
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

from fractus_vehicle.auto import AutoFlight
from fractus_vehicle.channel import Channel
from fractus_vehicle.copter import (
    ABSOLUTE_FRAMES,
    FORCE_ARM_MAGIC,
    FORCE_MAGIC,
    GLOBAL_FRAMES,
    SUPPORTED_MODES,
    VERSION_TEXT,
    mode_title,
)
from fractus_vehicle.earth import valid_coordinates
from fractus_vehicle.guided import GuidedFlight
from fractus_vehicle.home import set_home_at, set_home_here
from fractus_vehicle.mission_commands import item_target, switch_fence
from fractus_vehicle.mission_items import Item
from fractus_vehicle.orders import Order, read_order
from fractus_vehicle.readiness import arming_refusal
from fractus_vehicle.streams import BUILDERS
from fractus_vehicle.telemetry import send
from fractus_vehicle.vehicle import Vehicle

NOT_ARMABLE = frozenset({COPTER_MODE.RTL, COPTER_MODE.SMART_RTL, COPTER_MODE.LAND, COPTER_MODE.BRAKE, COPTER_MODE.AUTO})


def _arm_disarm(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    want, magic = o.params[0], o.params[1]
    if want == 1.0:
        if v.armed:
            return MAV_RESULT.ACCEPTED
        if magic != FORCE_ARM_MAGIC:
            refusal = f"{mode_title(v.mode)} mode not armable" if v.mode in NOT_ARMABLE else arming_refusal(v)
            if refusal is not None:
                v.say(MAV_SEVERITY.CRITICAL, f"Arm: {refusal}")
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
    if not v.armed or not v.landed or v.flying_wanted or not math.isfinite(o.z):
        return MAV_RESULT.FAILED
    if isinstance(vehicle.modes.flight, AutoFlight) or v.mode not in (
        COPTER_MODE.GUIDED,
        COPTER_MODE.LOITER,
        COPTER_MODE.ALT_HOLD,
    ):
        return MAV_RESULT.FAILED
    if o.integer and o.frame not in (MAV_FRAME.GLOBAL_RELATIVE_ALT, MAV_FRAME.GLOBAL_RELATIVE_ALT_INT):
        return MAV_RESULT.DENIED
    if o.z <= 0.0:
        return MAV_RESULT.FAILED
    origin = v.origin or v.start
    home = v.home or origin
    down = min(origin.alt_m - home.alt_m - o.z, v.est.down - 0.1)
    if isinstance(vehicle.modes.flight, GuidedFlight):
        vehicle.modes.flight.take_off(v, down)
    else:
        v.begin_takeoff(down)
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
    if custom_mode not in SUPPORTED_MODES:
        v.say(MAV_SEVERITY.WARNING, f"No such mode {custom_mode}")
        return MAV_RESULT.FAILED
    return MAV_RESULT.ACCEPTED if vehicle.modes.change(COPTER_MODE(custom_mode)) else MAV_RESULT.FAILED


def _set_mode(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    if not all(math.isfinite(value) for value in o.params[:2]):
        return MAV_RESULT.DENIED
    return set_mode_number(vehicle, int(o.params[0]), int(o.params[1]))


def _change_speed(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if not math.isfinite(o.params[0]):
        return MAV_RESULT.DENIED
    return MAV_RESULT.ACCEPTED if v.control.limits.change_speed(int(o.params[0]), o.params[1]) else MAV_RESULT.FAILED


def _reposition(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    switch = bool(int(o.params[1]) & MAV_DO_REPOSITION_FLAGS.CHANGE_MODE) if math.isfinite(o.params[1]) else False
    if not v.armed or (v.mode is not COPTER_MODE.GUIDED and not switch):
        return MAV_RESULT.DENIED
    placed = o.has_place and valid_coordinates(o.x, o.y) and math.isfinite(o.z)
    if not placed or v.altitude_base_m(o.frame) is None:
        return MAV_RESULT.DENIED
    north, east, down = item_target(v, o.item)
    if v.landed or v.outside_fence(north, east, down) or not vehicle.modes.change(COPTER_MODE.GUIDED):
        return MAV_RESULT.FAILED
    flight = vehicle.modes.flight
    if not isinstance(flight, GuidedFlight):
        return MAV_RESULT.FAILED
    flight.go_to(v, north, east, down)
    if math.isfinite(o.params[3]) and o.params[3] != 0.0:
        v.heading.turn_to(o.params[3] % 360.0, 0.0, 0, relative=False)
    else:
        v.heading.follow_course()
    return MAV_RESULT.ACCEPTED


def _yaw(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    angle, rate, direction, relative = o.params
    if v.mode not in (COPTER_MODE.GUIDED, COPTER_MODE.AUTO) or not all(math.isfinite(p) for p in o.params):
        return MAV_RESULT.FAILED
    turned = v.heading.turn_to(angle, rate, int(direction), relative=relative > 0.5)
    return MAV_RESULT.ACCEPTED if turned else MAV_RESULT.FAILED


def _roi(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if o.command == MAV_CMD.DO_SET_ROI_NONE or not o.has_place:
        v.heading.look_at(None)
        return MAV_RESULT.ACCEPTED
    if not valid_coordinates(o.x, o.y) or o.frame not in GLOBAL_FRAMES:
        return MAV_RESULT.FAILED
    north, east, _ = item_target(v, Item(command=o.command, frame=o.frame, x=o.x, y=o.y))
    v.heading.look_at((north, east))
    return MAV_RESULT.ACCEPTED


def _set_home(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if o.params[0] == 1.0:
        return MAV_RESULT.ACCEPTED if set_home_here(v) else MAV_RESULT.FAILED
    if not o.has_place or not math.isfinite(o.z):
        return MAV_RESULT.DENIED
    if o.frame not in GLOBAL_FRAMES:
        return MAV_RESULT.COMMAND_UNSUPPORTED_MAV_FRAME
    altitude = o.z
    if o.frame not in ABSOLUTE_FRAMES:
        altitude += (v.home or v.start).alt_m
    return MAV_RESULT.ACCEPTED if set_home_at(v, o.x, o.y, altitude) else MAV_RESULT.FAILED


def _get_home(vehicle: Vehicle, _o: Order, c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if not send(v, c, "HOME_POSITION"):
        return MAV_RESULT.FAILED
    send(v, c, "GPS_GLOBAL_ORIGIN")
    return MAV_RESULT.ACCEPTED


def _message_name(number: float) -> str | None:
    layout = layout_of(int(number)) if math.isfinite(number) and number >= 0.0 else None
    return layout.name if layout is not None and layout.name in BUILDERS else None


def _set_interval(vehicle: Vehicle, o: Order, c: Channel) -> MAV_RESULT:
    name, interval_us = _message_name(o.params[0]), o.params[1]
    if name is None or not math.isfinite(interval_us):
        return MAV_RESULT.DENIED
    if interval_us < 0.0:
        c.set_interval(name, None)
    elif interval_us == 0.0:
        c.set_interval(name, 1.0 if name == "HEARTBEAT" else None)
    else:
        c.set_interval(name, max(interval_us, 10_000.0) / 1e6)
    return MAV_RESULT.ACCEPTED


def _get_interval(_vehicle: Vehicle, o: Order, c: Channel) -> MAV_RESULT:
    name = _message_name(o.params[0])
    stream = c.streams.get(name) if name is not None else None
    interval = 0 if name is None else -1 if stream is None else round(stream.interval_s * 1e6)
    number = o.params[0]
    if not math.isfinite(number) or not 0 <= number <= 65535:
        return MAV_RESULT.DENIED
    c.send("MESSAGE_INTERVAL", {"message_id": int(number), "interval_us": interval})
    return MAV_RESULT.ACCEPTED if name is not None else MAV_RESULT.FAILED


def _request_message(vehicle: Vehicle, o: Order, c: Channel) -> MAV_RESULT:
    v = vehicle.state
    name = _message_name(o.params[0])
    if name is None:
        return MAV_RESULT.FAILED
    return MAV_RESULT.ACCEPTED if send(v, c, name) else MAV_RESULT.FAILED


def _capabilities(vehicle: Vehicle, o: Order, c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if o.params[0] != 1.0:
        return MAV_RESULT.FAILED
    send(v, c, "AUTOPILOT_VERSION")
    return MAV_RESULT.ACCEPTED


def _fence_enable(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    return MAV_RESULT.ACCEPTED if switch_fence(v, o.params[0]) else MAV_RESULT.FAILED


def _mission_start(vehicle: Vehicle, _o: Order, _c: Channel) -> MAV_RESULT:
    return MAV_RESULT.ACCEPTED if vehicle.modes.change(COPTER_MODE.AUTO) else MAV_RESULT.FAILED


def _mission_current(vehicle: Vehicle, o: Order, c: Channel) -> MAV_RESULT:
    v = vehicle.state
    if not math.isfinite(o.params[0]):
        return MAV_RESULT.DENIED
    if not set_current(vehicle, int(o.params[0])):
        return MAV_RESULT.FAILED
    send(v, c, "MISSION_CURRENT")
    return MAV_RESULT.ACCEPTED


def _jump_to_tag(vehicle: Vehicle, o: Order, c: Channel) -> MAV_RESULT:
    v = vehicle.state
    tag = o.params[0]
    index = v.mission.tagged(int(tag)) if math.isfinite(tag) else None
    if index is None or not set_current(vehicle, index):
        return MAV_RESULT.FAILED
    send(v, c, "MISSION_CURRENT")
    return MAV_RESULT.ACCEPTED


def set_current(vehicle: Vehicle, index: int) -> bool:
    """Make an item the current one; AUTO continues there."""
    v = vehicle.state
    if not 0 <= index < len(v.mission.items):
        return False
    if isinstance(vehicle.modes.flight, AutoFlight) and v.armed:
        vehicle.modes.flight.jump_to(v, max(index, 1))
    else:
        v.mission.current = index
        v.mission.complete = False
    return True


def _pause(vehicle: Vehicle, o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    flight = vehicle.modes.flight
    if not isinstance(flight, (AutoFlight, GuidedFlight)) or o.params[0] not in (0.0, 1.0):
        return MAV_RESULT.DENIED
    flight.pause(v, paused=o.params[0] == 0.0)
    return MAV_RESULT.ACCEPTED


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
    refusal = arming_refusal(v)
    if refusal is not None:
        v.say(MAV_SEVERITY.CRITICAL, f"PreArm: {refusal}")
    return MAV_RESULT.ACCEPTED


def _banner(vehicle: Vehicle, _o: Order, _c: Channel) -> MAV_RESULT:
    for text in (VERSION_TEXT, "Frame: QUAD/X"):
        vehicle.state.say(MAV_SEVERITY.INFO, text)
    return MAV_RESULT.ACCEPTED


def _grounded_only(vehicle: Vehicle, _o: Order, _c: Channel) -> MAV_RESULT:
    v = vehicle.state
    return MAV_RESULT.FAILED if v.armed else MAV_RESULT.ACCEPTED


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
    MAV_CMD.GET_HOME_POSITION: _get_home,
    MAV_CMD.SET_MESSAGE_INTERVAL: _set_interval,
    MAV_CMD.GET_MESSAGE_INTERVAL: _get_interval,
    MAV_CMD.REQUEST_MESSAGE: _request_message,
    MAV_CMD.REQUEST_AUTOPILOT_CAPABILITIES: _capabilities,
    MAV_CMD.DO_FENCE_ENABLE: _fence_enable,
    MAV_CMD.MISSION_START: _mission_start,
    MAV_CMD.DO_SET_MISSION_CURRENT: _mission_current,
    MAV_CMD.DO_JUMP_TAG: _jump_to_tag,
    MAV_CMD.DO_PAUSE_CONTINUE: _pause,
    MAV_CMD.DO_FLIGHTTERMINATION: _terminate,
    MAV_CMD.PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    MAV_CMD.RUN_PREARM_CHECKS: _prearm,
    MAV_CMD.DO_SEND_BANNER: _banner,
    MAV_CMD.PREFLIGHT_CALIBRATION: _grounded_only,
    MAV_CMD.PREFLIGHT_STORAGE: _grounded_only,
}
# Commands that ArduPilot takes only with integer coordinates.
INT_ONLY = frozenset({MAV_CMD.DO_REPOSITION})


def handle_command(vehicle: Vehicle, message: Message, channel: Channel) -> None:
    """Carry out a command and acknowledge it."""
    order = read_order(message)
    handler = HANDLERS.get(order.command)
    if handler is None:
        result = MAV_RESULT.UNSUPPORTED
    elif order.command in INT_ONLY and not order.integer:
        result = MAV_RESULT.COMMAND_INT_ONLY
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
