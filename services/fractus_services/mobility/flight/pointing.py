"""Points the camera for the driver that has the drone."""

from __future__ import annotations

from fractus_core.policy.decision_types import Call, PointGimbalArgs, Verdict

from fractus_services.errors import PreconditionFailed
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.flight.calls import CallJudge


async def point_gimbal(
    control: ControlStore, calls: CallJudge, grant: ActiveGrant, args: PointGimbalArgs, *, fixed_camera: bool
) -> Verdict:
    """Turn the camera by the gimbal, on the ground and in the air; the motion under way goes on.

    Args:
        control: who has the drone.
        calls: judges the call.
        grant: of the caller.
        args: where to point.
        fixed_camera: whether pictures are judged by a mount that does not move.

    Raises:
        Refused: by policy, or the caller does not have the drone, or there is no gimbal that turns that far.
        AutopilotError: the autopilot does not answer.
    """
    verdict = calls.allow_motion(Call("PointGimbal", args), grant)
    if fixed_camera:
        raise PreconditionFailed(
            "CameraFixed",
            "the node's description says that its camera does not move; set services.camera.mount.gimbal of the Drone",
        )
    await control.autopilot.point_gimbal(args.pitch_deg, args.yaw_deg, control.driver_permit(grant))
    return verdict
