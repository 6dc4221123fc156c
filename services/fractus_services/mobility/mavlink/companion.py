"""MAVLink identity and heartbeat of the companion computer that runs the mobility service."""

from __future__ import annotations

from fractus_runtime.mavlink_codec import Message, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

SYSTEM_ID = 244
"""System id of the companion. The autopilot's failsafe reacts to missing heartbeats of this id, and ignores ground stations (255)."""

COMPONENT_ID = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER

MAVLINK_VERSION = 3
"""Field `mavlink_version` of HEARTBEAT: version of the dialect.

The protocol version of a frame is in its first byte.
"""


def heartbeat() -> Message:
    """Return the heartbeat that holds off the autopilot's failsafe."""
    return message(
        "HEARTBEAT",
        type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot=mavlink.MAV_AUTOPILOT_INVALID,
        system_status=mavlink.MAV_STATE_ACTIVE,
        mavlink_version=MAVLINK_VERSION,
    )
