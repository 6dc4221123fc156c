"""Tiles of a ground, drawn when a camera first sees them, and a cache with a size limit."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any, Protocol

import numpy as np
from fractus_core.geo import LocalFrame
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

TILE_PX = 512
_MOSAIC_BYTES = 60_000_000


class Ground(Protocol):
    """Ground as an unbounded picture with levels of detail. Each level has half the resolution of the previous one.

    Attributes:
        frame: Metres east and north of the world's origin.
        finest_m: Pixel size of level 0 on the ground, metres.
        levels: Number of levels.
    """

    frame: LocalFrame
    finest_m: float
    levels: int

    def tile(self, level: int, column: int, row: int) -> Picture:
        """Return one tile (blue, green, red), north up.

        Tile (0, 0) is south-east of the origin. Rows count southward.
        """


def pixel_m(ground: Ground, level: int) -> float:
    """Return the size of a pixel of a level on the ground, in metres."""
    return float(ground.finest_m * 2**level)


class TileStore:
    """Cache of recently used tiles, and of the last mosaic of each level.

    Args:
        ground: Creates the tiles.
        limit_bytes: Maximum total size of the tiles.
    """

    def __init__(self, ground: Ground, limit_bytes: int = 70_000_000) -> None:
        self.ground = ground
        self.made = 0
        self._limit = max(limit_bytes // (TILE_PX * TILE_PX * 3), 16)
        self._tiles: OrderedDict[tuple[int, int, int], Picture] = OrderedDict()
        self._mosaics: dict[int, tuple[tuple[int, int, int, int], Picture]] = {}
        self._lock = threading.Lock()

    def mosaic(self, level: int, window: tuple[int, int, int, int]) -> tuple[Picture, int, int]:
        """Return a picture of adjacent tiles that covers a window (left, top, right, bottom; x east, y south) of a level.

        Returns:
            The picture, and the level's pixel coordinates of its upper left corner.
        """
        left = window[0] // TILE_PX
        top = window[1] // TILE_PX
        right = -(-window[2] // TILE_PX)
        bottom = -(-window[3] // TILE_PX)
        needed = (left, top, right, bottom)
        known = self._mosaics.get(level)
        if known is not None and _covers(known[0], needed):
            return known[1], known[0][0] * TILE_PX, known[0][1] * TILE_PX
        picture = np.empty(((bottom - top) * TILE_PX, (right - left) * TILE_PX, 3), np.uint8)
        for row in range(top, bottom):
            for column in range(left, right):
                y = (row - top) * TILE_PX
                x = (column - left) * TILE_PX
                picture[y : y + TILE_PX, x : x + TILE_PX] = self.tile(level, column, row)
        self._keep(level, needed, picture)
        return picture, left * TILE_PX, top * TILE_PX

    def _keep(self, level: int, window: tuple[int, int, int, int], picture: Picture) -> None:
        self._mosaics.pop(level, None)
        self._mosaics[level] = (window, picture)
        while len(self._mosaics) > 1 and sum(kept.nbytes for _, kept in self._mosaics.values()) > _MOSAIC_BYTES:
            del self._mosaics[next(iter(self._mosaics))]

    def tile(self, level: int, column: int, row: int) -> Picture:
        """Return one tile."""
        key = (level, column, row)
        with self._lock:
            tile = self._tiles.get(key)
            if tile is not None:
                self._tiles.move_to_end(key)
                return tile
        tile = self.ground.tile(level, column, row)
        self.made += 1
        with self._lock:
            self._tiles[key] = tile
            while len(self._tiles) > self._limit:
                self._tiles.popitem(last=False)
        return tile


def interpolated(grid: NDArray[np.float64], at: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Interpolate a square grid. `at` contains the positions of both the rows and the columns of the result."""
    first = np.minimum(at.astype(int), len(grid) - 2)
    weights = np.zeros((len(at), len(grid)))
    weights[np.arange(len(at)), first] = 1.0 - (at - first)
    weights[np.arange(len(at)), first + 1] = at - first
    return np.asarray(weights @ grid @ weights.T, np.float32)


def _covers(outer: tuple[int, int, int, int], inner: tuple[int, int, int, int]) -> bool:
    return outer[0] <= inner[0] and outer[1] <= inner[1] and outer[2] >= inner[2] and outer[3] >= inner[3]
