"""Where the pixels of a picture lie on the earth: world files and GeoTIFF tags, in degrees, UTM or metres around a place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fractus_core.geo import LocalFrame
from numpy.typing import NDArray

Points = NDArray[np.float64]

_DEGREES = (4326, 4979, 4258, 4269)
"""Geographic systems that agree with WGS 84 to within a metre or so."""
_A = 6_378_137.0
_F = 1 / 298.257223563
_UTM_SCALE = 0.9996
_WORLD_FILES = {".png": ".pgw", ".jpg": ".jgw", ".jpeg": ".jgw", ".tif": ".tfw", ".tiff": ".tfw"}


class GeoreferenceError(ValueError):
    """A picture that does not say where it lies."""


@dataclass(frozen=True, slots=True)
class Degrees:
    """Longitude and latitude (EPSG:4326)."""

    def to_plane(self, lats: Points, lons: Points) -> Points:
        """Coordinates of the system, shape (n, 2), of degrees."""
        return np.column_stack((lons, lats))

    def to_degrees(self, x: float, y: float) -> tuple[float, float]:
        """Latitude and longitude of a point of the system."""
        return y, x


@dataclass(frozen=True, slots=True)
class Utm:
    """Universal Transverse Mercator.

    Krüger's series to the third order in the flattening: millimetres within a zone (Karney, "Transverse Mercator with
    an accuracy of a few nanometers", J. Geodesy 85, 2011).
    """

    zone: int
    north: bool

    def to_plane(self, lats: Points, lons: Points) -> Points:
        """Easting and northing, shape (n, 2), of degrees."""
        n, radius, alpha, _ = _series()
        meridian = 6 * self.zone - 183
        away = np.radians((lons - meridian + 180.0) % 360.0 - 180.0)
        phi = np.radians(lats)
        root = 2 * math.sqrt(n) / (1 + n)
        t = np.sinh(np.arctanh(np.sin(phi)) - root * np.arctanh(root * np.sin(phi)))
        xi, eta = np.arctan2(t, np.cos(away)), np.arctanh(np.sin(away) / np.sqrt(1 + t * t))
        east, north = eta.copy(), xi.copy()
        for k, a in enumerate(alpha, start=1):
            east += a * np.cos(2 * k * xi) * np.sinh(2 * k * eta)
            north += a * np.sin(2 * k * xi) * np.cosh(2 * k * eta)
        offset = 0.0 if self.north else 10_000_000.0
        return np.column_stack((500_000.0 + _UTM_SCALE * radius * east, offset + _UTM_SCALE * radius * north))

    def to_degrees(self, x: float, y: float) -> tuple[float, float]:
        """Latitude and longitude of an easting and northing."""
        _, radius, _, beta = _series()
        xi = (y - (0.0 if self.north else 10_000_000.0)) / (_UTM_SCALE * radius)
        eta = (x - 500_000.0) / (_UTM_SCALE * radius)
        xi0, eta0 = xi, eta
        for k, b in enumerate(beta, start=1):
            xi0 -= b * math.sin(2 * k * xi) * math.cosh(2 * k * eta)
            eta0 -= b * math.cos(2 * k * xi) * math.sinh(2 * k * eta)
        away = math.atan2(math.sinh(eta0), math.cos(xi0))
        goal = math.sin(xi0) / math.hypot(math.sinh(eta0), math.cos(xi0))
        lat = math.atan(_latitude_tangent(goal))
        return math.degrees(lat), (math.degrees(away) + 6 * self.zone - 183 + 180.0) % 360.0 - 180.0


@dataclass(frozen=True, slots=True)
class Metres:
    """Metres east and north of a place."""

    frame: LocalFrame

    def to_plane(self, lats: Points, lons: Points) -> Points:
        """Metres east and north, shape (n, 2), of degrees."""
        return self.frame.xy_array(lats, lons)

    def to_degrees(self, x: float, y: float) -> tuple[float, float]:
        """Latitude and longitude of a point."""
        return self.frame.latlon(x, y)


System = Degrees | Utm | Metres


@dataclass(frozen=True, slots=True)
class Georeference:
    """The mapping between a picture and the earth.

    Attributes:
        system: Of the plane coordinates.
        affine: Shape (2, 3): plane coordinates of a pixel (column, row, 1), whose origin is the picture's corner.
    """

    system: System
    affine: Points

    def pixels(self, lats: Points, lons: Points) -> Points:
        """Columns and rows, shape (n, 2), of places in degrees."""
        plane = self.system.to_plane(lats, lons)
        if isinstance(self.system, Degrees):
            # Whatever side of the antimeridian the picture counts from.
            middle = self.affine[0, 2]
            plane[:, 0] = middle + (plane[:, 0] - middle + 180.0) % 360.0 - 180.0
        inverse = np.linalg.inv(self.affine[:, :2])
        pixels: Points = (plane - self.affine[:, 2]) @ inverse.T
        return pixels

    def place(self, column: float, row: float) -> tuple[float, float]:
        """Latitude and longitude of a point of the picture."""
        x, y = self.affine @ np.array([column, row, 1.0])
        lat, lon = self.system.to_degrees(float(x), float(y))
        return lat, (lon + 180.0) % 360.0 - 180.0


def parse_system(text: str, origin: tuple[float, float] | None) -> System:
    """The system of an `EPSG:` code, or `local` for metres around an origin.

    Raises:
        GeoreferenceError: It is another, or `local` without an origin.
    """
    if text.lower() == "local":
        if origin is None:
            raise GeoreferenceError("crs local: metres around which place? give the origin as LAT,LON")
        return Metres(LocalFrame(*origin))
    code = text.upper().removeprefix("EPSG:")
    if not code.isdigit():
        raise GeoreferenceError(f"crs {text!r}: expected local, EPSG:4326, or a UTM zone such as EPSG:32633")
    return _system_of(int(code))


def _system_of(code: int) -> System:
    if code in _DEGREES:
        return Degrees()
    for first, north in ((32600, True), (32700, False)):
        if first < code <= first + 60:
            return Utm(code - first, north)
    if 25828 <= code <= 25838:
        return Utm(code - 25800, north=True)
    raise GeoreferenceError(
        f"EPSG:{code} is not supported; convert the picture to EPSG:4326 or to its UTM zone, for example with gdalwarp"
    )


def read_world_file(picture: Path, system: System) -> Georeference:
    """The mapping that the world file beside a picture gives.

    Raises:
        GeoreferenceError: There is none, or it is broken.
    """
    names = [picture.with_suffix(suffix) for suffix in (_WORLD_FILES.get(picture.suffix.lower(), ".wld"), ".wld")]
    found = next((name for name in names if name.is_file()), None)
    if found is None:
        raise GeoreferenceError(f"{picture}: has no world file; put {names[0].name} beside it")
    try:
        a, d, b, e, c, f = (float(line) for line in found.read_text(encoding="ascii").split())
    except (ValueError, OSError) as error:
        raise GeoreferenceError(f"{found}: a world file has six lines of one number each: {error}") from error
    # A world file tells of the middle of the first pixel.
    return _checked(np.array([[a, b, c - a / 2 - b / 2], [d, e, f - d / 2 - e / 2]]), system, str(found))


def from_geotiff(tags: Mapping[str, Any], source: str, origin: tuple[float, float] | None) -> Georeference:
    """The mapping that the tags of a GeoTIFF give, as tifffile reads them (`TiffFile.geotiff_metadata`).

    Raises:
        GeoreferenceError: They are missing or say what is not supported.
    """
    code = tags.get("ProjectedCSTypeGeoKey") or tags.get("GeographicTypeGeoKey")
    number = getattr(code, "value", code)
    epsg = 32767 if number is None else int(number)
    system = parse_system("local", origin) if epsg == 32767 else _system_of(epsg)
    # tifffile names the second value of GTRasterTypeGeoKey RasterPixelIsPoint: then the tie is a pixel's middle.
    shift = (
        0.5 if int(getattr(tags.get("GTRasterTypeGeoKey"), "value", tags.get("GTRasterTypeGeoKey") or 1)) == 2 else 0.0
    )
    matrix = tags.get("ModelTransformation")
    if matrix is not None:
        whole = np.asarray(matrix, np.float64).reshape(4, 4)
        affine = whole[:2][:, [0, 1, 3]]
    else:
        scale, tie = tags.get("ModelPixelScale"), tags.get("ModelTiepoint")
        if scale is None or tie is None:
            raise GeoreferenceError(f"{source}: no GeoTIFF tags (ModelPixelScale and ModelTiepoint); add a world file")
        tie = np.asarray(tie, np.float64).ravel()
        east, north = float(scale[0]), -float(scale[1])
        affine = np.array([[east, 0.0, tie[3] - east * tie[0]], [0.0, north, tie[4] - north * tie[1]]])
    affine = affine.copy()
    affine[:, 2] -= shift * (affine[:, 0] + affine[:, 1])
    return _checked(affine, system, source)


def _checked(affine: Points, system: System, source: str) -> Georeference:
    if not np.isfinite(affine).all() or abs(float(np.linalg.det(affine[:, :2]))) < 1e-24:
        raise GeoreferenceError(f"{source}: its pixels have no size on the ground")
    if isinstance(system, Degrees) and not (abs(affine[1, 2]) <= 90.5 and abs(affine[0, 2]) <= 540.0):
        raise GeoreferenceError(f"{source}: its corner is not a longitude and latitude; is its system EPSG:4326?")
    return Georeference(system, affine)


def _series() -> tuple[float, float, tuple[float, ...], tuple[float, ...]]:
    """Third flattening, rectifying radius, and the coefficients there and back."""
    n = _F / (2 - _F)
    radius = _A / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16,
        13 * n**2 / 48 - 3 * n**3 / 5,
        61 * n**3 / 240,
    )
    beta = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    return n, radius, alpha, beta


def _latitude_tangent(conformal: float) -> float:
    """The tangent of the latitude whose conformal latitude's tangent is given; Newton's method, after Karney."""
    e = math.sqrt(_F * (2 - _F))
    tangent = conformal
    for _ in range(8):
        root = math.hypot(1.0, tangent)
        sigma = math.sinh(e * math.atanh(e * tangent / root))
        now = tangent * math.hypot(1.0, sigma) - sigma * root
        step = (conformal - now) / math.hypot(1.0, now) * (1 + (1 - e * e) * tangent**2) / ((1 - e * e) * root)
        tangent += step
        if abs(step) < 1e-14 * max(abs(tangent), 1.0):
            break
    return tangent
