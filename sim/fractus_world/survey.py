"""Map of the world's ground: a north-up picture in degrees (EPSG:4326) with its world file."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from fractus_core.geo import LocalFrame

from fractus_world.tiles import Picture, TileStore, interpolated, pixel_m

_METRES_PER_DEGREE = 111_320.0
_GRID_PX = 64


@dataclass(frozen=True, slots=True)
class Sheet:
    """The area of a map.

    Attributes:
        lat: Latitude of the centre, degrees.
        lon: Longitude of the centre, degrees.
        metres: Length of a side.
        pixels: Pixels along a side.
    """

    lat: float
    lon: float
    metres: float = 600.0
    pixels: int = 1024

    def __post_init__(self) -> None:
        if not (abs(self.lat) <= 85.0 and abs(self.lon) <= 180.0):
            raise ValueError("orthophoto: lat must be between -85 and 85, and lon between -180 and 180")
        if not 1.0 <= self.metres <= 20_000.0:
            raise ValueError(f"orthophoto: metres={self.metres:g} is not between 1 and 20000")
        if not 16 <= self.pixels <= 4096:
            raise ValueError(f"orthophoto: pixels={self.pixels} is not between 16 and 4096")

    @property
    def step_deg(self) -> tuple[float, float]:
        """Width and height of a pixel in degrees of longitude and latitude."""
        metres = self.metres / self.pixels
        return metres / _METRES_PER_DEGREE / math.cos(math.radians(self.lat)), metres / _METRES_PER_DEGREE

    def world_file(self) -> str:
        """Return the six lines of a world file. Its position is the centre of the first pixel."""
        east, north = self.step_deg
        half = (self.pixels - 1) / 2.0
        numbers = (east, 0.0, 0.0, -north, self.lon - half * east, self.lat + half * north)
        return "".join(f"{number:.12f}\n" for number in numbers)


def draw_sheet(sheet: Sheet, store: TileStore, frame: LocalFrame) -> Picture:
    """Return a picture of the ground on a sheet, shape (pixels, pixels, 3)."""
    east, north = sheet.step_deg
    count = -(-sheet.pixels // _GRID_PX) + 1
    at = np.arange(count) * float(_GRID_PX)
    half = (sheet.pixels - 1) / 2.0
    lons, lats = np.meshgrid(sheet.lon + (at - half) * east, sheet.lat - (at - half) * north)
    ground = frame.xy_array(lats.ravel(), lons.ravel())
    level = round(math.log2(max(sheet.metres / sheet.pixels / store.ground.finest_m, 1.0)))
    level = min(level, store.ground.levels - 1)
    metres = pixel_m(store.ground, level)
    source = ground * [1 / metres, -1 / metres]
    low = np.floor(source.min(axis=0)).astype(int) - 1
    high = np.ceil(source.max(axis=0)).astype(int) + 2
    picture, left, top = store.mosaic(level, (int(low[0]), int(low[1]), int(high[0]), int(high[1])))
    maps = [
        interpolated((source[:, axis] - origin - 0.5).reshape(count, count), np.arange(sheet.pixels) / _GRID_PX)
        for axis, origin in ((0, left), (1, top))
    ]
    return np.asarray(cv2.remap(picture, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
