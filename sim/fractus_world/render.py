"""Rendering of the ground: perspective, level of detail by distance, haze and sky."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from fractus_world.optics import Matrix, View
from fractus_world.tiles import TILE_PX, Picture, TileStore, pixel_m

Band = Literal["rgb", "ir"]

CELL_PX = 16
"""Side of a cell in pixels. Detail and haze are computed once for each cell."""
VISIBILITY_M = 9000.0
FARTHEST_M = 25_000.0
_SPARE_PX = 5_000_000
_NOTHING = -1
_LEVEL_BIAS = 0.35


@dataclass(frozen=True, slots=True)
class Sky:
    """Colours (blue, green, red) of haze at the horizon and of the sky overhead."""

    horizon: tuple[float, float, float]
    zenith: tuple[float, float, float]


SKIES: dict[Band, Sky] = {
    "rgb": Sky((224.0, 213.0, 200.0), (196.0, 140.0, 84.0)),
    "ir": Sky((52.0, 52.0, 52.0), (12.0, 12.0, 12.0)),
}


def render_ground(view: View, store: TileStore, band: Band) -> Picture:
    """Return a picture of the ground and sky without objects, shape (height, width, 3); blue, green, red."""
    lens = view.intrinsics
    cells = _Cells.of(view, store)
    picture = np.empty((lens.height, lens.width, 3), np.uint8)
    beyond = np.flatnonzero((cells.levels == _NOTHING).any(axis=1))
    if len(beyond):
        first = int(beyond[0]) * CELL_PX
        last = (int(beyond[-1]) + 1) * CELL_PX
        cv2.rectangle(picture, (0, first), (lens.width, last), SKIES[band].horizon, -1)
    for level in np.unique(cells.levels):
        if level != _NOTHING:
            _draw_level(picture, view, store, int(level), cells)
    _add_air(picture, cells, SKIES[band])
    return picture


@dataclass(frozen=True, slots=True)
class _Cells:
    """Cells of a picture: level of detail per cell, and haze and elevation of the view rays at the corners of cells."""

    levels: NDArray[np.int64]
    haze: NDArray[np.float32]
    elevation: NDArray[np.float32]
    columns: int
    rows: int

    @classmethod
    def of(cls, view: View, store: TileStore) -> _Cells:
        lens = view.intrinsics
        columns = -(-lens.width // CELL_PX)
        rows = -(-lens.height // CELL_PX)
        u, v = np.meshgrid(np.arange(columns + 1) * CELL_PX, np.arange(rows + 1) * CELL_PX)
        pixels = np.stack((u, v), axis=-1).astype(np.float64)
        rays = view.rays(pixels)
        down = -rays[..., 2]
        flat = np.hypot(rays[..., 0], rays[..., 1])
        away = view.height_m * np.sqrt(flat**2 + down**2) / np.maximum(down, 1e-9)
        away = np.where(down > 1e-9, np.minimum(away, 1e7), 1e7)
        # A pixel covers h / f / down by h / f / down^2 of ground. The exponent is close to 2, which avoids flicker.
        size_m = view.height_m / lens.focal_px / np.maximum(down, 1e-9) ** 1.75
        level = np.log2(np.maximum(size_m, 1e-9) / store.ground.finest_m) + _LEVEL_BIAS
        level = np.clip(np.floor(level), 0, store.ground.levels - 1).astype(np.int64)
        level = np.where(away < FARTHEST_M, level, _NOTHING)
        corners = np.stack((level[:-1, :-1], level[1:, :-1], level[:-1, 1:], level[1:, 1:]))
        # A cell has the finest level of its corners, so that its near parts stay sharp.
        seen = np.where(corners == _NOTHING, 99, corners).min(axis=0)
        haze = 1.0 - np.exp(-((away / VISIBILITY_M) ** 1.2))
        elevation = np.arctan2(-down, flat)
        return cls(
            np.where(seen == 99, _NOTHING, seen), haze.astype(np.float32), elevation.astype(np.float32), columns, rows
        )


def _draw_level(picture: Picture, view: View, store: TileStore, level: int, cells: _Cells) -> None:
    """Draw all cells of one level."""
    marked = cells.levels == level
    rows = np.flatnonzero(marked.any(axis=1))
    columns = np.flatnonzero(marked.any(axis=0))
    left = int(columns[0]) * CELL_PX
    top = int(rows[0]) * CELL_PX
    right = min((int(columns[-1]) + 1) * CELL_PX, view.intrinsics.width)
    bottom = min((int(rows[-1]) + 1) * CELL_PX, view.intrinsics.height)
    window, level = _window(view, store, level, marked)
    source, source_x, source_y = store.mosaic(level, window)
    metres = pixel_m(store.ground, level)
    to_source = np.array([[1 / metres, 0.0, -source_x - 0.5], [0.0, -1 / metres, -source_y - 0.5], [0.0, 0.0, 1.0]])
    shift = np.array([[1.0, 0.0, left + 0.5], [0.0, 1.0, top + 0.5], [0.0, 0.0, 1.0]])
    mapping = to_source @ view.ground_matrix() @ shift
    target = picture[top:bottom, left:right]
    part = marked[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    drawn = _warped(source, mapping, (right - left, bottom - top))
    if part.all():
        target[:] = drawn
        return
    mask = np.repeat(np.repeat(part, CELL_PX, axis=0), CELL_PX, axis=1)[: bottom - top, : right - left]
    cv2.copyTo(drawn, mask.astype(np.uint8), target)


def _warped(source: Picture, mapping: Matrix, size: tuple[int, int]) -> Picture:
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    border = cv2.BORDER_REPLICATE
    if float(np.abs(mapping[2, :2]).max()) * max(size) < 1e-9 * abs(float(mapping[2, 2])):
        # A view straight down has no perspective. An affine transformation is then exact, and takes half the time.
        drawn = cv2.warpAffine(source, mapping[:2] / mapping[2, 2], size, flags=flags, borderMode=border)
    else:
        drawn = cv2.warpPerspective(source, mapping, size, flags=flags, borderMode=border)
    return np.asarray(drawn, np.uint8)


def _window(
    view: View, store: TileStore, level: int, marked: NDArray[np.bool_]
) -> tuple[tuple[int, int, int, int], int]:
    """Return the window of a level that the marked cells need, and the level.

    The level is coarser for a large window.
    """
    # The ends of the rows of cells are sufficient, because the extreme ground points are there.
    rows = np.flatnonzero(marked.any(axis=1))
    first = marked[rows].argmax(axis=1)
    last = marked.shape[1] - marked[rows][:, ::-1].argmax(axis=1)
    corners = np.array([(c, r + d) for r, f, e in zip(rows, first, last, strict=True) for c in (f, e) for d in (0, 1)])
    corners = np.minimum(corners * float(CELL_PX), [view.intrinsics.width, view.intrinsics.height])
    most = _SPARE_PX + 3 * view.intrinsics.width * view.intrinsics.height
    ground = _on_ground(view, corners)
    while True:
        metres = pixel_m(store.ground, level)
        west = math.floor(ground[:, 0].min() / metres) - 1
        north = math.floor(-ground[:, 1].max() / metres) - 1
        east = math.ceil(ground[:, 0].max() / metres) + 2
        south = math.ceil(-ground[:, 1].min() / metres) + 2
        area = (east - west + TILE_PX) * (south - north + TILE_PX)
        if area <= most or level >= store.ground.levels - 1:
            return (west, north, east, south), level
        level += 1


def _on_ground(view: View, corners: Matrix) -> Matrix:
    points = np.column_stack((corners, np.ones(len(corners)))) @ view.ground_matrix().T
    steepest = -view.height_m / FARTHEST_M
    depth = np.minimum(points[:, 2], steepest)
    ground: Matrix = points[:, :2] / depth[:, None]
    away = ground - view.place
    far = np.linalg.norm(away, axis=1)
    return np.asarray(view.place + away * np.minimum(1.0, FARTHEST_M / np.maximum(far, 1e-9))[:, None])


def _add_air(picture: Picture, cells: _Cells, sky: Sky) -> None:
    """Blend haze over distant ground, and the sky over the remainder."""
    rows = np.flatnonzero((cells.haze > 0.01).any(axis=1))
    if len(rows) == 0:
        return
    first = max(int(rows[0]) - 1, 0)
    last = min(int(rows[-1]) + 1, cells.rows)
    height, width = picture.shape[:2]
    top = first * CELL_PX
    bottom = min(last * CELL_PX, height)
    if bottom <= top:
        return
    weight = _enlarged(cells.haze[first : last + 1])[: bottom - top, :width]
    up = np.clip(cells.elevation[first : last + 1] / math.radians(40.0), 0.0, 1.0) ** 0.6
    near = np.array(sky.horizon)
    far = np.array(sky.zenith)
    colours = np.round(near + (far - near) * up[..., None]).astype(np.uint8)
    air = _enlarged(colours)[: bottom - top, :width]
    cv2.blendLinear(picture[top:bottom], air, 1.0 - weight, weight, dst=picture[top:bottom])


def _enlarged(corners: NDArray[Any]) -> NDArray[Any]:
    """Return a value for every pixel, interpolated from values at the corners of cells."""
    size = (corners.shape[1] * CELL_PX, corners.shape[0] * CELL_PX)
    whole = cv2.resize(np.ascontiguousarray(corners), size, interpolation=cv2.INTER_LINEAR)
    # `resize` places the value of a corner at the centre of a cell.
    half = CELL_PX // 2
    return np.asarray(whole)[half:-half, half:-half]
