"""Common form of COMMAND_LONG and COMMAND_INT."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fractus_runtime.mavlink_codec import Message
from fractus_services.mavlink_server.mission_items import Item
from pymavlink.dialects.v20 import ardupilotmega as mavlink

# Commands whose fifth and sixth parameters are degrees. In other commands these parameters are plain integers.
PLACED = frozenset(
    {
        mavlink.MAV_CMD_DO_SET_HOME,
        mavlink.MAV_CMD_DO_SET_ROI,
        mavlink.MAV_CMD_DO_SET_ROI_LOCATION,
        mavlink.MAV_CMD_DO_REPOSITION,
    }
)
_INT32_MAX = 2147483647


@dataclass(frozen=True, slots=True)
class Command:
    """A command from either message.

    `x` and `y` are degrees times 1e7, or plain integers for commands without coordinates.
    """

    command: int
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float
    frame: int
    has_place: bool
    integer: bool

    @property
    def item(self) -> Item:
        """The position of the command as a mission item, for frame conversion."""
        return Item(command=self.command, frame=self.frame, x=self.x, y=self.y, z=self.z)


def read_command(message: Message) -> Command:
    """Decode COMMAND_LONG or COMMAND_INT."""
    numbers = (
        message.real("param1"),
        message.real("param2"),
        message.real("param3"),
        message.real("param4"),
    )
    command = message.integer("command")
    if message.name == "COMMAND_INT":
        x = message.integer("x")
        y = message.integer("y")
        z = message.real("z")
        frame = message.integer("frame")
        return Command(command, numbers, x, y, z, frame, x != 0 or y != 0, integer=True)
    scale = 1e7 if command in PLACED else 1.0
    x = _integer(message.real("param5") * scale)
    y = _integer(message.real("param6") * scale)
    frame = (
        mavlink.MAV_FRAME_GLOBAL if command == mavlink.MAV_CMD_DO_SET_HOME else mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
    )
    return Command(command, numbers, x, y, message.real("param7"), frame, x != 0 or y != 0, integer=False)


def _integer(value: float) -> int:
    """Return the nearest 32-bit integer, 0 for NaN."""
    return round(max(min(value, _INT32_MAX), -_INT32_MAX)) if not math.isnan(value) else 0
