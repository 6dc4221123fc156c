"""Camera poses: position and attitude with error bounds, and the pose of a camera that does not move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from fractus_core.api.nodes import EdgeNodeSpec
from fractus_core.policy.decision_types import Attitude, Home, Lens, Situation
from fractus_core.policy.footprint import camera_axes
from fractus_core.policy.lenses import bounding_lens

SURVEY_ERROR_M = 0.5
"""Error of a position that was surveyed when the camera was mounted."""
_MIN_UPRIGHT_PITCH_DEG = -45.0
_MAX_UPRIGHT_ROLL_DEG = 15.0
"""Limits of the camera's attitude within which people count as upright in an image. Faces are then searched at rotations of up to
30 degrees: 15 degrees for the camera's roll, and 15 degrees for tilted heads. If the camera looks down more steeply, people may
appear in any direction."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Position, attitude and lens of a camera with error bounds. The fields are those of `Situation`."""

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
    def from_situation(cls, situation: Situation) -> Pose:
        """Return the pose of a situation."""
        return cls(
            situation.lat, situation.lon, situation.altitude_m, situation.position_error_m, situation.altitude_error_m,
            situation.relief_m, situation.home, situation.attitude, situation.lens,
        )  # fmt: skip

    @classmethod
    def from_json(cls, body: dict[str, Any]) -> Pose:
        """Parse a pose from JSON values."""
        nested = {"home": Home, "attitude": Attitude, "lens": Lens}
        fields = {key: nested[key](**value) if key in nested and value else value for key, value in body.items()}
        return cls(**fields)

    def apply_to(self, situation: Situation) -> Situation:
        """Return a situation with this pose and all other values of `situation`."""
        fields = {key: getattr(self, key) for key in self.__slots__}
        return replace(situation, **fields)


def camera_orientation(pose: Pose) -> tuple[float | None, float | None, float | None]:
    """Return roll, pitch and yaw of the camera in degrees, with None for unknown angles."""
    lens = pose.lens
    attitude = pose.attitude
    if lens is None:
        return None, None, None
    if attitude is None:
        # A gimbal keeps roll and pitch constant. Only the yaw depends on the unknown attitude of the airframe.
        return (0.0, lens.pitch_deg, None) if lens.stabilised else (None, None, None)
    axis, right, up = camera_axes(lens, attitude)
    pitch = math.asin(max(-1.0, min(1.0, -axis[2])))
    if abs(pitch) > math.radians(89.9):
        # If the camera looks straight down, the top of the image is ahead. If it looks straight up, the top is behind.
        sign = -1.0 if pitch > 0 else 1.0
        return 0.0, math.degrees(pitch), math.degrees(math.atan2(sign * up[1], sign * up[0])) % 360
    roll = math.atan2(right[2], -up[2])
    return math.degrees(roll), math.degrees(pitch), math.degrees(math.atan2(axis[1], axis[0])) % 360


def is_upright(poses: Sequence[Pose]) -> bool:
    """Return True if people stand upright in images taken from all of the poses."""
    for pose in poses:
        roll_deg, pitch_deg, _ = camera_orientation(pose)
        if roll_deg is None or pitch_deg is None:
            return False
        if pitch_deg < _MIN_UPRIGHT_PITCH_DEG or abs(roll_deg) > _MAX_UPRIGHT_ROLL_DEG:
            return False
    return True


class PoseProvider(Protocol):
    """Provides current and past situations of the camera.

    Attributes:
        fixed: True if the camera does not move. Its position is then public, as a part of the node's description.
    """

    fixed: bool

    def situation(self, time_s: float) -> Situation:
        """Return the current situation.

        Args:
            time_s: Current Unix time in seconds.
        """

    def situations_since(self, start_s: float, time_s: float, /) -> tuple[Situation, ...]:
        """Return the situations from a past time until now, oldest first.

        The first one is the latest situation before that time, because it still applied at that time. The last one is
        the current situation.

        Args:
            start_s: Monotonic time in seconds.
            time_s: Current Unix time in seconds.
        """


class FixedPose:
    """Pose of a node that does not move. Its location is its home.

    Args:
        spec: Description of the node. The camera's view is unknown if the description has no mounting height.
        relief_m: Maximum depth of the surrounding ground below home, in metres.
    """

    fixed = True

    def __init__(self, spec: EdgeNodeSpec, relief_m: float = 0.0) -> None:
        camera = spec.services.camera
        location = spec.location
        height_m = camera.mount.height if camera is not None and camera.mount is not None else None
        # Without an altitude above sea level, the altitudes of zones above sea level cannot be compared.
        known = location.alt is not None and location.altitude_reference == "amsl"
        self._situation = Situation(
            time_s=0.0,
            lat=location.lat,
            lon=location.lon,
            altitude_m=height_m or 0.0,
            home=Home(location.lat, location.lon, location.alt or 0.0) if known else None,
            position_error_m=SURVEY_ERROR_M,
            altitude_error_m=SURVEY_ERROR_M,
            attitude=Attitude(0.0, 0.0, 0.0, 0.0, 0.0),
            lens=bounding_lens(camera) if camera is not None and height_m is not None else None,
            relief_m=relief_m,
        )

    def situation(self, time_s: float) -> Situation:
        """See `PoseProvider`."""
        return replace(self._situation, time_s=time_s)

    def situations_since(self, _start_s: float, time_s: float) -> tuple[Situation, ...]:
        """See `PoseProvider`."""
        return (self.situation(time_s),)
