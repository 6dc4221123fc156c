"""Fields of view from camera descriptions.

For each lens model, the view is the view of a pinhole camera that contains every ray of a picture.
"""

from __future__ import annotations

import math

import numpy as np

from fractus_core.api.nodes import CameraFeatures, CameraLens
from fractus_core.policy.decision_types import Lens

MOUNT_ERROR_DEG = 2.0
"""Bound of the error of a mount's direction."""
OFF_AXIS_DEG = 1.0
"""Additional error if the lens is not described, because its axis may be off the middle of the picture."""
_STEPS = 4000
_MAX_TAN = math.tan(math.radians(80.0))
"""Beyond this angle from the axis (`footprint.MAX_HALF_VIEW_DEG`) a view counts as seeing everything anyway."""


def bounding_lens(camera: CameraFeatures | None) -> Lens | None:
    """Return the view of a described camera, or None if the description is incomplete."""
    if camera is None or camera.horizontal_field_of_view is None or camera.mount is None:
        return None
    width, height = camera.pixels
    half = _half_view(camera.lens, math.radians(camera.horizontal_field_of_view) / 2, height / width)
    wide, tall = (2 * math.degrees(math.atan(side)) for side in half) if half is not None else (180.0, 180.0)
    mount = camera.mount
    error_deg = MOUNT_ERROR_DEG + (OFF_AXIS_DEG if camera.lens is None else 0.0)
    if mount.gimbal:
        # The attitude of a gimbal is the attitude of the camera, so no mounting angle applies.
        return Lens(wide, tall, 0.0, 0.0, False, error_deg)
    return Lens(wide, tall, mount.pitch, mount.yaw, mount.stabilised, error_deg)


def _half_view(lens: CameraLens | None, half: float, aspect: float) -> tuple[float, float] | None:
    """Return the tangents of half the horizontal and vertical angle of view that contain every ray of a picture.

    Return None if a ray may be 90 degrees or more from the axis, or if the lens model does not describe the whole picture.

    Args:
        lens: Description of the lens, or None.
        half: Angle from the middle of the picture to the middle of a side.
        aspect: Height over width.
    """
    if lens is None:
        return _any_lens(half, aspect)
    if lens.model == "pinhole":
        return math.tan(half), math.tan(half) * aspect
    if lens.model == "equidistant":
        return _corner(half * math.hypot(1.0, aspect), aspect)
    return _distorted(lens, math.tan(half), aspect)


def _corner(angle: float, aspect: float) -> tuple[float, float] | None:
    """Return the tangents of a corner at an angle.

    The tangents are upper bounds if rays that are farther from the axis bend outward more.
    """
    if angle >= math.pi / 2:
        return None
    far = math.tan(angle) / math.hypot(1.0, aspect)
    return far, far * aspect


def _any_lens(half: float, aspect: float) -> tuple[float, float] | None:
    """Return bounds for every rotationally symmetric lens whose corners show at most as much as an orthographic fisheye.

    Of all lenses with the same angle at their sides, an orthographic fisheye has the largest angle at its corners. The bounds
    therefore also apply to pinholes, to the other fisheyes (stereographic, equidistant, equisolid) and to real lenses in the
    Brown-Conrady model. Of rays closer to the middle, only an upper bound of the angle is known: the angle at the sides.
    """
    sine = math.sin(half) * math.hypot(1.0, aspect)
    corner = _corner(math.asin(sine), aspect) if sine < 1.0 else None
    side = math.tan(half)
    return (max(corner[0], side), max(corner[1], side)) if corner is not None else None


def _distorted(lens: CameraLens, side: float, aspect: float) -> tuple[float, float] | None:
    """Return bounds for the Brown-Conrady model.

    A ray with tangent r is shown at g(r) = r (1 + k1 r² + k2 r⁴ + k3 r⁶), displaced by at most t r². A shown ray is
    therefore no farther out than the r at which g(r) - t r² reaches the corner of the picture. If
    g(r) - t r² never reaches the corner, or g decreases before the corner, the model does not define what is shown there.
    """
    k1, k2, k3, p1, p2 = (getattr(lens, name) or 0.0 for name in ("k1", "k2", "k3", "p1", "p2"))
    tangential = 3.0 * (abs(p1) + abs(p2))
    r = np.linspace(0.0, _MAX_TAN, _STEPS + 1)[1:]
    stretch = 1.0 + r**2 * (k1 + r**2 * (k2 + r**2 * k3))
    shown = r * stretch - tangential * r**2
    wide = side * (1.0 + side**2 * (k1 + side**2 * (k2 + side**2 * k3))) + tangential * side**2
    beyond = np.flatnonzero(shown >= wide * math.hypot(1.0, aspect))
    if wide <= 0.0 or not beyond.size or beyond[0] == 0:
        return None
    last = int(beyond[0])
    outwards = np.diff(shown[: last + 1]) / np.diff(r[: last + 1])
    if r[last] < side or shown[0] <= 0.0 or not (outwards > 0.0).all():
        return None
    slack = tangential * r[last] ** 2
    shrunk = 1.001 / stretch[: last + 1].min()
    # If a lens shows objects smaller than the pinhole does, a wider view replaces it, because faces are searched by
    # their size.
    least = float((outwards * (1.0 + r[1 : last + 1] ** 2)).min())
    x, y = ((extent + slack) * shrunk for extent in (wide, wide * aspect))
    return max(min(x, float(r[last])), wide / least), min(y, float(r[last]))
