"""Who speaks at this end of the link: the companion, a system of its own, and its heartbeats."""

from __future__ import annotations

from fractus_mavlink import Message, message
from fractus_mavlink.enums import MAV_AUTOPILOT, MAV_COMPONENT, MAV_STATE, MAV_TYPE

SYSTEM_ID, COMPONENT_ID = 244, MAV_COMPONENT.ONBOARD_COMPUTER
"""The companion is a system of its own, whose heartbeats alone hold off the autopilot's failsafe: ground stations, which
are 255 as a rule, must not."""

MAVLINK_VERSION = 3
"""What a heartbeat says of the dialect; the frames' version is in their first byte."""


def heartbeat() -> Message:
    """What holds off the autopilot's failsafe."""
    return message(
        "HEARTBEAT",
        type=MAV_TYPE.ONBOARD_CONTROLLER,
        autopilot=MAV_AUTOPILOT.INVALID,
        system_status=MAV_STATE.ACTIVE,
        mavlink_version=MAVLINK_VERSION,
    )
