"""Converts MAVLink messages of the autopilot to records."""

from __future__ import annotations

import math
from collections.abc import Iterable

from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.recording.messages import DEBUG, ERROR, FATAL, INFO, WARNING, Record, attitude, location, text

_LEVELS = (FATAL, FATAL, FATAL, ERROR, WARNING, INFO, INFO, DEBUG)
"""Levels of foxglove.Log by MAV_SEVERITY."""


def to_records(message: Message, time_ns: int, node: str) -> Iterable[Record]:
    """Yield the position, attitude or text of a message. Other messages are in the tlog only."""
    match message.name:
        case "GLOBAL_POSITION_INT":
            lat = message.integer("lat") / 1e7
            lon = message.integer("lon") / 1e7
            if lat or lon:
                yield location(time_ns, node, lat, lon, message.integer("alt") / 1000)
        case "ATTITUDE":
            angles = [message.real(axis) for axis in ("roll", "pitch", "yaw")]
            if all(map(math.isfinite, angles)):
                yield attitude(time_ns, *(round(angle, 5) for angle in angles))
        case "STATUSTEXT":
            level = _LEVELS[min(message.integer("severity"), len(_LEVELS) - 1)]
            yield text(time_ns, "log", node, level, message.text("text"))


def is_armed(message: Message) -> bool | None:
    """Return True if an autopilot's HEARTBEAT reports armed motors, and None for all other messages."""
    if message.name != "HEARTBEAT" or message.integer("autopilot") == mavlink.MAV_AUTOPILOT_INVALID:
        return None
    return bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
