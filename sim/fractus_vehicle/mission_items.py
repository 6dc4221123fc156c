"""Items of missions, fences and rally points: read from messages, judged, and kept in lists."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from fractus_mavlink import Message

from fractus_vehicle.earth import ALTITUDE_MAX_M, Place, valid_coordinates
from fractus_vehicle.mav import GLOBAL_FRAMES, Command, Frame, MissionKind, MissionResult

# Commands whose fourth parameter, a heading, may be NaN; no other parameter may.
NAN_HEADINGS = frozenset({Command.NAV_WAYPOINT, Command.NAV_LAND, Command.NAV_TAKEOFF})
FENCE_COMMANDS = frozenset(range(5000, 5005))
SUPPORTED = frozenset(
    {
        Command.NAV_WAYPOINT,
        Command.NAV_SPLINE_WAYPOINT,
        Command.NAV_LOITER_UNLIM,
        Command.NAV_LOITER_TURNS,
        Command.NAV_LOITER_TIME,
        Command.NAV_RETURN_TO_LAUNCH,
        Command.NAV_LAND,
        Command.NAV_TAKEOFF,
        Command.NAV_DELAY,
        Command.CONDITION_DELAY,
        Command.CONDITION_DISTANCE,
        Command.CONDITION_YAW,
        Command.DO_JUMP,
        Command.DO_CHANGE_SPEED,
        Command.DO_SET_HOME,
        Command.DO_SET_RELAY,
        Command.DO_SET_SERVO,
        Command.DO_LAND_START,
        Command.DO_SET_ROI_LOCATION,
        Command.DO_SET_ROI_NONE,
        Command.DO_SET_ROI,
        Command.DO_DIGICAM_CONTROL,
        Command.DO_MOUNT_CONTROL,
        Command.DO_SET_CAM_TRIGG_DIST,
        Command.DO_FENCE_ENABLE,
        Command.DO_PAUSE_CONTINUE,
        Command.JUMP_TAG,
        Command.DO_JUMP_TAG,
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
    """One item of a list; x and y are degrees times 1e7."""

    command: int
    frame: int = Frame.GLOBAL_RELATIVE_ALT
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
        """Whether the item names a position (0, 0 means: here)."""
        return self.x != 0 or self.y != 0

    @property
    def navigates(self) -> bool:
        """Whether this is a NAV command: one with a position, which a mission waits for."""
        return 0 < self.command < 95 or self.command >= Command.NAV_FENCE_RETURN_POINT


def home_item(home: Place) -> Item:
    """Item 0 of every mission: home, as ArduPilot keeps it."""
    return Item(Command.NAV_WAYPOINT, frame=Frame.GLOBAL, x=home.lat_e7, y=home.lon_e7, z=home.alt_m)


@dataclass(slots=True)
class ItemStore:
    """One list; `home` stands for item 0 while a mission is empty."""

    kind: MissionKind
    items: list[Item] = field(default_factory=list)
    home: Item | None = None


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def item_from(message: Message) -> Item:
    """Read MISSION_ITEM_INT, or MISSION_ITEM with its degrees in floats."""
    frame = message.integer("frame")
    x, y = message.real("x"), message.real("y")
    scale = 1e7 if frame in GLOBAL_FRAMES else 1e4
    if message.name == "MISSION_ITEM":
        x, y = (x * scale if math.isfinite(x) else 0.0), (y * scale if math.isfinite(y) else 0.0)
    aliases = {Frame.GLOBAL_INT: 0, Frame.GLOBAL_RELATIVE_ALT_INT: 3, Frame.GLOBAL_TERRAIN_ALT_INT: 10}
    command, z = message.integer("command"), message.real("z")
    return Item(
        command=command,
        frame=int(aliases.get(Frame(frame), frame)) if frame in set(Frame) else frame,
        param1=_finite(message.real("param1")),
        param2=_finite(message.real("param2")),
        param3=_finite(message.real("param3")),
        param4=_finite(message.real("param4")),
        x=int(max(-2147483648, min(2147483647, round(x)))),
        y=int(max(-2147483648, min(2147483647, round(y)))),
        z=z if Item(command).navigates else _finite(z),
        autocontinue=message.integer("autocontinue"),
    )


def judge(item: Item, kind: MissionKind) -> MissionResult:
    """Whether an item may be stored in a list of that kind."""
    if kind is MissionKind.FENCE:
        known = item.command in FENCE_COMMANDS
    elif kind is MissionKind.RALLY:
        known = item.command == Command.NAV_RALLY_POINT
    else:
        known = item.command in SUPPORTED
    if not known:
        return MissionResult.UNSUPPORTED
    if item.frame not in GLOBAL_FRAMES and item.frame != Frame.MISSION and item.has_place:
        return MissionResult.UNSUPPORTED_FRAME
    if item.navigates and not valid_coordinates(item.x, item.y):
        return MissionResult.INVALID_PARAM5_X if abs(item.x) > 900_000_000 else MissionResult.INVALID_PARAM6_Y
    if item.navigates and not abs(item.z) < ALTITUDE_MAX_M:
        return MissionResult.INVALID_PARAM7
    return MissionResult.ACCEPTED


def judge_numbers(message: Message) -> MissionResult:
    """Whether the parameters of a mission's item are numbers, as ArduPilot wants them."""
    may_be_nan = message.integer("command") in NAN_HEADINGS
    for at in range(1, 5):
        value = message.real(f"param{at}")
        if not math.isfinite(value) and not (at == 4 and may_be_nan and math.isnan(value)):
            return MissionResult(MissionResult.INVALID_PARAM1 + at - 1)
    return MissionResult.ACCEPTED
