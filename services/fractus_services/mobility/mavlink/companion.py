"""Who speaks at this end of the link: the companion, a system of its own, and its heartbeats."""

from __future__ import annotations

from fractus_runtime.mavlink_codec import Message, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

SYSTEM_ID, COMPONENT_ID = 244, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
"""The companion is a system of its own, whose heartbeats alone hold off the autopilot's failsafe: ground stations, which
are 255 as a rule, must not."""

MAVLINK_VERSION = 3
"""What a heartbeat says of the dialect; the frames' version is in their first byte."""


def heartbeat() -> Message:
    """What holds off the autopilot's failsafe."""
    return message(
        "HEARTBEAT",
        type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot=mavlink.MAV_AUTOPILOT_INVALID,
        system_status=mavlink.MAV_STATE_ACTIVE,
        mavlink_version=MAVLINK_VERSION,
    )
