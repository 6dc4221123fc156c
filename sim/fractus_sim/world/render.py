"""The ground as a camera sees it: perspective, detail that fits the distance, haze and sky."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from fractus_sim.world.optics import Matrix, View
from fractus_sim.world.thermal import thermal
from fractus_sim.world.tiles import TILE_PX, Picture, TileStore, pixel_m

Band = Literal["rgb", "ir"]

CELL_PX = 16
"""Detail and haze are worked out once for a cell of so many pixels."""
VISIBILITY_M = 9000.0
FARTHEST_M = 25_000.0
MAX_MOSAIC_PX = 24_000_000
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
    """The picture without anything that moves or stands, (height, width, 3), blue, green, red."""
    lens = view.intrinsics
    cells = _Cells.of(view, store)
    picture = np.empty((lens.height, lens.width, 3), np.uint8)
    picture[:] = np.array(SKIES[band].horizon, np.uint8)
    for level in np.unique(cells.levels):
        if level != _NOTHING:
            _draw_level(picture, view, store, int(level), cells)
    if band == "ir":
        thermal(picture)
    _add_air(picture, cells, SKIES[band])
    return picture


@dataclass(frozen=True, slots=True)
class _Cells:
    """What changes slowly over a picture, at the corners of cells: detail, distance, elevation of the ray."""

    levels: NDArray[np.int64]
    haze: NDArray[np.float32]
    elevation: NDArray[np.float32]
    columns: int
    rows: int

    @classmethod
    def of(cls, view: View, store: TileStore) -> _Cells:
        lens = view.intrinsics
        columns, rows = -(-lens.width // CELL_PX), -(-lens.height // CELL_PX)
        u, v = np.meshgrid(np.arange(columns + 1) * CELL_PX, np.arange(rows + 1) * CELL_PX)
        pixels = np.stack((u, v), axis=-1).astype(np.float64)
        rays = view.rays(pixels)
        down, flat = -rays[..., 2], np.hypot(rays[..., 0], rays[..., 1])
        away = view.height_m * np.sqrt(flat**2 + down**2) / np.maximum(down, 1e-9)
        away = np.where(down > 1e-9, np.minimum(away, 1e7), 1e7)
        # The area of a pixel on the ground is the homography's Jacobian: h^2 / f^2 / down^3.
        size_m = view.height_m / lens.focal_px / np.maximum(down, 1e-9) ** 1.5
        level = np.log2(np.maximum(size_m, 1e-9) / store.ground.finest_m) + _LEVEL_BIAS
        level = np.clip(np.floor(level), 0, store.ground.levels - 1).astype(np.int64)
        level = np.where(away < FARTHEST_M, level, _NOTHING)
        corners = np.stack((level[:-1, :-1], level[1:, :-1], level[:-1, 1:], level[1:, 1:]))
        # A cell takes the finest level of its corners, so that what is near stays sharp.
        seen = np.where(corners == _NOTHING, 99, corners).min(axis=0)
        haze = 1.0 - np.exp(-((away / VISIBILITY_M) ** 1.2))
        elevation = np.arctan2(-down, flat)
        return cls(
            np.where(seen == 99, _NOTHING, seen), haze.astype(np.float32), elevation.astype(np.float32), columns, rows
        )


def _draw_level(picture: Picture, view: View, store: TileStore, level: int, cells: _Cells) -> None:
    """Draw all cells of one level."""
    marked = cells.levels == level
    rows, columns = np.flatnonzero(marked.any(axis=1)), np.flatnonzero(marked.any(axis=0))
    left, top = int(columns[0]) * CELL_PX, int(rows[0]) * CELL_PX
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
    drawn = cv2.warpPerspective(
        source,
        mapping,
        (right - left, bottom - top),
        dst=target if target.flags.c_contiguous and part.all() else None,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    if part.all():
        if drawn is not target:
            target[:] = drawn
        return
    mask = np.repeat(np.repeat(part, CELL_PX, axis=0), CELL_PX, axis=1)[: bottom - top, : right - left]
    cv2.copyTo(np.asarray(drawn, np.uint8), mask.astype(np.uint8), target)


def _window(
    view: View, store: TileStore, level: int, marked: NDArray[np.bool_]
) -> tuple[tuple[int, int, int, int], int]:
    """The level's pixels that the marked cells show; a coarser level where that would be too many."""
    rows, columns = np.nonzero(marked)
    offsets = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
    corners = (np.stack((columns, rows), axis=-1)[:, None, :] + offsets[None]).reshape(-1, 2) * float(CELL_PX)
    corners = np.minimum(corners, [view.intrinsics.width, view.intrinsics.height])
    ground = _on_ground(view, corners)
    while True:
        metres = pixel_m(store.ground, level)
        west, north = math.floor(ground[:, 0].min() / metres) - 1, math.floor(-ground[:, 1].max() / metres) - 1
        east, south = math.ceil(ground[:, 0].max() / metres) + 2, math.ceil(-ground[:, 1].min() / metres) + 2
        area = (east - west + TILE_PX) * (south - north + TILE_PX)
        if area <= MAX_MOSAIC_PX or level >= store.ground.levels - 1:
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
    """Blend haze over what is far, and the sky over what is not ground."""
    rows = np.flatnonzero((cells.haze > 0.01).any(axis=1))
    if len(rows) == 0:
        return
    first, last = max(int(rows[0]) - 1, 0), min(int(rows[-1]) + 1, cells.rows)
    height, width = picture.shape[:2]
    top, bottom = first * CELL_PX, min(last * CELL_PX, height)
    if bottom <= top:
        return
    weight = _enlarged(cells.haze[first : last + 1], (width, bottom - top))
    up = np.clip(cells.elevation[first : last + 1] / math.radians(40.0), 0.0, 1.0) ** 0.6
    shade = _enlarged(up, (width, bottom - top))
    colours = np.stack(
        [np.linspace(near, far, 256) for near, far in zip(sky.horizon, sky.zenith, strict=True)], axis=-1
    )
    table = np.round(colours).astype(np.uint8).reshape(256, 1, 3)
    index = (shade * 255.0).astype(np.uint8)
    air = cv2.LUT(cv2.merge([index, index, index]), table)
    part = picture[top:bottom]
    picture[top:bottom] = cv2.blendLinear(part, air, 1.0 - weight, weight)


def _enlarged(values: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Values at the corners of cells, interpolated at every pixel."""
    whole = np.empty((size[1], size[0]), np.float32)
    scale = 1.0 / CELL_PX
    matrix = np.array([[scale, 0.0, 0.5 * scale], [0.0, scale, 0.5 * scale]])
    cv2.warpAffine(
        np.ascontiguousarray(values, np.float32),
        matrix,
        size,
        dst=whole,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return whole
