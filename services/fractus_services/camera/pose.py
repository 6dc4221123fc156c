"""Where a camera was and how it was turned, with bounds of both errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from fractus_core.policy.decision_types import Attitude, Home, Lens, Situation
from fractus_core.policy.footprint import camera_axes

_MIN_UPRIGHT_PITCH_DEG = -45.0
_MAX_UPRIGHT_ROLL_DEG = 15.0
"""Upright pictures are searched for faces at tilts of up to 30 degrees: 15 for the camera's roll, the rest for how people
hold their heads. A camera that looks down more steeply than 45 degrees sees people from above, in any direction."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a camera was, how it was turned, and how well both were known; see `Situation`."""

    lat: float | None
    lon: float | None
    altitude_m: float
    position_error_m: float
    altitude_error_m: float
    relief_m: float
    home: Home | None
    attitude: Attitude | None
    lens: Lens | None

    @classmethod
    def of(cls, now: Situation) -> Pose:
        """The pose in a situation."""
        return cls(
            now.lat, now.lon, now.altitude_m, now.position_error_m, now.altitude_error_m, now.relief_m, now.home,
            now.attitude, now.lens,
        )  # fmt: skip

    @classmethod
    def parse(cls, body: dict[str, Any]) -> Pose:
        """The pose that JSON holds."""
        nested = {"home": Home, "attitude": Attitude, "lens": Lens}
        found = {key: nested[key](**value) if key in nested and value else value for key, value in body.items()}
        return cls(**found)

    def at(self, now: Situation) -> Situation:
        """A situation with this pose and the time of another."""
        fields = {key: getattr(self, key) for key in self.__slots__}
        return replace(now, **fields)


def directions(pose: Pose) -> tuple[float | None, float | None, float | None]:
    """Roll, pitch and yaw of the camera in degrees, as far as they are known."""
    lens, attitude = pose.lens, pose.attitude
    if lens is None or attitude is None:
        # A gimbal keeps roll and pitch whatever the airframe does; only the yaw is unknown.
        return (0.0, lens.pitch_deg, None) if lens is not None and lens.stabilised else (None, None, None)
    axis, right, up = camera_axes(lens, attitude)
    pitch = math.asin(max(-1.0, min(1.0, -axis[2])))
    if abs(pitch) > math.radians(89.9):
        # Straight down the top of the picture shows ahead, straight up it shows behind.
        sign = -1.0 if pitch > 0 else 1.0
        return 0.0, math.degrees(pitch), math.degrees(math.atan2(sign * up[1], sign * up[0])) % 360
    roll = math.atan2(right[2], -up[2])
    return math.degrees(roll), math.degrees(pitch), math.degrees(math.atan2(axis[1], axis[0])) % 360


def is_upright(poses: Sequence[Pose]) -> bool:
    """Whether people stand upright in pictures taken from all of these poses, as a camera sees them that looks ahead."""
    for pose in poses:
        roll_deg, pitch_deg, _ = directions(pose)
        if roll_deg is None or pitch_deg is None:
            return False
        if pitch_deg < _MIN_UPRIGHT_PITCH_DEG or abs(roll_deg) > _MAX_UPRIGHT_ROLL_DEG:
            return False
    return True
