"""Items of missions, fences and rally points: decoding, validation and storage."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.mavlink_server.coordinates import ALTITUDE_MAX_M, GLOBAL_FRAMES, valid_coordinates

# Commands whose fourth parameter (heading) may be NaN. No other parameter may be NaN.
NAN_HEADINGS = frozenset(
    {
        mavlink.MAV_CMD_NAV_WAYPOINT,
        mavlink.MAV_CMD_NAV_LAND,
        mavlink.MAV_CMD_NAV_TAKEOFF,
        mavlink.MAV_CMD_NAV_VTOL_TAKEOFF,
        mavlink.MAV_CMD_NAV_VTOL_LAND,
    }
)
TAKEOFFS = frozenset({mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_VTOL_TAKEOFF})
LANDINGS = frozenset({mavlink.MAV_CMD_NAV_LAND, mavlink.MAV_CMD_NAV_VTOL_LAND})
# NAV commands whose numbers are not in the range of NAV commands.
LATER_NAV_COMMANDS = frozenset({mavlink.MAV_CMD_NAV_SCRIPT_TIME, mavlink.MAV_CMD_NAV_ATTITUDE_TIME})
FENCE_COMMANDS = frozenset(range(5000, 5005))
SUPPORTED = frozenset(
    {
        mavlink.MAV_CMD_NAV_WAYPOINT,
        mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT,
        mavlink.MAV_CMD_NAV_LOITER_UNLIM,
        mavlink.MAV_CMD_NAV_LOITER_TURNS,
        mavlink.MAV_CMD_NAV_LOITER_TIME,
        mavlink.MAV_CMD_NAV_LOITER_TO_ALT,
        mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH,
        mavlink.MAV_CMD_NAV_LAND,
        mavlink.MAV_CMD_NAV_TAKEOFF,
        mavlink.MAV_CMD_NAV_VTOL_TAKEOFF,
        mavlink.MAV_CMD_NAV_VTOL_LAND,
        mavlink.MAV_CMD_NAV_GUIDED_ENABLE,
        mavlink.MAV_CMD_NAV_DELAY,
        mavlink.MAV_CMD_NAV_PAYLOAD_PLACE,
        mavlink.MAV_CMD_NAV_SCRIPT_TIME,
        mavlink.MAV_CMD_NAV_ATTITUDE_TIME,
        mavlink.MAV_CMD_CONDITION_DELAY,
        mavlink.MAV_CMD_CONDITION_DISTANCE,
        mavlink.MAV_CMD_CONDITION_YAW,
        mavlink.MAV_CMD_DO_JUMP,
        mavlink.MAV_CMD_DO_CHANGE_SPEED,
        mavlink.MAV_CMD_DO_SET_HOME,
        mavlink.MAV_CMD_DO_SET_RELAY,
        mavlink.MAV_CMD_DO_SET_SERVO,
        mavlink.MAV_CMD_DO_REPEAT_RELAY,
        mavlink.MAV_CMD_DO_REPEAT_SERVO,
        mavlink.MAV_CMD_DO_PARACHUTE,
        mavlink.MAV_CMD_DO_GRIPPER,
        mavlink.MAV_CMD_DO_SPRAYER,
        mavlink.MAV_CMD_DO_AUX_FUNCTION,
        mavlink.MAV_CMD_DO_WINCH,
        mavlink.MAV_CMD_DO_DIGICAM_CONFIGURE,
        mavlink.MAV_CMD_DO_GUIDED_LIMITS,
        mavlink.MAV_CMD_DO_SET_REVERSE,
        mavlink.MAV_CMD_DO_SET_RESUME_REPEAT_DIST,
        mavlink.MAV_CMD_DO_ENGINE_CONTROL,
        mavlink.MAV_CMD_DO_LAND_START,
        mavlink.MAV_CMD_DO_SET_ROI_LOCATION,
        mavlink.MAV_CMD_DO_SET_ROI_NONE,
        mavlink.MAV_CMD_DO_SET_ROI,
        mavlink.MAV_CMD_DO_DIGICAM_CONTROL,
        mavlink.MAV_CMD_DO_MOUNT_CONTROL,
        mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST,
        mavlink.MAV_CMD_DO_FENCE_ENABLE,
        mavlink.MAV_CMD_DO_PAUSE_CONTINUE,
        mavlink.MAV_CMD_JUMP_TAG,
        mavlink.MAV_CMD_DO_JUMP_TAG,
        531,
        532,
        1000,
        2000,
        2001,
        2500,
        2501,
    }
)


@dataclass(frozen=True, slots=True)
class Item:
    """One item. `x` and `y` are degrees times 1e7."""

    command: int
    frame: int = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    x: int = 0
    y: int = 0
    z: float = 0.0
    autocontinue: int = 1

    @property
    def has_place(self) -> bool:
        """True if the item has coordinates. 0, 0 means the current position."""
        return self.x != 0 or self.y != 0

    @property
    def navigates(self) -> bool:
        """True for NAV commands. The mission does not continue before a NAV command is complete."""
        return (
            mavlink.MAV_CMD_NAV_WAYPOINT <= self.command < mavlink.MAV_CMD_NAV_LAST
            or self.command in LATER_NAV_COMMANDS
        )


def home_item(lat_e7: int, lon_e7: int, amsl_m: float) -> Item:
    """Return item 0 of every mission: the home position."""
    return Item(mavlink.MAV_CMD_NAV_WAYPOINT, frame=mavlink.MAV_FRAME_GLOBAL, x=lat_e7, y=lon_e7, z=amsl_m)


@dataclass(slots=True)
class ItemStore:
    """List of stored items. `home` is item 0 of an empty mission."""

    kind: int
    items: list[Item] = field(default_factory=list)
    home: Item | None = None


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


# Frames that replace the deprecated *_INT frames and MAV_FRAME_MISSION.
_CURRENT_FRAMES: dict[int, int] = {
    mavlink.MAV_FRAME_GLOBAL_INT: mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT: mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT,
    mavlink.MAV_FRAME_MISSION: mavlink.MAV_FRAME_GLOBAL,
}


# Commands with coordinates. The frame of other commands is not stored.
PLACED = frozenset(
    {
        mavlink.MAV_CMD_NAV_WAYPOINT,
        mavlink.MAV_CMD_NAV_LOITER_UNLIM,
        mavlink.MAV_CMD_NAV_LOITER_TURNS,
        mavlink.MAV_CMD_NAV_LOITER_TIME,
        mavlink.MAV_CMD_NAV_LOITER_TO_ALT,
        mavlink.MAV_CMD_NAV_LAND,
        mavlink.MAV_CMD_NAV_TAKEOFF,
        mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT,
        mavlink.MAV_CMD_NAV_VTOL_TAKEOFF,
        mavlink.MAV_CMD_NAV_VTOL_LAND,
        mavlink.MAV_CMD_NAV_GUIDED_ENABLE,
        mavlink.MAV_CMD_NAV_PAYLOAD_PLACE,
        mavlink.MAV_CMD_DO_SET_HOME,
        mavlink.MAV_CMD_DO_LAND_START,
        mavlink.MAV_CMD_DO_SET_ROI,
        mavlink.MAV_CMD_DO_SET_ROI_LOCATION,
    }
)


Parameters = tuple[float, float, float, float]
_UINT16_MAX = 65535
_INT16_MAX = 32767


def _whole(value: float, low: int = 0, high: int = _UINT16_MAX) -> float:
    """Return a parameter as a whole number within the range of its field in storage."""
    return float(int(min(max(value, low), high)))


def _direction(value: float) -> float:
    return -1.0 if value < 0.0 else 1.0


def _flag(value: float) -> float:
    return 1.0 if value > 0.0 else 0.0


def _no_parameters(_p: Parameters) -> Parameters:
    return (0.0, 0.0, 0.0, 0.0)


def _one_number(p: Parameters) -> Parameters:
    return (_whole(p[0]), 0.0, 0.0, 0.0)


def _land(p: Parameters) -> Parameters:
    """Return the parameters of a landing. Only the sign of its heading is stored."""
    return (_whole(p[0]), 0.0, 0.0, _direction(p[3]))


def _loiter_unlimited(p: Parameters) -> Parameters:
    return (0.0, 0.0, math.copysign(_whole(abs(p[2])), p[2]), 0.0)


def _loiter_turns(p: Parameters) -> Parameters:
    """Return turns in one byte, less than one turn as a fraction of 256, and radii above 255 m in steps of 10 m."""
    turns = int(p[0] * 256.0) / 256.0 if 0.0 < p[0] < 1.0 else _whole(p[0], high=255)
    radius_m = abs(p[2])
    stored_m = _whole(radius_m) if radius_m <= 255.0 else 10.0 * _whole(radius_m * 0.1, high=255)
    return (turns, 0.0, math.copysign(stored_m, p[2]), _flag(p[3]))


def _loiter_time(p: Parameters) -> Parameters:
    return (_whole(p[0]), 0.0, _direction(p[2]), _flag(p[3]))


def _loiter_to_altitude(p: Parameters) -> Parameters:
    return (0.0, math.copysign(_whole(abs(p[1])), p[1]), 0.0, _flag(p[3]))


def _jump(p: Parameters) -> Parameters:
    return (_whole(p[0]), _whole(p[1], -_INT16_MAX, _INT16_MAX), 0.0, 0.0)


def _payload_place(p: Parameters) -> Parameters:
    return (_whole(p[0] * 100.0) / 100.0, 0.0, 0.0, 0.0)


def _engine_control(p: Parameters) -> Parameters:
    return (_flag(p[0]), _flag(p[1]), p[2], 0.0)


# Commands whose parameters are stored in fewer bits than they are sent with. The parameters of other commands are kept.
_STORED: dict[int, Callable[[Parameters], Parameters]] = {
    mavlink.MAV_CMD_NAV_WAYPOINT: _one_number,
    mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT: _one_number,
    mavlink.MAV_CMD_NAV_TAKEOFF: _one_number,
    mavlink.MAV_CMD_NAV_VTOL_TAKEOFF: _no_parameters,
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: _no_parameters,
    mavlink.MAV_CMD_NAV_LAND: _land,
    mavlink.MAV_CMD_NAV_VTOL_LAND: _one_number,
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: _loiter_unlimited,
    mavlink.MAV_CMD_NAV_LOITER_TURNS: _loiter_turns,
    mavlink.MAV_CMD_NAV_LOITER_TIME: _loiter_time,
    mavlink.MAV_CMD_NAV_LOITER_TO_ALT: _loiter_to_altitude,
    mavlink.MAV_CMD_NAV_GUIDED_ENABLE: _one_number,
    mavlink.MAV_CMD_NAV_PAYLOAD_PLACE: _payload_place,
    mavlink.MAV_CMD_DO_JUMP: _jump,
    mavlink.MAV_CMD_DO_JUMP_TAG: _jump,
    mavlink.MAV_CMD_JUMP_TAG: _one_number,
    mavlink.MAV_CMD_DO_SET_REVERSE: _one_number,
    mavlink.MAV_CMD_DO_SET_RESUME_REPEAT_DIST: _one_number,
    mavlink.MAV_CMD_DO_ENGINE_CONTROL: _engine_control,
}


def _parameters(message: Message, command: int) -> Parameters:
    """Return the four parameters as ArduPilot stores them."""
    sent = (
        _finite(message.real("param1")),
        _finite(message.real("param2")),
        _finite(message.real("param3")),
        _finite(message.real("param4")),
    )
    stored = _STORED.get(command)
    return sent if stored is None else stored(sent)


def _centimetres(altitude_m: float) -> float:
    """Return an altitude as stored: whole centimetres, computed with 32-bit floating-point numbers."""
    if not abs(altitude_m) < ALTITUDE_MAX_M:
        return altitude_m  # refused by `validate_item`
    scaled: float = struct.unpack("<f", struct.pack("<f", altitude_m * 100.0))[0]
    return int(scaled) / 100.0


def item_from(message: Message) -> Item:
    """Decode MISSION_ITEM_INT, or MISSION_ITEM with coordinates in floating-point degrees."""
    frame = message.integer("frame")
    x = message.real("x")
    y = message.real("y")
    scale = 1e7 if frame in GLOBAL_FRAMES else 1e4
    if message.name == "MISSION_ITEM":
        x = x * scale if math.isfinite(x) else 0.0
        y = y * scale if math.isfinite(y) else 0.0
    command = message.integer("command")
    z = message.real("z")
    param1, param2, param3, param4 = _parameters(message, command)
    return Item(
        command=command,
        frame=_CURRENT_FRAMES.get(frame, frame)
        if command in PLACED or command in FENCE_COMMANDS or command == mavlink.MAV_CMD_NAV_RALLY_POINT
        else mavlink.MAV_FRAME_GLOBAL,
        param1=param1,
        param2=param2,
        param3=param3,
        param4=param4,
        x=int(max(-2147483648, min(2147483647, round(x)))),
        y=int(max(-2147483648, min(2147483647, round(y)))),
        z=_centimetres(z) if command in PLACED or command == mavlink.MAV_CMD_NAV_RALLY_POINT else _finite(z),
        autocontinue=message.integer("autocontinue"),
    )


def validate_item(item: Item, kind: int) -> int:
    """Return MAV_MISSION_ACCEPTED if the item may be stored in a list of this kind, or the MAV_MISSION_RESULT error."""
    if kind == mavlink.MAV_MISSION_TYPE_FENCE:
        known = item.command in FENCE_COMMANDS
    elif kind == mavlink.MAV_MISSION_TYPE_RALLY:
        known = item.command == mavlink.MAV_CMD_NAV_RALLY_POINT
    else:
        known = item.command in SUPPORTED
    if not known:
        return mavlink.MAV_MISSION_UNSUPPORTED
    if kind == mavlink.MAV_MISSION_TYPE_MISSION and item.command not in PLACED:
        return mavlink.MAV_MISSION_ACCEPTED
    if kind != mavlink.MAV_MISSION_TYPE_FENCE:  # a fence is validated as a whole
        if not valid_coordinates(item.x, item.y):
            beyond = abs(item.x) > 900_000_000
            return mavlink.MAV_MISSION_INVALID_PARAM5_X if beyond else mavlink.MAV_MISSION_INVALID_PARAM6_Y
        if not abs(item.z) < ALTITUDE_MAX_M:
            return mavlink.MAV_MISSION_INVALID_PARAM7
    return mavlink.MAV_MISSION_ACCEPTED if item.frame in GLOBAL_FRAMES else mavlink.MAV_MISSION_UNSUPPORTED_FRAME


def validate_parameters(message: Message) -> int:
    """Return MAV_MISSION_ACCEPTED if all parameters are finite, or the error of the first invalid one."""
    may_be_nan = message.integer("command") in NAN_HEADINGS
    for at in range(1, 5):
        value = message.real(f"param{at}")
        if not math.isfinite(value) and not (at == 4 and may_be_nan and math.isnan(value)):
            return mavlink.MAV_MISSION_INVALID_PARAM1 + at - 1
    return mavlink.MAV_MISSION_ACCEPTED
