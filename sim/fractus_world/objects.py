"""Drawing of objects on the ground, and computation of their visible parts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from fractus_core.geo import LocalFrame
from numpy.typing import NDArray

from fractus_world.billboards import Billboard, Billboards, portrait
from fractus_world.bodies import Colour, Part, parts_of, silhouette
from fractus_world.optics import NEAR_M, Matrix, View
from fractus_world.population import Population, Thing, nearest
from fractus_world.render import Band
from fractus_world.tile_drawing import SUN_SHADOW
from fractus_world.truth import Box, Seen, SeenFace

Picture = NDArray[np.uint8]
Labels = NDArray[np.int32]
Fixed = NDArray[np.int32]

_SHIFT = 4
_MAX_THINGS = 500
_SMALL_PX = 14.0
_SILHOUETTE_PX = 7.0
_SHADELESS_PX = 5.0
_TINY_PX = 1.2
_MIN_BOARD_PX = 6.0
_REACH = 0.55
"""Maximum distance of drawn objects, as metres per pixel of the focal length."""
_SHADOW = 0.5
_BOARD_BACK = (96, 100, 104)
_FRAME_WARMTH = 118
_FAR_PX = 30_000.0


@dataclass(frozen=True, slots=True)
class _Shape:
    """A convex part of an object.

    Attributes:
        hull: Corners in fixed-point pixels, shape (n, 1, 2).
        colour: Blue, green, red.
        warmth: Grey value for a thermal camera.
    """

    hull: Fixed
    colour: Colour
    warmth: int


@dataclass(frozen=True, slots=True)
class _InSight:
    """A visible object or billboard.

    Attributes:
        what: The object or billboard.
        away_m: Distance from the camera. Nearer objects cover farther ones.
        shapes: Drawn parts. A billboard has only one part.
        shadow: Shadow in fixed-point pixels. None without shadow or if one of its corners is out of sight.
        points: All corners in pixels.
    """

    what: Thing | Billboard
    away_m: float
    shapes: tuple[_Shape, ...]
    shadow: Fixed | None
    points: Matrix


class ObjectLayer:
    """Objects on a ground."""

    def __init__(self, population: Population, gallery: Billboards) -> None:
        self._population = population
        self._gallery = gallery

    def in_sight(self, view: View, time_s: float, hidden: frozenset[str] = frozenset()) -> list[_InSight]:
        """Return the visible objects at a time, the farthest first."""
        box = view.ground_within(_REACH * view.intrinsics.focal_px)
        if box is None:
            return []
        box = box + np.array([[-14.0, -14.0], [14.0, 14.0]])
        things = nearest(self._population.within(box, time_s), view.place, _MAX_THINGS)
        in_sight = _thing_actors(view, [thing for thing in things if thing.id not in hidden])
        boards = [_board_actor(view, board) for board in self._gallery.within(box) if board.id not in hidden]
        in_sight += [item for item in boards if item is not None]
        return sorted(in_sight, key=lambda item: (-item.away_m, item.what.id))

    def draw(self, picture: Picture, view: View, in_sight: list[_InSight], band: Band) -> None:
        """Draw the visible objects."""
        if band == "rgb":
            for item in in_sight:
                if item.shadow is not None:
                    _darken(picture, item.shadow)
        for item in in_sight:
            if isinstance(item.what, Billboard):
                _draw_board(picture, view, item, item.what, band)
            else:
                for shape in item.shapes:
                    _fill(picture, shape, band)

    def truth(
        self, view: View, in_sight: list[_InSight], frame: LocalFrame
    ) -> tuple[tuple[Seen, ...], tuple[SeenFace, ...]]:
        """Return the visible objects and faces with their visible shares."""
        lens = view.intrinsics
        labels = np.zeros((lens.height, lens.width), np.int32)
        for number, item in enumerate(in_sight, start=1):
            for shape in item.shapes:
                cv2.fillConvexPoly(labels, shape.hull, (number,), cv2.LINE_8, _SHIFT)
        objects = []
        faces = []
        for number, item in enumerate(in_sight, start=1):
            if isinstance(item.what, Billboard):
                face = _seen_face(view, item.what, labels, number, frame)
                if face is not None:
                    faces.append(face)
            else:
                shares = _shares(view, (shape.hull for shape in item.shapes), labels, number)
                seen = _seen_thing(view, item, item.what, shares, frame)
                if seen is not None:
                    objects.append(seen)
        return tuple(objects), tuple(faces)


def _thing_actors(view: View, things: list[Thing]) -> list[_InSight]:
    """Return the visible things. The corners of all things are projected in one step, which is faster."""
    if not things:
        return []
    place = np.array([(thing.x, thing.y) for thing in things]) - view.place
    away = np.hypot(np.hypot(place[:, 0], place[:, 1]), view.height_m)
    sizes = np.array([max(thing.size_m) for thing in things]) * view.intrinsics.focal_px / np.maximum(away, 0.1)
    parts = [_parts(thing, float(size)) for thing, size in zip(things, sizes, strict=True)]
    counts = np.array([sum(len(part.points) for part in body) for body in parts])
    corners = np.vstack([part.points for body in parts for part in body])
    world = _placed(things, corners, counts)
    pixels, depth = view.project(world)
    fallen = world.copy()
    fallen[:, :2] += world[:, 2:] * np.array(SUN_SHADOW)
    fallen[:, 2] = 0.0
    shade, shade_depth = view.project(fallen)
    starts = np.concatenate(([0], np.cumsum(counts)[:-1]))
    near = np.minimum.reduceat(depth, starts) < NEAR_M
    low = np.minimum.reduceat(pixels, starts)
    high = np.maximum.reduceat(pixels, starts)
    lens = view.intrinsics
    outside = (high <= 0).any(axis=1) | (low[:, 0] >= lens.width) | (low[:, 1] >= lens.height)
    shadeless = (np.minimum.reduceat(shade_depth, starts) < NEAR_M) | (sizes < _SHADELESS_PX)
    fixed = _fixed(pixels)
    fixed_shade = _fixed(shade)
    in_sight = []
    for k in np.flatnonzero(~near & ~outside & (sizes >= _TINY_PX)):
        span = np.s_[starts[k] : starts[k] + counts[k]]
        shadow = None if shadeless[k] else cv2.convexHull(fixed_shade[span])
        shapes = _shapes(fixed[span], parts[k])
        in_sight.append(_InSight(things[k], float(away[k]), shapes, _as_fixed(shadow), pixels[span]))
    return in_sight


def _parts(thing: Thing, size_px: float) -> tuple[Part, ...]:
    """Return the parts to draw at a size. Bodies of a few pixels are drawn as a silhouette."""
    if size_px < _SILHOUETTE_PX:
        return silhouette(thing)
    parts = parts_of(thing)
    return parts if size_px >= _SMALL_PX else tuple(part for part in parts if not part.detail)


def _placed(things: list[Thing], corners: Matrix, counts: NDArray[np.int64]) -> Matrix:
    """Return the corners of bodies in the world's frame, shape (n, 3)."""
    angles = np.radians([thing.heading_deg for thing in things])
    sines = np.repeat(np.sin(angles), counts)
    cosines = np.repeat(np.cos(angles), counts)
    x = np.repeat([thing.x for thing in things], counts) + corners[:, 0] * sines + corners[:, 1] * cosines
    y = np.repeat([thing.y for thing in things], counts) + corners[:, 0] * cosines - corners[:, 1] * sines
    return np.column_stack((x, y, corners[:, 2]))


def _shapes(fixed: Fixed, parts: tuple[Part, ...]) -> tuple[_Shape, ...]:
    shapes = []
    start = 0
    for part in parts:
        hull = np.asarray(cv2.convexHull(fixed[start : start + len(part.points)]), np.int32)
        shapes.append(_Shape(hull, part.colour, part.warmth))
        start += len(part.points)
    return tuple(shapes)


def _as_fixed(hull: object) -> Fixed | None:
    return None if hull is None else np.asarray(hull, np.int32)


def _board_actor(view: View, board: Billboard) -> _InSight | None:
    corners = board.corners()
    pixels, depth = view.project(corners)
    if bool((depth < NEAR_M).any()) or _outside(view, pixels):
        return None
    away = float(np.linalg.norm(corners.mean(axis=0) - [*view.place, view.height_m]))
    if float(np.ptp(pixels, axis=0).max()) < _MIN_BOARD_PX:
        return None
    shape = _Shape(_hull(pixels), _BOARD_BACK, _FRAME_WARMTH)
    return _InSight(board, away, (shape,), _shadow(view, corners) if board.standing else None, pixels)


def _outside(view: View, pixels: Matrix) -> bool:
    low = pixels.min(axis=0)
    high = pixels.max(axis=0)
    lens = view.intrinsics
    return bool(high[0] <= 0 or high[1] <= 0 or low[0] >= lens.width or low[1] >= lens.height)


def _shadow(view: View, world: Matrix) -> Fixed | None:
    fallen = world.copy()
    fallen[:, :2] += world[:, 2:] * np.array(SUN_SHADOW)
    fallen[:, 2] = 0.0
    pixels, depth = view.project(fallen)
    return None if bool((depth < NEAR_M).any()) else _hull(pixels)


def _hull(pixels: Matrix) -> Fixed:
    return np.asarray(cv2.convexHull(_fixed(pixels)), np.int32)


def _fixed(points: Matrix) -> Fixed:
    """Convert pixel coordinates to OpenCV's fixed-point coordinates, whose origin is the centre of the first pixel."""
    return np.round((np.clip(points, -_FAR_PX, _FAR_PX) - 0.5) * (1 << _SHIFT)).astype(np.int32)


def _fill(picture: Picture, shape: _Shape, band: Band) -> None:
    grey = shape.warmth
    colour = shape.colour if band == "rgb" else (grey, grey, grey)
    cv2.fillConvexPoly(picture, shape.hull, colour, cv2.LINE_AA, _SHIFT)


def _clip(low: Matrix, high: Matrix, shape: tuple[int, ...]) -> tuple[int, int, int, int] | None:
    """Return the pixels of a picture that a box touches, as left, top, right and bottom, or None."""
    x0 = max(math.floor(low[0]) - 1, 0)
    y0 = max(math.floor(low[1]) - 1, 0)
    x1 = min(math.ceil(high[0]) + 1, shape[1])
    y1 = min(math.ceil(high[1]) + 1, shape[0])
    return None if x0 >= x1 or y0 >= y1 else (x0, y0, x1, y1)


def _darken(picture: Picture, hull: Fixed) -> None:
    corners = hull[:, 0, :] / (1 << _SHIFT) + 0.5
    box = _clip(corners.min(axis=0), corners.max(axis=0), picture.shape)
    if box is None:
        return
    x0, y0, x1, y1 = box
    light = np.full((y1 - y0, x1 - x0, 3), 255, np.uint8)
    dark = int(255 * (1 - _SHADOW))
    shifted = hull - np.array([x0, y0], np.int32) * (1 << _SHIFT)
    cv2.fillConvexPoly(light, shifted.astype(np.int32), (dark + 10, dark, dark - 4), cv2.LINE_AA, _SHIFT)
    part = picture[y0:y1, x0:x1]
    part[:] = cv2.multiply(part, light, scale=1 / 255)


def _draw_board(picture: Picture, view: View, item: _InSight, board: Billboard, band: Band) -> None:
    viewer = np.array([*view.place, view.height_m])
    if board.standing:
        _draw_posts(picture, view, board, band)
    if not board.faces(viewer):
        _fill(picture, item.shapes[0], band)
        return
    box = _clip(item.points.min(axis=0), item.points.max(axis=0), picture.shape)
    if box is None:
        return
    x0, y0, x1, y1 = box
    size_px = max(
        float(np.linalg.norm(item.points[3] - item.points[0])),
        float(np.linalg.norm(item.points[2] - item.points[1])),
    )
    source = portrait(board.variation, max(math.floor(math.log2(max(300.0 / max(size_px, 1.0), 1.0))), 0))
    if band == "ir":
        source = np.full_like(source, 112)
    height, width = source.shape[:2]
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32) - 0.5
    target = (item.points - [x0, y0] - 0.5).astype(np.float32)
    matrix = cv2.getPerspectiveTransform(corners, target)
    drawn = cv2.warpPerspective(
        source, matrix, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    cover = np.zeros((y1 - y0, x1 - x0), np.uint8)
    cv2.fillConvexPoly(cover, _hull(item.points - [x0, y0]), (255,), cv2.LINE_AA, _SHIFT)
    weight = cover.astype(np.float32) / 255.0
    part = picture[y0:y1, x0:x1]
    part[:] = cv2.blendLinear(np.asarray(drawn, np.uint8), np.ascontiguousarray(part), weight, 1.0 - weight)


def _draw_posts(picture: Picture, view: View, board: Billboard, band: Band) -> None:
    lower = board.corners()[2:]
    for share in (0.15, 0.85):
        top = lower[0] + share * (lower[1] - lower[0])
        foot = np.array([top[0], top[1], 0.0])
        pixels, depth = view.project(np.array([top, foot]))
        if not bool((depth < NEAR_M).any()):
            width = max(0.12 * view.intrinsics.focal_px / float(depth.min()), 1.0)
            ends = _fixed(pixels)
            colour = _BOARD_BACK if band == "rgb" else (_FRAME_WARMTH,) * 3
            cv2.line(picture, ends[0], ends[1], colour, min(round(width), 60), cv2.LINE_AA, _SHIFT)


def _box(points: Matrix, view: View) -> Box | None:
    lens = view.intrinsics
    low = points.min(axis=0)
    high = points.max(axis=0)
    left = max(float(low[0]), 0.0)
    top = max(float(low[1]), 0.0)
    right = min(float(high[0]), float(lens.width))
    bottom = min(float(high[1]), float(lens.height))
    return None if left >= right or top >= bottom else (left, top, right, bottom)


def _shares(view: View, hulls: Iterable[Fixed], labels: Labels, number: int) -> tuple[float, float]:
    """Return the share of hulls inside the picture, and the share that is also not occluded.

    Args:
        view: Geometry of the picture.
        hulls: Parts of the object.
        labels: Number of the nearest object at each pixel.
        number: Number of the object.
    """
    pieces = list(hulls)
    points = np.vstack(pieces)[:, 0, :] / (1 << _SHIFT)
    low = np.floor(points.min(axis=0)) - 1
    high = np.ceil(points.max(axis=0)) + 2
    limit = 4.0 * max(view.intrinsics.width, view.intrinsics.height)
    low = np.maximum(low, -limit).astype(int)
    high = np.minimum(high, limit).astype(int)
    whole = np.zeros((int(high[1] - low[1]), int(high[0] - low[0])), np.uint8)
    for piece in pieces:
        cv2.fillConvexPoly(whole, piece - (low << _SHIFT).astype(np.int32), (1,), cv2.LINE_8, _SHIFT)
    total = int(np.count_nonzero(whole))
    x0 = max(int(low[0]), 0)
    y0 = max(int(low[1]), 0)
    x1 = min(int(high[0]), labels.shape[1])
    y1 = min(int(high[1]), labels.shape[0])
    if total == 0 or x0 >= x1 or y0 >= y1:
        return 0.0, 0.0
    inside = whole[y0 - low[1] : y1 - low[1], x0 - low[0] : x1 - low[0]] > 0
    visible = inside & (labels[y0:y1, x0:x1] == number)
    return float(np.count_nonzero(inside) / total), float(np.count_nonzero(visible) / total)


def _true_heading(view: View, heading_deg: float) -> float:
    """Convert a heading in the world's frame to a heading from true north at the camera."""
    angle = math.radians(heading_deg)
    east, north = view.from_world @ np.array([math.sin(angle), math.cos(angle)])
    return math.degrees(math.atan2(east, north))


def _seen_thing(
    view: View, item: _InSight, thing: Thing, shares: tuple[float, float], frame: LocalFrame
) -> Seen | None:
    box = _box(item.points, view)
    in_frame, visible = shares
    if box is None or in_frame == 0.0:
        return None
    lat, lon = frame.latlon(thing.x, thing.y)
    heading = _true_heading(view, thing.heading_deg)
    return Seen(thing.id, thing.kind, lat, lon, heading, thing.speed_mps, box, in_frame, visible)


def _seen_face(view: View, board: Billboard, labels: Labels, number: int, frame: LocalFrame) -> SeenFace | None:
    corners = board.face_corners()
    pixels, _ = view.project(corners)
    box = _box(pixels, view)
    if box is None:
        return None
    in_frame, visible = _shares(view, [_hull(pixels)], labels, number)
    if in_frame == 0.0:
        return None
    if not board.faces(np.array([*view.place, view.height_m])):
        visible = 0.0
    lat, lon = frame.latlon(board.x, board.y)
    height = float(np.linalg.norm(pixels[2:].mean(axis=0) - pixels[:2].mean(axis=0)))
    return SeenFace(board.id, lat, lon, board.standing, box, height, in_frame, visible)
