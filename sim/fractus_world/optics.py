"""Camera geometry: the mapping between ground and pixels by position, attitude, mount and lens.

Frames: the ground is the plane through the point below the camera, in metres east and north of it. Directions are east,
north, up. Pixel coordinates have their origin in the upper left corner of the picture, so the centre of the first pixel
is (0.5, 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from fractus_core.geo import LocalFrame
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

MIN_HEIGHT_M = 0.2
MAX_PIXELS = 8192
NEAR_M = 0.3
"""Minimum depth of visible points along the optical axis."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A lens without distortion and its sensor.

    Attributes:
        width: Pixels.
        height: Pixels.
        horizontal_fov_deg: Angle of view across the width.
    """

    width: int = 1920
    height: int = 1080
    horizontal_fov_deg: float = 62.2

    def __post_init__(self) -> None:
        for name, value in (("width", self.width), ("height", self.height)):
            if not 16 <= value <= MAX_PIXELS:
                raise ValueError(f"{name}: {value} is not a number of pixels between 16 and {MAX_PIXELS}")
        if not 1.0 <= self.horizontal_fov_deg <= 150.0:
            raise ValueError(f"horizontal field of view: {self.horizontal_fov_deg:g} degrees is not between 1 and 150")

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self.width / 2.0 / math.tan(math.radians(self.horizontal_fov_deg) / 2.0)


@dataclass(frozen=True, slots=True)
class Mount:
    """Mount of the camera on the airframe.

    Attributes:
        pitch_deg: -90 is straight down (the top of the picture is ahead), 0 is ahead.
        yaw_deg: Clockwise from the airframe's nose.
        stabilised: True if a gimbal compensates roll and pitch of the airframe.
    """

    pitch_deg: float = -90.0
    yaw_deg: float = 0.0
    stabilised: bool = True

    def __post_init__(self) -> None:
        if not -90.0 <= self.pitch_deg <= 90.0:
            raise ValueError(f"mount pitch: {self.pitch_deg:g} degrees is not between -90 (down) and 90 (up)")
        if not -360.0 <= self.yaw_deg <= 360.0:
            raise ValueError(f"mount yaw: {self.yaw_deg:g} degrees is not between -360 and 360")


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and attitude of the airframe.

    Attributes:
        lat: Latitude, degrees (WGS 84).
        lon: Longitude, degrees (WGS 84).
        height_m: Height above the ground.
        roll_deg: Right side down is positive.
        pitch_deg: Nose up is positive.
        yaw_deg: Heading, clockwise from true north.
    """

    lat: float
    lon: float
    height_m: float
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.lat, self.lon, self.height_m, self.roll_deg, self.pitch_deg, self.yaw_deg)
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError("pose: every number must be finite")
        if not (abs(self.lat) <= 90.0 and abs(self.lon) <= 180.0):
            raise ValueError(f"pose: latitude {self.lat:g} or longitude {self.lon:g} is not on the globe")
        if self.height_m > 50_000.0:
            raise ValueError(f"pose: {self.height_m:g} m above the ground is more than 50 km")


def _about_x(angle_deg: float) -> Matrix:
    c = math.cos(math.radians(angle_deg))
    s = math.sin(math.radians(angle_deg))
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_y(angle_deg: float) -> Matrix:
    c = math.cos(math.radians(angle_deg))
    s = math.sin(math.radians(angle_deg))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _about_z(angle_deg: float) -> Matrix:
    c = math.cos(math.radians(angle_deg))
    s = math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


# _AXES: camera axes (right, down, ahead) to airframe axes (ahead, right, down). _TO_ENU: north, east, down to ENU.
_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def camera_rotation(pose: Pose, mount: Mount) -> Matrix:
    """Return the rotation from camera axes (right, down, ahead) to east, north, up."""
    body = _about_z(pose.yaw_deg)
    if not mount.stabilised:
        body = body @ _about_y(pose.pitch_deg) @ _about_x(pose.roll_deg)
    return np.asarray(_TO_ENU @ body @ _about_z(mount.yaw_deg) @ _about_y(mount.pitch_deg) @ _AXES)


def local_axes(frame: LocalFrame, lat: float, lon: float) -> Matrix:
    """Return the matrix from metres east and north at a place to metres in a frame. The directions differ slightly."""
    phi = math.radians(lat)
    origin = math.radians(frame.lat)
    apart = math.radians(lon - frame.lon)
    return np.array(
        [
            [math.cos(apart), -math.sin(phi) * math.sin(apart)],
            [
                math.sin(origin) * math.sin(apart),
                math.sin(origin) * math.sin(phi) * math.cos(apart) + math.cos(origin) * math.cos(phi),
            ],
        ]
    )


@dataclass(frozen=True, slots=True)
class View:
    """Geometry of one picture.

    Attributes:
        intrinsics: Lens.
        rotation: Rotation from camera axes to east, north, up.
        height_m: Height of the camera above the ground.
        place: Point below the camera, metres east and north of the world's origin.
        to_world: Matrix from metres east and north at the camera to metres in the world's frame.
        from_world: Inverse of `to_world`.
    """

    intrinsics: Intrinsics
    rotation: Matrix
    height_m: float
    place: Matrix
    to_world: Matrix
    from_world: Matrix

    @classmethod
    def of(cls, pose: Pose, mount: Mount, intrinsics: Intrinsics, frame: LocalFrame) -> View:
        """Return the view of a camera on an airframe, in the frame of a world."""
        to_world = local_axes(frame, pose.lat, pose.lon)
        return cls(
            intrinsics,
            camera_rotation(pose, mount),
            max(pose.height_m, MIN_HEIGHT_M),
            np.array(frame.xy(pose.lat, pose.lon)),
            to_world,
            np.asarray(np.linalg.inv(to_world), np.float64),
        )

    def rays(self, pixels: Matrix) -> Matrix:
        """Return the direction in which the camera sees each pixel.

        Args:
            pixels: Pixel coordinates, shape (..., 2).

        Returns:
            Vectors east, north and up, shape (..., 3). Their component along the optical axis is 1.
        """
        lens = self.intrinsics
        across = (pixels - np.array([lens.width / 2.0, lens.height / 2.0])) / lens.focal_px
        ahead = np.ones((*across.shape[:-1], 1))
        directions: Matrix = np.concatenate((across, ahead), axis=-1) @ self.rotation.T
        return directions

    def ground_matrix(self) -> Matrix:
        """Return the homography from pixels to metres in the world's frame. Visible ground has a negative third component."""
        lens = self.intrinsics
        inverse = np.array(
            [
                [1.0 / lens.focal_px, 0.0, -lens.width / 2.0 / lens.focal_px],
                [0.0, 1.0 / lens.focal_px, -lens.height / 2.0 / lens.focal_px],
                [0.0, 0.0, 1.0],
            ]
        )
        rays = self.rotation @ inverse
        local = -self.height_m * rays[:2]
        return np.vstack((self.to_world @ local + np.outer(self.place, rays[2]), rays[2]))

    def project(self, points: Matrix) -> tuple[Matrix, Matrix]:
        """Return pixels, shape (n, 2), and depths in metres, shape (n,), of points of the world's frame, shape (n, 3), z up.

        Pixels of points nearer than `NEAR_M` are invalid.
        """
        plane = (points[:, :2] - self.place) @ self.from_world.T
        camera = np.column_stack((plane, points[:, 2] - self.height_m)) @ self.rotation
        depth = camera[:, 2]
        lens = self.intrinsics
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        pixels = camera[:, :2] / safe[:, None] * lens.focal_px + np.array([lens.width / 2.0, lens.height / 2.0])
        return pixels, depth

    def ground_within(self, limit_m: float) -> Matrix | None:
        """Return the bounding box ((x0, y0), (x1, y1)) of the visible ground up to a distance.

        Returns None if no ground is visible.
        """
        lens = self.intrinsics
        steps = np.linspace(0.0, 1.0, 9)
        u, v = np.meshgrid(steps * lens.width, steps * lens.height)
        rays = self.rays(np.stack((u, v), axis=-1).reshape(-1, 2))
        flat = np.hypot(rays[:, 0], rays[:, 1])
        down = -rays[:, 2]
        if not bool((down > -0.2).any()):
            return None
        far = np.where(down > 1e-6, self.height_m * flat / np.maximum(down, 1e-6), limit_m)
        far = np.minimum(far, limit_m)
        local = rays[:, :2] / np.maximum(flat, 1e-9)[:, None] * far[:, None]
        ground = local @ self.to_world.T + self.place
        return np.array([ground.min(axis=0), ground.max(axis=0)])
