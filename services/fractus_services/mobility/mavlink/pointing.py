"""Points the gimbal, within what the autopilot says that it turns."""

from __future__ import annotations

import math
from typing import Protocol

from fractus_runtime.mavlink_codec import message_id
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError, PreconditionFailed
from fractus_services.mobility.autopilot import Permit
from fractus_services.mobility.mavlink.vehicle import Vehicle

_INFORMATION = "GIMBAL_MANAGER_INFORMATION"


class Commander(Protocol):
    """The autopilot, as far as pointing needs it."""

    vehicle: Vehicle

    async def command(self, command: int, *params: float, permit: Permit = ..., attempts: int = ...) -> None:
        """Run a MAVLink command and wait for its acknowledgement."""


async def point(autopilot: Commander, pitch_deg: float, yaw_deg: float, permit: Permit) -> None:
    """Turn the camera, following the nose.

    Args:
        autopilot: whose first gimbal it is.
        pitch_deg: over the horizon.
        yaw_deg: clockwise from the nose.
        permit: asked before the command is sent.

    Raises:
        PreconditionFailed: there is no gimbal, or it does not turn that far.
        AutopilotError: there was no answer.
    """
    vehicle = autopilot.vehicle
    if vehicle.gimbal_limits is None:
        try:
            await autopilot.command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id(_INFORMATION), attempts=2)
        except AutopilotError as error:
            if error.link:
                raise
    for axis, angle, ends in zip(("pitch", "yaw"), (pitch_deg, yaw_deg), vehicle.gimbal_limits or (), strict=False):
        if not ends[0] <= angle <= ends[1]:
            reason = f"the gimbal turns from {ends[0]:.0f} to {ends[1]:.0f} degrees of {axis}, not to {angle:g}"
            raise PreconditionFailed("AutopilotRefused", reason)
    try:
        # NaN: no rates. The fifth parameter has the flags, none of which locks the yaw; the seventh the first gimbal.
        await autopilot.command(
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, pitch_deg, yaw_deg, math.nan, math.nan, permit=permit
        )
    except AutopilotError as error:
        if not error.refused:
            raise
        reason = "the autopilot has no gimbal that it can turn; ArduPilot's MNT1_TYPE says which one it has"
        raise PreconditionFailed("AutopilotRefused", reason) from error
