"""The methods of the system services (thesis Table 8.2), the vocabulary of policies and grants."""

from __future__ import annotations

from typing import Literal

MobilityMethod = Literal[
    "Arm", "Disarm", "Takeoff", "Land", "SetSpeed", "GetSpeed", "Goto", "SetVelocity", "Hover", "GetPosition",
    "ReturnToLaunch",
]  # fmt: skip
CameraMethod = Literal["CaptureImage", "RetrieveImage", "ListImages", "DeleteImage"]
ControlMethod = Literal["GetControl", "ReturnControl"]
Method = Literal[
    "Arm", "Disarm", "Takeoff", "Land", "SetSpeed", "GetSpeed", "Goto", "SetVelocity", "Hover", "GetPosition",
    "ReturnToLaunch", "CaptureImage", "RetrieveImage", "ListImages", "DeleteImage", "GetControl", "ReturnControl",
]  # fmt: skip

Service = Literal["mobility", "camera"]

MOBILITY_METHODS: tuple[MobilityMethod, ...] = MobilityMethod.__args__  # type: ignore[attr-defined]
CAMERA_METHODS: tuple[CameraMethod, ...] = CameraMethod.__args__  # type: ignore[attr-defined]
CONTROL_METHODS: tuple[ControlMethod, ...] = ControlMethod.__args__  # type: ignore[attr-defined]

METHODS_OF: dict[Service, frozenset[str]] = {
    "mobility": frozenset(MOBILITY_METHODS) | frozenset(CONTROL_METHODS),
    "camera": frozenset(CAMERA_METHODS),
}
"""Which methods belong to which service; GetControl and ReturnControl come with the mobility service."""
