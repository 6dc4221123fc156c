"""How a gimbal turns its camera, from what the autopilot reports of it: only what is surely measured, in a known frame."""

from __future__ import annotations

import math

from fractus_core.policy.decision_types import Attitude
from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

MAX_NORM_ERROR = 0.02
"""A quaternion whose length is further from 1 than that is no attitude."""

_LEVELLED = mavlink.GIMBAL_DEVICE_FLAGS_ROLL_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
_FRAMES = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME


def attitude_of(status: Message, heading_deg: float) -> Attitude | None:
    """The camera's attitude: roll and pitch over the horizon, yaw from true north.

    Args:
        status: GIMBAL_DEVICE_ATTITUDE_STATUS.
        heading_deg: where the vehicle's nose points, clockwise from true north.

    Returns:
        None where the gimbal is retracted, reports a failure or no attitude, does not keep roll and pitch to the horizon,
        or where it is not sure what its yaw counts from.
    """
    flags = status.integer("flags")
    locked, frames = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK), flags & _FRAMES
    if flags & mavlink.GIMBAL_DEVICE_FLAGS_RETRACT or flags & _LEVELLED != _LEVELLED or status.integer("failure_flags"):
        return None
    # ArduPilot says that the yaw of a locked gimbal counts from the nose, and hands on the gimbal's own, from north.
    if frames == _FRAMES or (locked and frames != mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME):
        return None
    w, x, y, z = (float(part) for part in status.array("q") if not isinstance(part, bytes))
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1.0) <= MAX_NORM_ERROR:
        return None
    roll = math.atan2(2 * (w * x + y * z), norm**2 - 2 * (x * x + y * y))
    pitch = math.asin(min(max(2 * (w * y - z * x) / norm**2, -1.0), 1.0))
    yaw = math.atan2(2 * (w * z + x * y), norm**2 - 2 * (y * y + z * z))
    if abs(math.degrees(pitch)) > 89.9:
        # Straight down and up roll and yaw are one angle.
        roll, yaw = 0.0, 2 * math.atan2(z, w)
    counts_from_deg = 0.0 if frames == mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME else heading_deg
    return Attitude(math.degrees(roll), math.degrees(pitch), (math.degrees(yaw) + counts_from_deg) % 360.0)
