"""Approximate thermal appearance of a ground: white is hot. The values are not radiometric."""

from __future__ import annotations

import cv2
import numpy as np

from fractus_world.tiles import Picture, TileStore

# Grey value from blue, green, red: plants (green) are cool, asphalt and roofs (grey, red) are warmer, water is cold.
_WEIGHTS = np.array([[-0.10, -0.28, 0.62, 62.0]] * 3)


class ThermalGround:
    """The warmth of another ground; see `tiles.Ground`.

    Args:
        daylight: Tiles of the other ground.
    """

    def __init__(self, daylight: TileStore) -> None:
        self._daylight = daylight
        self.frame = daylight.ground.frame
        self.finest_m = daylight.ground.finest_m
        self.levels = daylight.ground.levels

    def tile(self, level: int, column: int, row: int) -> Picture:
        """The warmth of one tile."""
        return np.asarray(cv2.transform(self._daylight.tile(level, column, row), _WEIGHTS), np.uint8)
