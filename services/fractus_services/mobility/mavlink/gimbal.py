"""The gimbal: its measured attitude, and pointing it within its limits."""

from __future__ import annotations

import math
from typing import Protocol

from fractus_core.policy.decision_types import Attitude
from fractus_runtime.mavlink_codec import Message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError, PreconditionFailed
from fractus_services.mobility.autopilot import Permit

MAX_NORM_ERROR = 0.02
"""Maximum difference of a quaternion's norm from 1. With a larger difference, the quaternion is not an attitude."""

_LEVELLED = mavlink.GIMBAL_DEVICE_FLAGS_ROLL_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
_FRAMES = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME


class GimbalState(Protocol):
    """Part of the vehicle's state that contains the limits of the gimbal."""

    @property
    def gimbal_limits(self) -> tuple[tuple[float, float], ...] | None:
        """Smallest and largest pitch and yaw, degrees; None until the autopilot reports them."""


class GimbalCommander(Protocol):
    """Autopilot interface that `point` needs."""

    @property
    def vehicle(self) -> GimbalState:
        """State of the vehicle."""

    async def command(self, command: int, *params: float, permit: Permit = ..., attempts: int = ...) -> None:
        """Run a MAVLink command and wait for its acknowledgement."""


def attitude_of(status: Message, heading_deg: float) -> Attitude | None:
    """Return the camera's attitude: roll and pitch relative to the horizon, yaw from true north.

    Only a measured attitude in a known frame is returned.

    Args:
        status: GIMBAL_DEVICE_ATTITUDE_STATUS.
        heading_deg: Heading of the vehicle, clockwise from true north.

    Returns:
        The attitude. None if the gimbal is retracted, reports a failure or no attitude, does not lock roll and pitch to the
        horizon, or if the reference of its yaw is ambiguous.
    """
    flags = status.integer("flags")
    locked = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK)
    frames = flags & _FRAMES
    if flags & mavlink.GIMBAL_DEVICE_FLAGS_RETRACT or flags & _LEVELLED != _LEVELLED or status.integer("failure_flags"):
        return None
    # For a gimbal with locked yaw, ArduPilot reports the vehicle frame but forwards the gimbal's yaw from north.
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
        # If the camera points straight up or down, roll and yaw are rotations about the same axis.
        roll = 0.0
        yaw = 2 * math.atan2(z, w)
    yaw_reference_deg = 0.0 if frames == mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME else heading_deg
    return Attitude(math.degrees(roll), math.degrees(pitch), (math.degrees(yaw) + yaw_reference_deg) % 360.0)


async def point(autopilot: GimbalCommander, pitch_deg: float, yaw_deg: float, permit: Permit) -> None:
    """Point the first gimbal; the yaw follows the vehicle's heading.

    Args:
        autopilot: Autopilot of the vehicle.
        pitch_deg: Pitch above the horizon.
        yaw_deg: Yaw clockwise from the vehicle's heading.
        permit: Called before the command is sent.

    Raises:
        PreconditionFailed: The vehicle has no gimbal, or the angle is outside of its limits.
        AutopilotError: The autopilot did not answer.
    """
    if autopilot.vehicle.gimbal_limits is None:
        try:
            information = mavlink.MAVLINK_MSG_ID_GIMBAL_MANAGER_INFORMATION
            await autopilot.command(mavlink.MAV_CMD_REQUEST_MESSAGE, information, attempts=2)
        except AutopilotError as error:
            if error.link:
                raise
    limits = autopilot.vehicle.gimbal_limits or ()
    for axis, angle, (low, high) in zip(("pitch", "yaw"), (pitch_deg, yaw_deg), limits, strict=False):
        if not low <= angle <= high:
            reason = f"the gimbal's {axis} is limited to {low:.0f} to {high:.0f} degrees; {angle:g} was requested"
            raise PreconditionFailed("AutopilotRefused", reason)
    try:
        # Parameters 3 and 4: no rates. Parameter 5: no flags, so the yaw is not locked. Parameter 7: the first gimbal.
        await autopilot.command(
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, pitch_deg, yaw_deg, math.nan, math.nan, permit=permit
        )
    except AutopilotError as error:
        if not error.refused:
            raise
        reason = "the autopilot has no gimbal that it can point; check ArduPilot's parameter MNT1_TYPE"
        raise PreconditionFailed("AutopilotRefused", reason) from error
