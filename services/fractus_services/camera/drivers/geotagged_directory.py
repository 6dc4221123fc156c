"""Geotagged pictures of a directory instead of a camera: the one that was taken nearest to where the camera is."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from fractus_core.geo import LocalFrame

from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest
from fractus_services.camera.pixels import NotAPicture, Pixels, decoded

log = logging.getLogger(__name__)

_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"})
_MAX_FILES = 100_000
_UNREADABLE = (OSError, KeyError, TypeError, ValueError, ZeroDivisionError, SyntaxError)
"""What Pillow raises for files that are no pictures, or whose position is none."""


class GeotaggedDirectory:
    """Serves the picture whose EXIF position is nearest to the camera; altitudes count where they are known.

    Args:
        path: the directory; it is read again when it changes.
    """

    latency_s = 0.0

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stamp: int | None = None
        self._files: list[Path] = []
        self._places: npt.NDArray[np.float64] = np.empty((0, 3))

    def capture(self, wanted: CaptureRequest) -> Pixels:
        """See `Driver`."""
        now = wanted.now
        if now.lat is None or now.lon is None:
            raise CameraFailed("the camera's position is unknown, so no picture of the directory is nearest")
        self._look()
        frame = LocalFrame(now.lat, now.lon)
        flat = frame.xy_array(self._places[:, 0], self._places[:, 1])
        amsl_m = now.home.amsl_m + now.altitude_m if now.home is not None else math.nan
        up = np.nan_to_num(self._places[:, 2] - amsl_m, nan=0.0)
        nearest = int(np.argmin(np.square(flat).sum(axis=1) + np.square(up)))
        try:
            return decoded(self._files[nearest].read_bytes())
        except (OSError, NotAPicture) as error:
            self._stamp = None
            raise CameraFailed(f"{self._files[nearest]} cannot be read: {error}") from None

    def close(self) -> None:
        """Nothing to close."""

    def _look(self) -> None:
        try:
            stamp = self._path.stat().st_mtime_ns
            if stamp == self._stamp:
                return
            named = (p for p in self._path.iterdir() if p.suffix.lower() in _SUFFIXES)
            # Opening a pipe would wait for someone to write into it.
            files = sorted(p for p in named if p.is_file())[:_MAX_FILES]
        except OSError as error:
            raise CameraFailed(f"{self._path} cannot be read: {error.strerror or error}") from None
        found = [(file, place) for file in files if (place := position_of(file)) is not None]
        if not found:
            raise CameraFailed(f"none of the {len(files)} pictures in {self._path} has a GPS position in its EXIF data")
        self._files = [file for file, _ in found]
        self._places = np.array([place for _, place in found])
        self._stamp = stamp


def position_of(file: Path) -> tuple[float, float, float] | None:
    """Latitude, longitude, and metres above mean sea level (NaN where unknown) from a picture's EXIF data."""
    from PIL import Image  # noqa: PLC0415 - only this camera needs it
    from PIL.ExifTags import GPS, IFD  # noqa: PLC0415

    try:
        with Image.open(file) as picture:
            tags = picture.getexif().get_ifd(IFD.GPSInfo)
        lat, lon = _degrees(tags[GPS.GPSLatitude]), _degrees(tags[GPS.GPSLongitude])
        lat = -lat if tags.get(GPS.GPSLatitudeRef) == "S" else lat
        lon = -lon if tags.get(GPS.GPSLongitudeRef) == "W" else lon
        alt = float(tags.get(GPS.GPSAltitude, math.nan))
        # Cameras write the reference as a number or as a byte; 1 is below sea level.
        below = tags.get(GPS.GPSAltitudeRef) in {1, b"\x01"}
    except (*_UNREADABLE, Image.DecompressionBombError) as error:
        log.debug("camera directory: picture has no position (file=%s): %s", file, error)
        return None
    if not (-90 <= lat <= 90 and -180 <= lon <= 180):
        return None
    return lat, lon, -alt if below else alt


def _degrees(parts: tuple[float, float, float]) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return degrees + minutes / 60 + seconds / 3600
