"""Photographs instead of a rendered world. The camera shows the geotagged picture that was taken nearest to it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from fractus_core.local_frame import ecef
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from fractus_world.render import Band

Picture = NDArray[np.uint8]

MAX_FILES = 200_000
MAX_PIXELS = 120_000_000
_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"})
_THERMAL_FOLDERS = frozenset({"ir", "thermal"})
_THERMAL_ENDINGS = ("_ir", "-ir", "_t", "_thermal")
_GPS_IFD = 0x8825
_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT = range(1, 7)


class PhotoError(ValueError):
    """A directory or picture that cannot be used."""


@dataclass(frozen=True, slots=True)
class Photo:
    """A geotagged picture.

    Attributes:
        path: File.
        lat: Latitude, degrees.
        lon: Longitude, degrees.
        amsl_m: Altitude above mean sea level. 0 if the file does not contain it.
        band: Daylight or thermal.
    """

    path: Path
    lat: float
    lon: float
    amsl_m: float
    band: Band


class Photos:
    """Index of geotagged pictures, separately for daylight and thermal pictures.

    A picture is thermal if a folder in its path below the directory is named `ir` or `thermal`, or if its name ends in
    `_ir`, `-ir`, `_thermal` or `_T` (DJI).

    Args:
        photos: The pictures.

    Raises:
        PhotoError: There are no pictures.
    """

    def __init__(self, photos: list[Photo]) -> None:
        if not photos:
            raise PhotoError("no picture has a GPS position in its EXIF data")
        self._bands: dict[Band, list[Photo]] = {}
        for photo in photos:
            self._bands.setdefault(photo.band, []).append(photo)
        self._points = {band: _points(of_band) for band, of_band in self._bands.items()}

    @classmethod
    def of(cls, directory: Path) -> Photos:
        """Index a directory recursively.

        Raises:
            PhotoError: The directory does not exist, is too large, or contains no geotagged picture.
        """
        if not directory.is_dir():
            raise PhotoError(f"{directory}: is not a directory")
        paths = sorted(path for path in directory.rglob("*") if path.suffix.lower() in _SUFFIXES and path.is_file())
        if len(paths) > MAX_FILES:
            raise PhotoError(f"{directory}: has {len(paths):,} pictures; at most {MAX_FILES:,} are indexed")
        photos = [photo for photo in (_read(path, directory) for path in paths) if photo is not None]
        if not photos:
            raise PhotoError(f"{directory}: none of its {len(paths)} pictures has a GPS position in its EXIF data")
        return cls(photos)

    def nearest(self, lat: float, lon: float, amsl_m: float, band: Band) -> tuple[Photo, float]:
        """Return the picture of a band that was taken nearest to a position, and its spatial distance in metres.

        Raises:
            PhotoError: There is no picture of the band.
        """
        points = self._points.get(band)
        if points is None:
            raise PhotoError(f"band: no {band} picture available")
        chords_m = np.linalg.norm(points[:, :3] - ecef(lat, lon), axis=1)
        distances_m = np.hypot(chords_m, points[:, 3] - amsl_m)
        index = int(np.argmin(distances_m))
        return self._bands[band][index], float(distances_m[index])


def _points(photos: list[Photo]) -> NDArray[np.float64]:
    """Return Earth-centred coordinates of the ground below each photograph, and its altitude: shape (n, 4), metres."""
    lats = np.array([photo.lat for photo in photos])
    lons = np.array([photo.lon for photo in photos])
    return np.column_stack((*ecef(lats, lons, np), [photo.amsl_m for photo in photos]))


def _read(path: Path, directory: Path) -> Photo | None:
    try:
        with Image.open(path) as image:
            gps = image.getexif().get_ifd(_GPS_IFD)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None  # not a picture
    try:
        lat = _angle(gps[_LAT], gps[_LAT_REF], "S")
        lon = _angle(gps[_LON], gps[_LON_REF], "W")
        amsl_m = float(gps.get(_ALT, 0.0)) * (-1.0 if gps.get(_ALT_REF) in (1, b"\x01") else 1.0)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    if not (abs(lat) <= 90.0 and abs(lon) <= 180.0 and abs(amsl_m) < 50_000.0):
        return None
    below = path.relative_to(directory)
    thermal = any(part.lower() in _THERMAL_FOLDERS for part in below.parts[:-1])
    thermal = thermal or below.stem.lower().endswith(_THERMAL_ENDINGS)
    return Photo(path, lat, lon, amsl_m, "ir" if thermal else "rgb")


def _angle(parts: Any, reference: Any, negative: str) -> float:
    """Convert an EXIF angle (degrees, minutes, seconds) to degrees. Its sign follows from the reference letter."""
    degrees, minutes, seconds = (float(part) for part in parts)
    sign = -1.0 if str(reference).upper().startswith(negative) else 1.0
    return sign * (degrees + minutes / 60.0 + seconds / 3600.0)


def resized(photo: Photo, width: int, height: int) -> Picture:
    """Crop a photograph to the aspect ratio of width and height, and scale it to this size: shape (height, width, 3).

    Raises:
        PhotoError: The file cannot be read, or is too large.
    """
    try:
        with Image.open(photo.path) as image:
            if image.width * image.height > MAX_PIXELS:
                raise PhotoError(f"{photo.path}: more than {MAX_PIXELS:,} pixels")
            image.draft("RGB", (width, height))
            pixels = np.asarray(image.convert("RGB"))[..., ::-1]
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise PhotoError(f"{photo.path}: cannot be read: {error}") from error
    scale = max(width / pixels.shape[1], height / pixels.shape[0])
    w = round(width / scale)
    h = round(height / scale)
    x = (pixels.shape[1] - w) // 2
    y = (pixels.shape[0] - h) // 2
    part = np.ascontiguousarray(pixels[y : y + h, x : x + w])
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(part, (width, height), interpolation=interpolation), np.uint8)
