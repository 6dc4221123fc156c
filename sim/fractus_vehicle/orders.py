"""COMMAND_LONG and COMMAND_INT as one thing: a command with its numbers and, maybe, a position."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fractus_mavlink import Message
from fractus_mavlink.enums import MAV_CMD, MAV_FRAME

from fractus_vehicle.mission_items import Item


@dataclass(frozen=True, slots=True)
class Order:
    """A command from either message, with its position as degrees times 1e7."""

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
        """The order's position as a mission item, for frame arithmetic."""
        return Item(command=self.command, frame=self.frame, x=self.x, y=self.y, z=self.z)


def read_order(message: Message) -> Order:
    """Read COMMAND_LONG or COMMAND_INT."""
    numbers = (
        message.real("param1"),
        message.real("param2"),
        message.real("param3"),
        message.real("param4"),
    )
    command = message.integer("command")
    if message.name == "COMMAND_INT":
        x, y, z = message.integer("x"), message.integer("y"), message.real("z")
        frame = message.integer("frame")
        return Order(command, numbers, x, y, z, frame, x != 0 or y != 0, integer=True)
    lat, lon, z = message.real("param5"), message.real("param6"), message.real("param7")
    known = math.isfinite(lat) and math.isfinite(lon) and (lat != 0.0 or lon != 0.0)
    known = known and abs(lat) <= 90.0 and abs(lon) <= 180.0
    x, y = (round(lat * 1e7), round(lon * 1e7)) if known else (0, 0)
    absolute = command in (MAV_CMD.DO_SET_HOME,)
    frame = MAV_FRAME.GLOBAL if absolute else MAV_FRAME.GLOBAL_RELATIVE_ALT
    return Order(command, numbers, x, y, z, frame, known, integer=False)
