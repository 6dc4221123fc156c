"""Georeferences of pictures from world files and GeoTIFF tags, in degrees, projected or local coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from fractus_core.geo import LocalFrame
from numpy.typing import NDArray

Points = NDArray[np.float64]

_WGS84 = 4326
_DEGREES = (_WGS84, 4979, 4258, 4269)
"""EPSG codes of geographic systems that differ from WGS 84 by about a metre at most."""
_WORLD_FILES = {".png": ".pgw", ".jpg": ".jgw", ".jpeg": ".jgw", ".tif": ".tfw", ".tiff": ".tfw"}


class GeoreferenceError(ValueError):
    """The picture has no valid georeference."""


@dataclass(frozen=True, slots=True)
class Degrees:
    """Longitude and latitude (EPSG:4326)."""

    def to_plane(self, lats: Points, lons: Points) -> Points:
        """Convert degrees to coordinates of the system, shape (n, 2)."""
        return np.column_stack((lons, lats))

    def to_degrees(self, x: float, y: float) -> tuple[float, float]:
        """Return latitude and longitude of a point of the system."""
        return y, x


class Projected:
    """Eastings and northings of a projected EPSG system, such as a UTM zone, computed by PROJ.

    Raises:
        GeoreferenceError: The code is unknown.
    """

    def __init__(self, code: int) -> None:
        try:
            crs = pyproj.CRS.from_epsg(code)
        except pyproj.exceptions.CRSError:
            raise GeoreferenceError(f"EPSG:{code} is not a coordinate reference system of PROJ") from None
        if not crs.is_projected:
            raise GeoreferenceError(f"EPSG:{code} ({crs.name}) is not projected; convert the picture to EPSG:4326")
        self._from_degrees = pyproj.Transformer.from_crs(_WGS84, crs, always_xy=True)

    def to_plane(self, lats: Points, lons: Points) -> Points:
        """Convert degrees to eastings and northings, shape (n, 2)."""
        return np.column_stack(self._from_degrees.transform(lons, lats))

    def to_degrees(self, x: float, y: float) -> tuple[float, float]:
        """Return latitude and longitude of an easting and northing."""
        lon, lat = self._from_degrees.transform(x, y, direction="INVERSE")
        return lat, lon


@dataclass(frozen=True, slots=True)
class Metres:
    """Metres east and north of an origin."""

    frame: LocalFrame

    def to_plane(self, lats: Points, lons: Points) -> Points:
        """Convert degrees to metres east and north, shape (n, 2)."""
        return self.frame.xy_array(lats, lons)

    def to_degrees(self, x: float, y: float) -> tuple[float, float]:
        """Return latitude and longitude of a point."""
        return self.frame.latlon(x, y)


System = Degrees | Projected | Metres


@dataclass(frozen=True, slots=True)
class Georeference:
    """Mapping between a picture and the earth.

    Attributes:
        system: System of the plane coordinates.
        affine: Matrix, shape (2, 3), from (column, row, 1) to plane coordinates. (0, 0) is the corner of the picture.
    """

    system: System
    affine: Points

    def pixels(self, lats: Points, lons: Points) -> Points:
        """Return columns and rows, shape (n, 2), of positions in degrees."""
        plane = self.system.to_plane(lats, lons)
        if isinstance(self.system, Degrees):
            # The picture may be on either side of the antimeridian.
            middle = self.affine[0, 2]
            plane[:, 0] = middle + (plane[:, 0] - middle + 180.0) % 360.0 - 180.0
        inverse = np.linalg.inv(self.affine[:, :2])
        pixels: Points = (plane - self.affine[:, 2]) @ inverse.T
        return pixels

    def place(self, column: float, row: float) -> tuple[float, float]:
        """Return latitude and longitude of a point of the picture."""
        x, y = self.affine @ np.array([column, row, 1.0])
        lat, lon = self.system.to_degrees(float(x), float(y))
        return lat, (lon + 180.0) % 360.0 - 180.0


def parse_system(text: str, origin: tuple[float, float] | None) -> System:
    """Return the system of an `EPSG:` code, or `local` for metres around an origin.

    Raises:
        GeoreferenceError: The system is not supported, or `local` has no origin.
    """
    if text.lower() == "local":
        if origin is None:
            raise GeoreferenceError("crs local: the origin is missing; set it as LAT,LON")
        return Metres(LocalFrame(*origin))
    code = text.upper().removeprefix("EPSG:")
    if not code.isdigit():
        raise GeoreferenceError(f"crs {text!r}: expected local, EPSG:4326, or a projected system such as EPSG:32633")
    return _system_of(int(code))


def _system_of(code: int) -> System:
    return Degrees() if code in _DEGREES else Projected(code)


def read_world_file(picture: Path, system: System) -> Georeference:
    """Read the mapping of the world file next to a picture.

    Raises:
        GeoreferenceError: The world file is missing or invalid.
    """
    names = [picture.with_suffix(suffix) for suffix in (_WORLD_FILES.get(picture.suffix.lower(), ".wld"), ".wld")]
    path = next((name for name in names if name.is_file()), None)
    if path is None:
        raise GeoreferenceError(f"{picture}: no world file; store {names[0].name} in the same folder")
    try:
        a, d, b, e, c, f = (float(line) for line in path.read_text(encoding="ascii").split())
    except (ValueError, OSError) as error:
        raise GeoreferenceError(f"{path}: a world file has six lines with one number each: {error}") from error
    # A world file refers to the centre of the first pixel.
    return _checked(np.array([[a, b, c - a / 2 - b / 2], [d, e, f - d / 2 - e / 2]]), system, str(path))


def from_geotiff(tags: Mapping[str, Any], source: str, origin: tuple[float, float] | None) -> Georeference:
    """Return the mapping of GeoTIFF tags as read by tifffile (`TiffFile.geotiff_metadata`).

    Raises:
        GeoreferenceError: The tags are missing or not supported.
    """
    code = tags.get("ProjectedCSTypeGeoKey") or tags.get("GeographicTypeGeoKey")
    number = getattr(code, "value", code)
    epsg = 32767 if number is None else int(number)
    system = parse_system("local", origin) if epsg == 32767 else _system_of(epsg)
    # With RasterPixelIsPoint (2), the tie point is the centre of a pixel instead of its corner.
    raster_type = tags.get("GTRasterTypeGeoKey") or 1
    shift = 0.5 if int(getattr(raster_type, "value", raster_type)) == 2 else 0.0
    matrix = tags.get("ModelTransformation")
    if matrix is not None:
        whole = np.asarray(matrix, np.float64).reshape(4, 4)
        affine = whole[:2][:, [0, 1, 3]]
    else:
        scale = tags.get("ModelPixelScale")
        tie = tags.get("ModelTiepoint")
        if scale is None or tie is None:
            raise GeoreferenceError(f"{source}: no GeoTIFF tags (ModelPixelScale and ModelTiepoint); add a world file")
        tie = np.asarray(tie, np.float64).ravel()
        east = float(scale[0])
        north = -float(scale[1])
        affine = np.array([[east, 0.0, tie[3] - east * tie[0]], [0.0, north, tie[4] - north * tie[1]]])
    affine = affine.copy()
    affine[:, 2] -= shift * (affine[:, 0] + affine[:, 1])
    return _checked(affine, system, source)


def _checked(affine: Points, system: System, source: str) -> Georeference:
    if not np.isfinite(affine).all() or abs(float(np.linalg.det(affine[:, :2]))) < 1e-24:
        raise GeoreferenceError(f"{source}: the georeference gives pixels no size on the ground")
    if isinstance(system, Degrees) and not (abs(affine[1, 2]) <= 90.5 and abs(affine[0, 2]) <= 540.0):
        raise GeoreferenceError(
            f"{source}: the corner is not a longitude and latitude; check that its system is EPSG:4326"
        )
    return Georeference(system, affine)
