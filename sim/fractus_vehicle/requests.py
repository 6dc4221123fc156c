"""Handlers of commands that only read data, set rates or address absent devices."""

from __future__ import annotations

import math
from collections.abc import Callable

from fractus_services.mavlink_server.channel import Channel
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.accessories import (
    ABSENT_DEVICE,
    WITHOUT_EFFECT,
    point_gimbal,
    repeat_relay,
    reset_battery,
    set_relay,
    set_servo,
    start_motor_test,
)
from fractus_vehicle.copter import VERSION_TEXT
from fractus_vehicle.orders import Command
from fractus_vehicle.state import VehicleState
from fractus_vehicle.streams import BUILDERS, SILENT
from fractus_vehicle.telemetry import send

RequestHandler = Callable[[VehicleState, Command, Channel], int]

# Maximum message rate as a share of the main loop rate.
MAX_LOOP_SHARE = 0.8
# Intervals are stored in whole milliseconds. Intervals below one control step have no effect.
MIN_INTERVAL_MS = 10
MAX_INTERVAL_MS = 60_000
EKF_SOURCE_SETS = 3
FRAMES = {0: "PLUS", 1: "X"}


def _get_home(v: VehicleState, _o: Command, c: Channel) -> int:
    if v.home is None:
        return mavlink.MAV_RESULT_FAILED
    send(v, c, "HOME_POSITION")
    send(v, c, "GPS_GLOBAL_ORIGIN")
    return mavlink.MAV_RESULT_ACCEPTED


def _message_name(number: float) -> str | None:
    if not math.isfinite(number) or number < 0.0:
        return None
    message = mavlink.mavlink_map.get(int(number))
    if message is None or (message.msgname not in BUILDERS and message.msgname not in SILENT):
        return None
    return message.msgname


def _named(v: VehicleState, number: float) -> str | None:
    """Return the name of a message id. Report an unknown id in a STATUSTEXT."""
    name = _message_name(number)
    if name is None and math.isfinite(number):
        v.send_text(mavlink.MAV_SEVERITY_INFO, f"No ap_message for mavlink id ({int(number)})")
    return name


def _set_interval(v: VehicleState, o: Command, c: Channel) -> int:
    interval_us = o.params[1]
    name = _named(v, o.params[0])
    # ArduPilot SITL aborts if the interval is NaN.
    if name is None or not math.isfinite(interval_us) or interval_us < -1.0:
        return mavlink.MAV_RESULT_DENIED
    if interval_us < 0.0:
        c.set_interval(name, None)
    elif interval_us == 0.0:
        c.reset_interval(name)
    elif interval_us < 1e6 / (MAX_LOOP_SHARE * max(v.params["SCHED_LOOP_RATE"], 1.0)):
        text = f"Requested rate for message ID {int(o.params[0])} too fast. Increase SCHED_LOOP_RATE"
        v.send_text(mavlink.MAV_SEVERITY_INFO, text)
        return mavlink.MAV_RESULT_DENIED
    else:
        c.set_interval(name, min(max(int(interval_us) // 1000, MIN_INTERVAL_MS), MAX_INTERVAL_MS) / 1e3)
    return mavlink.MAV_RESULT_ACCEPTED


def _get_interval(_v: VehicleState, o: Command, c: Channel) -> int:
    name = _message_name(o.params[0])
    stream = c.streams.get(name) if name is not None else None
    interval_us = 0  # MAVLink: not available
    if name is not None:
        interval_us = -1 if stream is None else round(stream.interval_s * 1e6)  # -1: disabled
    number = int(o.params[0]) & 0xFFFF if math.isfinite(o.params[0]) else 0
    c.send("MESSAGE_INTERVAL", {"message_id": number, "interval_us": interval_us})
    return mavlink.MAV_RESULT_ACCEPTED if name is not None else mavlink.MAV_RESULT_FAILED


def _request_message(v: VehicleState, o: Command, c: Channel) -> int:
    name = _message_name(o.params[0])
    if name is None:
        return mavlink.MAV_RESULT_FAILED
    send(v, c, name)  # the command is accepted even if the message cannot be sent for lack of data
    return mavlink.MAV_RESULT_ACCEPTED


def _capabilities(v: VehicleState, o: Command, c: Channel) -> int:
    if o.params[0] != 1.0:
        return mavlink.MAV_RESULT_FAILED
    send(v, c, "AUTOPILOT_VERSION")
    return mavlink.MAV_RESULT_ACCEPTED


def _banner(v: VehicleState, _o: Command, _c: Channel) -> int:
    for text in (VERSION_TEXT, f"Frame: QUAD/{FRAMES.get(int(v.params['FRAME_TYPE']), 'UNSUPPORTED')}"):
        v.send_text(mavlink.MAV_SEVERITY_INFO, text)
    return mavlink.MAV_RESULT_ACCEPTED


def _high_latency(v: VehicleState, o: Command, _c: Channel) -> int:
    if o.params[0] not in (0.0, 1.0):
        return mavlink.MAV_RESULT_DENIED
    v.send_text(mavlink.MAV_SEVERITY_NOTICE, f"High Latency {'enabled' if o.params[0] else 'disabled'}")
    return mavlink.MAV_RESULT_ACCEPTED


def _parachute(_v: VehicleState, o: Command, _c: Channel) -> int:
    """Accept the defined parachute actions. They have no effect."""
    return mavlink.MAV_RESULT_ACCEPTED if o.params[0] in (0.0, 1.0, 2.0) else mavlink.MAV_RESULT_FAILED


def _ekf_sources(_v: VehicleState, o: Command, _c: Channel) -> int:
    """Accept a defined source set. All sets are equivalent."""
    return mavlink.MAV_RESULT_ACCEPTED if 1.0 <= o.params[0] < EKF_SOURCE_SETS + 1 else mavlink.MAV_RESULT_DENIED


def _always(result: int) -> RequestHandler:
    return lambda _v, _order, _channel: result


REQUEST_HANDLERS: dict[int, RequestHandler] = {
    mavlink.MAV_CMD_GET_HOME_POSITION: _get_home,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    mavlink.MAV_CMD_REQUEST_MESSAGE: _request_message,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _capabilities,
    mavlink.MAV_CMD_DO_SEND_BANNER: _banner,
    mavlink.MAV_CMD_DO_PARACHUTE: _parachute,
    mavlink.MAV_CMD_CONTROL_HIGH_LATENCY: _high_latency,
    mavlink.MAV_CMD_SET_EKF_SOURCE_SET: _ekf_sources,
    mavlink.MAV_CMD_DEBUG_TRAP: _always(mavlink.MAV_RESULT_DENIED),
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW: lambda v, o, _c: point_gimbal(v, *o.params[:2], o.x),
    mavlink.MAV_CMD_DO_SET_SERVO: lambda v, o, _c: set_servo(v, *o.params[:2]),
    mavlink.MAV_CMD_DO_REPEAT_SERVO: lambda v, o, _c: set_servo(v, *o.params[:2]),
    mavlink.MAV_CMD_DO_SET_RELAY: lambda v, o, _c: set_relay(v, *o.params[:2]),
    mavlink.MAV_CMD_DO_REPEAT_RELAY: lambda v, o, _c: repeat_relay(v, o.params[0]),
    mavlink.MAV_CMD_DO_MOTOR_TEST: lambda v, o, _c: start_motor_test(v, o.params[0], o.params[3]),
    mavlink.MAV_CMD_BATTERY_RESET: lambda v, o, _c: reset_battery(v, *o.params[:2]),
    **dict.fromkeys(ABSENT_DEVICE, _always(mavlink.MAV_RESULT_FAILED)),
    **dict.fromkeys(WITHOUT_EFFECT, _always(mavlink.MAV_RESULT_ACCEPTED)),
}
