"""Approximate thermal appearance of a ground: white is hot. The values are not radiometric."""

from __future__ import annotations

import cv2
import numpy as np

from fractus_world.tiles import Picture, TileStore

# Weights of blue, green and red, and an offset. Water is cold, plants (green) are cool, asphalt and roofs are warmer.
_WEIGHTS = np.array([[-0.10, -0.28, 0.62, 62.0]] * 3)


class ThermalGround:
    """Thermal picture of another ground. See `tiles.Ground`.

    Args:
        daylight: Tiles of the other ground.
    """

    def __init__(self, daylight: TileStore) -> None:
        self._daylight = daylight
        self.frame = daylight.ground.frame
        self.finest_m = daylight.ground.finest_m
        self.levels = daylight.ground.levels

    def tile(self, level: int, column: int, row: int) -> Picture:
        """Return one tile as grey values."""
        return np.asarray(cv2.transform(self._daylight.tile(level, column, row), _WEIGHTS), np.uint8)
