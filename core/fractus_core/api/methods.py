"""Methods of the system services (thesis Table 8.2), as used in policies and Grants."""

from __future__ import annotations

from typing import Literal, get_args

MobilityMethod = Literal[
    "Arm", "Disarm", "Takeoff", "Land", "SetSpeed", "GetSpeed", "Goto", "SetVelocity", "Hover", "GetPosition",
    "ReturnToLaunch", "PointGimbal",
]  # fmt: skip
CameraMethod = Literal["CaptureImage", "RetrieveImage", "ListImages", "DeleteImage"]
ControlMethod = Literal["GetControl", "ReturnControl"]
Method = Literal[MobilityMethod, CameraMethod, ControlMethod]

Service = Literal["mobility", "camera"]

Interface = Literal["grpc", "mavlink"]
"""Protocol over which a component calls a service: gRPC with the SDK, or MAVLink through the gateway of the node."""

MOBILITY_METHODS: tuple[MobilityMethod, ...] = get_args(MobilityMethod)
CAMERA_METHODS: tuple[CameraMethod, ...] = get_args(CameraMethod)
CONTROL_METHODS: tuple[ControlMethod, ...] = get_args(ControlMethod)

METHODS_OF: dict[Service, frozenset[str]] = {
    "mobility": frozenset(MOBILITY_METHODS) | frozenset(CONTROL_METHODS),
    "camera": frozenset(CAMERA_METHODS),
}
"""Methods of each service. GetControl and ReturnControl belong to the mobility service."""
