"""MAVLink 2 for services and simulation: one codec, generated from the dialect that is checked in.

Example:
    link = Endpoint(sysid=255, compid=MAV_COMPONENT.MISSIONPLANNER)
    frame = link.encode("COMMAND_LONG", {"command": MAV_CMD.NAV_LAND, "target_system": 1})
    for message in link.decode(received):
        if message.name == "ATTITUDE":
            print(message.real("yaw"))
"""

from fractus_mavlink.endpoint import Endpoint
from fractus_mavlink.framing import Parser, encode, frame_length
from fractus_mavlink.messages import (
    Message,
    Scalar,
    UnknownMessageError,
    Value,
    layout_named,
    layout_of,
    message,
)
from fractus_mavlink.signing import Signing

__all__ = [
    "Endpoint",
    "Message",
    "Parser",
    "Scalar",
    "Signing",
    "UnknownMessageError",
    "Value",
    "encode",
    "frame_length",
    "layout_named",
    "layout_of",
    "message",
]
