"""Ground from an aerial picture of the user: a GeoTIFF, or a PNG or JPEG with a world file."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import tifffile
from fractus_core.geo import LocalFrame
from PIL import Image, UnidentifiedImageError

from fractus_world.georeference import Georeference, GeoreferenceError, from_geotiff, parse_system, read_world_file
from fractus_world.optics import Matrix
from fractus_world.tiles import TILE_PX, Picture, interpolated

MAX_PIXELS = 400_000_000
OUTSIDE = (112, 118, 116)
"""Colour outside of the picture: blue, green, red."""
_GRID = 16
_LEVELS = 12


class Raster:
    """A ground from a picture. See `tiles.Ground`.

    Args:
        picture: Shape (height, width, 3); blue, green, red.
        reference: Georeference of the picture.
    """

    def __init__(self, picture: Picture, reference: Georeference) -> None:
        height, width = picture.shape[:2]
        lat, lon = reference.place(width / 2, height / 2)
        self.frame = LocalFrame(lat, lon)
        self.levels = _LEVELS
        self._reference = reference
        self._halved = [picture]
        across = [self.frame.xy(*reference.place(width / 2 + dx, height / 2 + dy)) for dx, dy in ((1, 0), (0, 1))]
        (ax, ay), (bx, by) = across
        self.finest_m = math.sqrt(abs(ax * by - ay * bx))
        if not 1e-4 < self.finest_m < 1000.0:
            raise GeoreferenceError(
                f"a pixel is {self.finest_m:g} m wide; check that the world file uses the units of its system"
            )

    def tile(self, level: int, column: int, row: int) -> Picture:
        """Return a tile, cut out of the picture, scaled and rotated."""
        grid = self._source(level, column, row) / 2.0**level
        source = self._half(level)
        low = np.floor(grid.reshape(-1, 2).min(axis=0)).astype(int) - 2
        high = np.ceil(grid.reshape(-1, 2).max(axis=0)).astype(int) + 3
        low = np.maximum(low, 0)
        high = np.minimum(high, [source.shape[1], source.shape[0]])
        blank = np.empty((TILE_PX, TILE_PX, 3), np.uint8)
        blank[:] = OUTSIDE
        if bool((low >= high).any()):
            return blank
        part = np.ascontiguousarray(source[low[1] : high[1], low[0] : high[0]])
        at = (np.arange(TILE_PX) + 0.5) * (_GRID / TILE_PX)
        maps = [interpolated(grid[..., axis] - low[axis] - 0.5, at) for axis in (0, 1)]
        border = cv2.BORDER_CONSTANT
        drawn = cv2.remap(part, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=border, borderValue=OUTSIDE)
        return np.asarray(drawn, np.uint8)

    def _source(self, level: int, column: int, row: int) -> Matrix:
        """Return pixel positions in the whole picture, at a grid of points of a tile, shape (n, n, 2)."""
        metres = self.finest_m * 2**level
        at = np.linspace(0.0, TILE_PX, _GRID + 1)
        x, y = np.meshgrid((column * TILE_PX + at) * metres, -(row * TILE_PX + at) * metres)
        places = np.array([self._place(float(e), float(n)) for e, n in zip(x.ravel(), y.ravel(), strict=True)])
        return self._reference.pixels(places[:, 0], places[:, 1]).reshape(_GRID + 1, _GRID + 1, 2)

    def _place(self, east_m: float, north_m: float) -> tuple[float, float]:
        # The frame cannot convert positions far beyond 1000 km. They are limited, because they are outside the picture.
        distance_m = math.hypot(east_m, north_m)
        share = min(1.0, 1e6 / distance_m) if distance_m else 1.0
        return self.frame.latlon(east_m * share, north_m * share)

    def _half(self, level: int) -> Picture:
        """Return the picture with its width and height halved `level` times."""
        while len(self._halved) <= level:
            last = self._halved[-1]
            size = (max(-(-last.shape[1] // 2), 1), max(-(-last.shape[0] // 2), 1))
            # For odd sizes, the last row or column is repeated, so that pixels keep their position.
            even = cv2.copyMakeBorder(
                last, 0, 2 * size[1] - last.shape[0], 0, 2 * size[0] - last.shape[1], cv2.BORDER_REPLICATE
            )
            self._halved.append(np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), np.uint8))
        return self._halved[level]


def read_raster(path: Path, crs: str | None = None, origin: tuple[float, float] | None = None) -> Raster:
    """Read a GeoTIFF, or a picture with a world file.

    Args:
        path: TIFF, PNG or JPEG.
        crs: System of the world file: `local`, `EPSG:4326` (default) or a projected system. A GeoTIFF contains its
            system.
        origin: Latitude and longitude of the origin of `local` coordinates.

    Raises:
        GeoreferenceError: The file cannot be read or has no georeference.
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        return _read_tiff(path, crs, origin)
    try:
        with Image.open(path) as image:
            _check_size(path, image.width, image.height)
            pixels = np.asarray(image.convert("RGB"))
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise GeoreferenceError(f"{path}: cannot be read as a picture: {error}") from error
    reference = read_world_file(path, parse_system(crs or "EPSG:4326", origin))
    return Raster(np.ascontiguousarray(pixels[..., ::-1]), reference)


def _read_tiff(path: Path, crs: str | None, origin: tuple[float, float] | None) -> Raster:
    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            _check_size(path, page.imagewidth, page.imagelength)
            tags = file.geotiff_metadata
            pixels = page.asarray()
            planar = int(page.planarconfig) == 2
    except (OSError, tifffile.TiffFileError, ValueError, IndexError, KeyError) as error:
        raise GeoreferenceError(f"{path}: cannot be read as a TIFF: {error}") from error
    if pixels.dtype != np.uint8:
        raise GeoreferenceError(
            f"{path}: has {pixels.dtype} samples; convert them to 8 bits (gdal_translate -ot Byte -scale)"
        )
    if pixels.ndim == 3 and planar:
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    if pixels.ndim != 3 or pixels.shape[2] < 3:
        raise GeoreferenceError(f"{path}: has {pixels.shape} samples; red, green and blue are expected")
    if tags and crs is None:
        reference = from_geotiff(tags, str(path), origin)
    else:
        reference = read_world_file(path, parse_system(crs or "EPSG:4326", origin))
    picture = np.ascontiguousarray(pixels[..., 2::-1])
    if pixels.shape[2] == 4:
        picture[pixels[..., 3] == 0] = OUTSIDE
    return Raster(picture, reference)


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise GeoreferenceError(
            f"{path}: {width}x{height} is more than {MAX_PIXELS:,} pixels; reduce or cut it (gdal_translate)"
        )
