"""Camera footprint: the ground and the air that a picture may show (design, section 6)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.geo import LocalFrame
from fractus_core.policy.decision_types import Attitude, Lens, Situation
from fractus_core.policy.kinematics import XY

MAX_SIGHT_M = 10_000.0
"""Maximum distance at which a picture shows recognisable objects.

With a field of view of 5 degrees, 8 megapixels resolve 0.3 m at this distance.
"""
MAX_HALF_VIEW_DEG = 80.0
"""Maximum half angle of a view, including errors. A camera with a wider view is assumed to see everything around it."""
_MAX_TURN_DEG = 60.0
"""Maximum yaw error for which tangents bound the possible positions of a corner. For a larger error, a circle does."""
_ARC_DEG = 15.0
"""Angle between neighbouring points of the arc that closes a sector."""
_SIDES = 24
_CIRCLE = tuple(
    (math.sin(2 * math.pi * i / _SIDES) / math.cos(math.pi / _SIDES),
     math.cos(2 * math.pi * i / _SIDES) / math.cos(math.pi / _SIDES))
    for i in range(_SIDES)
)  # fmt: skip
_ANY_YAW = Attitude(0.0, 0.0, 0.0, 0.0, 180.0)

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Footprint:
    """The part of the ground and the air that a picture may show.

    Attributes:
        sight: Horizontal outline of the camera, the visible ground and the air between them, in metres east and north
            in the frame of a grant.
        margin_m: Bound of the camera's position error. Objects within this distance of `sight` may be visible.
        upper_m: Height above home of the highest visible point. Infinite if the picture may show sky.
        farthest_m: Distance from the camera to the farthest ground shown. Infinite at the horizon.
    """

    sight: BaseGeometry
    margin_m: float
    upper_m: float
    farthest_m: float
    _at: XY | None = None
    _below: tuple[XY, ...] = ()
    _lowest_m: float = 0.0
    _highest_m: float = 0.0

    def shows(self, shape: BaseGeometry, lower_m: float = -math.inf, upper_m: float = math.inf) -> bool:
        """Return True if a picture may show part of a volume, or of the ground below it.

        Args:
            shape: Horizontal outline of the volume.
            lower_m: Floor of the volume above home.
            upper_m: Ceiling of the volume above home.
        """
        if lower_m > self.upper_m or not shape.dwithin(self.sight, self.margin_m):
            return False
        if self._at is None or not (upper_m < self._lowest_m or lower_m > 0.0):
            return True
        # All rays are straight and lead down, so the size of the visible area is proportional to the depth.
        far = self._highest_m - max(lower_m, 0.0)
        near = max(self._lowest_m - upper_m, 0.0)
        if far < 0.0:
            return False
        x, y = self._at
        points = [(x + e * d, y + n * d) for d in (near, far) for e, n in self._below]
        return bool(shape.dwithin(_hull(points), self.margin_m))


def joined_footprint(views: Sequence[Footprint]) -> Footprint:
    """Return the footprint of a picture taken while the camera moves through these views in order."""
    if len(views) == 1:
        return views[0]
    return Footprint(
        shapely.union_all([view.sight for view in views]).convex_hull,
        max(view.margin_m for view in views),
        max(view.upper_m for view in views),
        max(view.farthest_m for view in views),
    )


def exposure_footprint(poses: Sequence[Situation], frame: LocalFrame) -> Footprint | None:
    """Return the footprint of a picture taken while the camera moves through these poses. None if a pose is unknown."""
    views = [footprint(now, frame) for now in poses]
    known = [view for view in views if view is not None]
    return joined_footprint(known) if known and len(known) == len(views) else None


def footprint(now: Situation, frame: LocalFrame) -> Footprint | None:
    """Return the present footprint, enlarged by the bounds of all errors. Return None while the position is unknown.

    The ground is assumed to be level, at an altitude between home and `relief_m` below home. If the attitude, the lens
    or the ground is unknown, the camera is assumed to see everything around it.
    """
    if now.lat is None or now.lon is None or not now.is_plausible:
        return None
    position = frame.xy(now.lat, now.lon)
    attitude = _attitude(now)
    if now.lens is None or attitude is None:
        return _everything(position, now)
    half_view = _widened(now.lens, now.lens.error_deg + (0.0 if now.lens.stabilised else attitude.tilt_error_deg))
    if half_view is None:
        return _everything(position, now)
    axis, right, up = camera_axes(now.lens, attitude)
    corners = [
        (
            axis[0] + sx * half_view[0] * right[0] + sy * half_view[1] * up[0],
            axis[1] + sx * half_view[0] * right[1] + sy * half_view[1] * up[1],
            axis[2] + sx * half_view[0] * right[2] + sy * half_view[1] * up[2],
        )
        for sx, sy in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    high = max(now.altitude_m + now.altitude_error_m + now.relief_m, 0.1)
    if any(down * MAX_SIGHT_M <= high * math.hypot(north, east, down) for north, east, down in corners):
        vertical = _sees_vertical(axis, right, up, half_view)
        return _everything(position, now) if vertical else _sector(position, now, axis, corners, attitude.yaw_error_deg)
    below = _turned([(east / down, north / down) for north, east, down in corners], attitude.yaw_error_deg)
    sight = _hull([position, *((position[0] + e * high, position[1] + n * high) for e, n in below)])
    farthest_m = high * max(math.hypot(north, east, down) / down for north, east, down in corners)
    low = max(now.altitude_m - now.altitude_error_m, 0.0)
    return Footprint(sight, now.position_error_m, high - now.relief_m, farthest_m, position, tuple(below), low, high)


def _attitude(now: Situation) -> Attitude | None:
    """Return the attitude, or None if it is unknown or the drone is lower than the assumed ground.

    For a camera that a gimbal keeps level, an unknown attitude is replaced by a level attitude with any yaw.
    """
    if now.altitude_m + now.altitude_error_m + now.relief_m < 0.0:
        return None
    if now.attitude is None and now.lens is not None and now.lens.stabilised:
        return _ANY_YAW
    return now.attitude


def _everything(position: XY, now: Situation) -> Footprint:
    x, y = position
    return Footprint(
        _hull([(x + MAX_SIGHT_M * e, y + MAX_SIGHT_M * n) for e, n in _CIRCLE]),
        now.position_error_m,
        math.inf,
        math.inf,
    )


def _widened(lens: Lens, error_deg: float) -> tuple[float, float] | None:
    """Return the tangents of the half views, widened so that they contain every ray for any direction of the error.

    On the sphere of directions a turn by e moves a ray sideways by at most asin(sin e / cos elevation).
    """
    wide, tall, error = (math.radians(v) for v in (lens.horizontal_deg / 2, lens.vertical_deg / 2, error_deg))
    limit = math.radians(MAX_HALF_VIEW_DEG)
    if not (0 < wide < limit and 0 < tall < limit and 0 <= error < math.pi / 2 - max(wide, tall)):
        return None
    wider = wide + math.asin(math.sin(error) / math.cos(tall))
    taller = tall + math.asin(math.sin(error) / math.cos(wide))
    if wider >= limit or taller >= limit:
        return None
    return math.tan(wider), math.tan(taller)


def camera_axes(lens: Lens, attitude: Attitude) -> tuple[Vector, Vector, Vector]:
    """Return the viewing direction, and the right and up directions of pictures, as north, east, down."""
    pitch = math.radians(lens.pitch_deg)
    yaw = math.radians(lens.yaw_deg)
    cp = math.cos(pitch)
    sp = math.sin(pitch)
    cy = math.cos(yaw)
    sy = math.sin(yaw)
    mounted = ((cp * cy, cp * sy, -sp), (-sy, cy, 0.0), (sp * cy, sp * sy, cp))
    roll = pitch = 0.0
    if not lens.stabilised:
        roll = math.radians(attitude.roll_deg)
        pitch = math.radians(attitude.pitch_deg)
    cr = math.cos(roll)
    sr = math.sin(roll)
    cp = math.cos(pitch)
    sp = math.sin(pitch)
    yaw = math.radians(attitude.yaw_deg)
    cy = math.cos(yaw)
    sy = math.sin(yaw)

    def turned(vector: Vector) -> Vector:
        x, y, z = vector
        y, z = cr * y - sr * z, sr * y + cr * z
        x, z = cp * x + sp * z, -sp * x + cp * z
        return cy * x - sy * y, sy * x + cy * y, z

    axis, right, down = mounted
    return turned(axis), turned(right), turned((-down[0], -down[1], -down[2]))


def _sees_vertical(axis: Vector, right: Vector, up: Vector, half_view: tuple[float, float]) -> bool:
    """Return True if straight down or straight up is in the picture."""
    depth = abs(axis[2])
    return abs(right[2]) <= half_view[0] * depth and abs(up[2]) <= half_view[1] * depth


def _sector(position: XY, now: Situation, axis: Vector, corners: list[Vector], error_deg: float) -> Footprint:
    """Return the footprint of a picture that shows the horizon: everything in sight between its two sides."""
    ahead = math.atan2(axis[1], axis[0])
    turns = [math.remainder(math.atan2(east, north) - ahead, 2 * math.pi) for north, east, _ in corners]
    left = min(turns) - math.radians(error_deg)
    right = max(turns) + math.radians(error_deg)
    if right - left >= math.radians(175):
        return _everything(position, now)
    steps = math.ceil((right - left) / math.radians(_ARC_DEG))
    step = (right - left) / steps
    reach_m = MAX_SIGHT_M / math.cos(step / 2)
    x, y = position
    bearings = [ahead + left + i * step for i in range(steps + 1)]
    points = [position, *((x + reach_m * math.sin(b), y + reach_m * math.cos(b)) for b in bearings)]
    return Footprint(_hull(points), now.position_error_m, math.inf, math.inf)


def _turned(corners: list[XY], error_deg: float) -> list[XY]:
    """Return points whose convex hull contains the corners of an area at every possible yaw error."""
    if error_deg <= 0.0:
        return corners
    if error_deg > _MAX_TURN_DEG:
        reach = max(math.hypot(e, n) for e, n in corners)
        return [(reach * e, reach * n) for e, n in _CIRCLE]
    turn = math.radians(error_deg)
    c = math.cos(turn)
    s = math.sin(turn)
    # The ends of each corner's arc, and the intersection of the tangents at these ends.
    return [
        point
        for e, n in corners
        for point in ((e * c + n * s, n * c - e * s), (e / c, n / c), (e * c - n * s, n * c + e * s))
    ]


def _hull(points: list[XY]) -> BaseGeometry:
    hull: BaseGeometry = shapely.convex_hull(shapely.multipoints(np.array(points)))
    return hull
