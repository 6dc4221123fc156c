"""Decodes the MAVLink stream of the autopilot for the recorder."""

from __future__ import annotations

import math
from collections.abc import Iterable

from fractus_runtime.mavlink_codec import Message, Parser
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.recording.messages import DEBUG, ERROR, FATAL, INFO, WARNING, Record, attitude, location, text
from fractus_services.recording.recorder import AutopilotFrame

_LEVELS = (FATAL, FATAL, FATAL, ERROR, WARNING, INFO, INFO, DEBUG)
"""Levels of foxglove.Log by MAV_SEVERITY."""


class MavlinkDecoder:
    """`AutopilotDecoder` of a MAVLink link.

    Args:
        node: Name of the node, which is the first part of each topic.
    """

    def __init__(self, node: str) -> None:
        self._node = node
        self._unknown: list[bytes] = []
        self._parser = Parser(unknown=self._unknown.append)

    def decode(self, data: bytes, time_ns: int) -> list[AutopilotFrame]:
        """See `AutopilotDecoder`. Frames of unknown messages are included, because a ground station may know them."""
        messages = self._parser.feed(data)
        frames = [AutopilotFrame(frame) for frame in self._unknown]
        self._unknown.clear()
        frames += [
            AutopilotFrame(message.frame, tuple(_to_records(message, time_ns, self._node)), _is_armed(message))
            for message in messages
        ]
        return frames


def _to_records(message: Message, time_ns: int, node: str) -> Iterable[Record]:
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


def _is_armed(message: Message) -> bool:
    """Return True if the message is an autopilot's HEARTBEAT that reports armed motors."""
    if message.name != "HEARTBEAT" or message.integer("autopilot") == mavlink.MAV_AUTOPILOT_INVALID:
        return False
    return bool(message.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
