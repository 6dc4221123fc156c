"""Draws what stands and moves on the ground into a picture, and finds out what of it can be seen."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from fractus_core.geo import LocalFrame
from numpy.typing import NDArray

from fractus_sim.world.billboards import Billboard, Gallery, portrait
from fractus_sim.world.bodies import Part, parts_of, placed
from fractus_sim.world.canvas import SUN_SHADOW
from fractus_sim.world.optics import NEAR_M, Matrix, View
from fractus_sim.world.population import Population, Thing, nearest
from fractus_sim.world.render import Band
from fractus_sim.world.truth import Box, Seen, SeenFace

Picture = NDArray[np.uint8]
Labels = NDArray[np.int32]

_SHIFT = 4
_MOST_THINGS = 500
_SMALL_PX = 14.0
_TINY_PX = 1.2
_REACH = 0.9
"""Things are drawn as far away as so many focal lengths in pixels are metres."""
_SHADOW = 0.5
_BOARD_BACK = (96, 100, 104)
_FRAME_WARMTH = 118
_FAR_PX = 30_000.0


@dataclass(frozen=True, slots=True)
class _Shape:
    """A convex piece of something, in pixels."""

    hull: Matrix
    part: Part


@dataclass(frozen=True, slots=True)
class _Actor:
    """A thing or billboard in sight.

    Attributes:
        what: The thing or billboard.
        away_m: From the camera; what is nearer covers what is farther.
        shapes: Its parts as they are drawn; a billboard's one.
        shadow: Its shadow in pixels; None when a corner of it is out of sight.
        points: All its corners in pixels.
    """

    what: Thing | Billboard
    away_m: float
    shapes: tuple[_Shape, ...]
    shadow: Matrix | None
    points: Matrix


class Stage:
    """What stands and moves on a ground."""

    def __init__(self, population: Population, gallery: Gallery) -> None:
        self._population = population
        self._gallery = gallery

    def actors(self, view: View, time_s: float, hidden: frozenset[str] = frozenset()) -> list[_Actor]:
        """What is in sight at a time, the farthest first."""
        box = view.ground_within(_REACH * view.intrinsics.focal_px)
        if box is None:
            return []
        box = box + np.array([[-14.0, -14.0], [14.0, 14.0]])
        things = nearest(self._population.within(box, time_s), view.place, _MOST_THINGS)
        actors = [_thing_actor(view, thing) for thing in things if thing.id not in hidden]
        actors += [_board_actor(view, board) for board in self._gallery.within(box) if board.id not in hidden]
        seen = [actor for actor in actors if actor is not None]
        return sorted(seen, key=lambda actor: (-actor.away_m, actor.what.id))

    def draw(self, picture: Picture, view: View, actors: list[_Actor], band: Band) -> None:
        """Draw what is in sight."""
        if band == "rgb":
            for actor in actors:
                if actor.shadow is not None:
                    _darken(picture, actor.shadow)
        for actor in actors:
            if isinstance(actor.what, Billboard):
                _draw_board(picture, view, actor, actor.what, band)
            else:
                for shape in actor.shapes:
                    grey = shape.part.warmth
                    _fill(picture, shape.hull, shape.part.colour if band == "rgb" else (grey, grey, grey))

    def truth(
        self, view: View, actors: list[_Actor], frame: LocalFrame
    ) -> tuple[tuple[Seen, ...], tuple[SeenFace, ...]]:
        """What of each can be seen."""
        lens = view.intrinsics
        labels = np.zeros((lens.height, lens.width), np.int32)
        for number, actor in enumerate(actors, start=1):
            for shape in actor.shapes:
                cv2.fillConvexPoly(labels, _fixed(shape.hull), (number,), cv2.LINE_8, _SHIFT)
        objects, faces = [], []
        for number, actor in enumerate(actors, start=1):
            if isinstance(actor.what, Billboard):
                face = _seen_face(view, actor.what, labels, number, frame)
                if face is not None:
                    faces.append(face)
            else:
                shares = _shares(view, (shape.hull for shape in actor.shapes), labels, number)
                seen = _seen_thing(view, actor, actor.what, shares, frame)
                if seen is not None:
                    objects.append(seen)
        return tuple(objects), tuple(faces)


def _thing_actor(view: View, thing: Thing) -> _Actor | None:
    length = thing.size_m[0]
    away = math.dist((thing.x, thing.y, 0.0), (*view.place, view.height_m))
    size_px = length * view.intrinsics.focal_px / max(away, 0.1)
    if size_px < _TINY_PX:
        return None
    parts = [part for part in parts_of(thing) if size_px >= _SMALL_PX or not part.detail]
    corners = np.vstack([part.points for part in parts])
    world = placed(thing, corners)
    pixels, depth = view.project(world)
    if bool((depth < NEAR_M).any()) or _outside(view, pixels):
        return None
    cuts = np.cumsum([len(part.points) for part in parts])[:-1]
    shapes = tuple(_Shape(_hull(piece), part) for piece, part in zip(np.split(pixels, cuts), parts, strict=True))
    return _Actor(thing, away, shapes, _shadow(view, world), pixels)


def _board_actor(view: View, board: Billboard) -> _Actor | None:
    corners = board.corners()
    pixels, depth = view.project(corners)
    if bool((depth < NEAR_M).any()) or _outside(view, pixels):
        return None
    away = float(np.linalg.norm(corners.mean(axis=0) - [*view.place, view.height_m]))
    shape = _Shape(_hull(pixels), Part(corners, _BOARD_BACK, _FRAME_WARMTH))
    return _Actor(board, away, (shape,), _shadow(view, corners) if board.standing else None, pixels)


def _outside(view: View, pixels: Matrix) -> bool:
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    lens = view.intrinsics
    return bool(high[0] <= 0 or high[1] <= 0 or low[0] >= lens.width or low[1] >= lens.height)


def _shadow(view: View, world: Matrix) -> Matrix | None:
    fallen = world.copy()
    fallen[:, :2] += world[:, 2:] * np.array(SUN_SHADOW)
    fallen[:, 2] = 0.0
    pixels, depth = view.project(fallen)
    return None if bool((depth < NEAR_M).any()) else _hull(pixels)


def _hull(pixels: Matrix) -> Matrix:
    return np.asarray(cv2.convexHull(pixels.astype(np.float32)), np.float64).reshape(-1, 2)


def _fixed(points: Matrix) -> NDArray[np.int32]:
    """Pixel coordinates as OpenCV's fixed-point numbers, whose origin is the middle of the first pixel."""
    return np.round((np.clip(points, -_FAR_PX, _FAR_PX) - 0.5) * (1 << _SHIFT)).astype(np.int32)


def _fill(picture: Picture, hull: Matrix, colour: tuple[int, int, int]) -> None:
    cv2.fillConvexPoly(picture, _fixed(hull), colour, cv2.LINE_AA, _SHIFT)


def _clip(low: Matrix, high: Matrix, shape: tuple[int, ...]) -> tuple[int, int, int, int] | None:
    """The whole pixels of a picture that a box touches; None when there are none."""
    x0, y0 = max(math.floor(low[0]) - 1, 0), max(math.floor(low[1]) - 1, 0)
    x1, y1 = min(math.ceil(high[0]) + 1, shape[1]), min(math.ceil(high[1]) + 1, shape[0])
    return None if x0 >= x1 or y0 >= y1 else (x0, y0, x1, y1)


def _darken(picture: Picture, hull: Matrix) -> None:
    found = _clip(hull.min(axis=0), hull.max(axis=0), picture.shape)
    if found is None:
        return
    x0, y0, x1, y1 = found
    light = np.full((y1 - y0, x1 - x0, 3), 255, np.uint8)
    dark = int(255 * (1 - _SHADOW))
    cv2.fillConvexPoly(light, _fixed(hull - [x0, y0]), (dark + 10, dark, dark - 4), cv2.LINE_AA, _SHIFT)
    part = picture[y0:y1, x0:x1]
    part[:] = cv2.multiply(part, light, scale=1 / 255)


def _draw_board(picture: Picture, view: View, actor: _Actor, board: Billboard, band: Band) -> None:
    viewer = np.array([*view.place, view.height_m])
    if board.standing:
        _draw_posts(picture, view, board, band)
    if not board.faces(viewer):
        grey = _FRAME_WARMTH
        _fill(picture, actor.shapes[0].hull, _BOARD_BACK if band == "rgb" else (grey, grey, grey))
        return
    found = _clip(actor.points.min(axis=0), actor.points.max(axis=0), picture.shape)
    if found is None:
        return
    x0, y0, x1, y1 = found
    size_px = max(
        float(np.linalg.norm(actor.points[3] - actor.points[0])),
        float(np.linalg.norm(actor.points[2] - actor.points[1])),
    )
    source = portrait(board.variation, max(math.floor(math.log2(max(300.0 / max(size_px, 1.0), 1.0))), 0))
    if band == "ir":
        source = np.full_like(source, 112)
    height, width = source.shape[:2]
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32) - 0.5
    target = (actor.points - [x0, y0] - 0.5).astype(np.float32)
    matrix = cv2.getPerspectiveTransform(corners, target)
    drawn = cv2.warpPerspective(
        source, matrix, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    cover = np.zeros((y1 - y0, x1 - x0), np.uint8)
    cv2.fillConvexPoly(cover, _fixed(actor.shapes[0].hull - [x0, y0]), (255,), cv2.LINE_AA, _SHIFT)
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
    low, high = points.min(axis=0), points.max(axis=0)
    left, top = max(float(low[0]), 0.0), max(float(low[1]), 0.0)
    right, bottom = min(float(high[0]), float(lens.width)), min(float(high[1]), float(lens.height))
    return None if left >= right or top >= bottom else (left, top, right, bottom)


def _shares(view: View, hulls: Iterable[Matrix], labels: Labels, number: int) -> tuple[float, float]:
    """Which share of some hulls is in the picture, and which is also labelled with a number."""
    pieces = [_fixed(hull) for hull in hulls]
    points = np.vstack(pieces) / (1 << _SHIFT)
    low, high = np.floor(points.min(axis=0)) - 1, np.ceil(points.max(axis=0)) + 2
    limit = 4.0 * max(view.intrinsics.width, view.intrinsics.height)
    low, high = np.maximum(low, -limit).astype(int), np.minimum(high, limit).astype(int)
    whole = np.zeros((int(high[1] - low[1]), int(high[0] - low[0])), np.uint8)
    for piece in pieces:
        cv2.fillConvexPoly(whole, piece - (low << _SHIFT).astype(np.int32), (1,), cv2.LINE_8, _SHIFT)
    total = int(np.count_nonzero(whole))
    x0, y0 = max(int(low[0]), 0), max(int(low[1]), 0)
    x1, y1 = min(int(high[0]), labels.shape[1]), min(int(high[1]), labels.shape[0])
    if total == 0 or x0 >= x1 or y0 >= y1:
        return 0.0, 0.0
    inside = whole[y0 - low[1] : y1 - low[1], x0 - low[0] : x1 - low[0]] > 0
    visible = inside & (labels[y0:y1, x0:x1] == number)
    return np.count_nonzero(inside) / total, np.count_nonzero(visible) / total


def _true_heading(view: View, heading_deg: float) -> float:
    """A direction of the world's frame as one from true north at the camera."""
    angle = math.radians(heading_deg)
    east, north = np.linalg.inv(view.turn) @ np.array([math.sin(angle), math.cos(angle)])
    return math.degrees(math.atan2(east, north))


def _seen_thing(view: View, actor: _Actor, thing: Thing, shares: tuple[float, float], frame: LocalFrame) -> Seen | None:
    box = _box(actor.points, view)
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
