"""What is kept about a picture: enough to judge it again by the policies of another day."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

from fractus_core.policy.footprint import camera_axes
from fractus_core.policy.values import Attitude, Filter, Home, Lens, Situation

from fractus_services.camera.imaging.metadata import Facts


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


@dataclass(frozen=True, slots=True)
class Shot:
    """A picture that was taken.

    Attributes:
        name: unique within its instance.
        time_s: Unix time.
        width: pixels.
        height: pixels.
        size_bytes: of the file.
        poses: where the camera was while it was taken, from its begin to its end.
        face_px: the smallest face that it may show is so wide; 0 when nobody knows.
        filters: what was done to it.
    """

    name: str
    time_s: float
    width: int
    height: int
    size_bytes: int
    poses: tuple[Pose, ...]
    face_px: float = 0.0
    filters: tuple[Filter, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)

    @classmethod
    def parse(cls, body: dict[str, Any]) -> Shot:
        """The shot that JSON holds; one without poses, of an earlier release, was taken nobody knows where.

        Raises:
            ValueError: it holds none.
        """
        try:
            if "poses" not in body:
                known = {key: value for key, value in body.items() if key in cls.__slots__}
                body = {**known, "poses": [asdict(Pose.of(Situation(0.0)))], "face_px": 0.0}
            poses = tuple(Pose.parse(pose) for pose in body["poses"])
            shot = cls(**{**body, "poses": poses, "filters": tuple(Filter(**one) for one in body["filters"])})
            sound = all(pose.at(Situation(0.0)).sound for pose in poses) and math.isfinite(shot.face_px + shot.time_s)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no shot: {error}") from None
        if not poses or not sound:
            raise ValueError("no shot: it does not tell where it was taken")
        return shot


def facts(pose: Pose, time_s: float, camera: str, width: int) -> Facts:
    """What a picture without filters tells about itself.

    Args:
        pose: where it was taken.
        time_s: Unix time.
        camera: make and model.
        width: pixels of the whole view.
    """
    roll_deg, pitch_deg, yaw_deg = directions(pose)
    half = math.radians(pose.lens.horizontal_deg) / 2 if pose.lens is not None else None
    return Facts(
        time_s=float(time_s),
        camera=camera,
        lat=pose.lat,
        lon=pose.lon,
        amsl_m=pose.home.amsl_m + pose.altitude_m if pose.home is not None else None,
        altitude_m=pose.altitude_m,
        position_error_m=pose.position_error_m,
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
        yaw_deg=yaw_deg,
        focal_px=width / 2 / math.tan(half) if half else None,
    )


def directions(pose: Pose) -> tuple[float | None, float | None, float | None]:
    """Roll, pitch and yaw of the camera in degrees, as far as they are known."""
    lens, attitude = pose.lens, pose.attitude
    if lens is None or attitude is None:
        steady = lens is not None and lens.stabilised
        return (0.0, lens.pitch_deg, None) if steady and lens is not None else (None, None, None)
    axis, right, up = camera_axes(lens, attitude)
    pitch = math.asin(max(-1.0, min(1.0, -axis[2])))
    if abs(pitch) > math.radians(89.9):
        # Straight down the top of the picture shows ahead, straight up it shows behind.
        sign = -1.0 if pitch > 0 else 1.0
        return 0.0, math.degrees(pitch), math.degrees(math.atan2(sign * up[1], sign * up[0])) % 360
    roll = math.atan2(right[2], -up[2])
    return math.degrees(roll), math.degrees(pitch), math.degrees(math.atan2(axis[1], axis[0])) % 360
