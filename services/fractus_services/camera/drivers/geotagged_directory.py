"""Camera driver that returns the geotagged image of a directory that was taken nearest to the camera's position."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from fractus_core.geo import LocalFrame
from fractus_runtime.files import open_file, path_text, read_file
from PIL import Image
from PIL.ExifTags import GPS, IFD

from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest
from fractus_services.camera.pixels import MAX_BYTES, InvalidImage, Pixels, decode_image

log = logging.getLogger(__name__)

_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"})
_MAX_FILES = 100_000
_EXIF_ERRORS = (OSError, KeyError, TypeError, ValueError, ZeroDivisionError, SyntaxError, Image.DecompressionBombError)
"""Exceptions that Pillow raises for files that are not images, or that have no valid position."""


class GeotaggedDirectory:
    """Returns the image whose EXIF position is nearest to the camera, in three dimensions if altitudes are known.

    Args:
        path: Directory of images. It is scanned again when it changes.
    """

    latency_s = 0.0

    def __init__(self, path: Path) -> None:
        self._path = path
        self._modified_ns: int | None = None
        self._files: list[Path] = []
        self._positions: npt.NDArray[np.float64] = np.empty((0, 3))

    def capture(self, request: CaptureRequest) -> Pixels:
        """See `CameraDriver`."""
        situation = request.situation
        if situation.lat is None or situation.lon is None:
            raise CameraFailed("cannot select an image of the directory because the camera's position is unknown")
        self._scan()
        frame = LocalFrame(situation.lat, situation.lon)
        horizontal_m = frame.xy_array(self._positions[:, 0], self._positions[:, 1])
        amsl_m = situation.home.amsl_m + situation.altitude_m if situation.home is not None else math.nan
        vertical_m = np.nan_to_num(self._positions[:, 2] - amsl_m, nan=0.0)
        nearest = int(np.argmin(np.square(horizontal_m).sum(axis=1) + np.square(vertical_m)))
        try:
            return decode_image(read_file(self._files[nearest], MAX_BYTES))
        except (OSError, InvalidImage) as error:
            self._modified_ns = None
            raise CameraFailed(f"cannot read {path_text(self._files[nearest])}: {error}") from None

    def close(self) -> None:
        """See `CameraDriver`."""

    def _scan(self) -> None:
        try:
            modified_ns = self._path.stat().st_mtime_ns
            if modified_ns == self._modified_ns:
                return
            images = (path for path in self._path.iterdir() if path.suffix.lower() in _SUFFIXES)
            files = sorted(path for path in images if path.is_file())[:_MAX_FILES]
        except OSError as error:
            raise CameraFailed(f"cannot read {self._path}: {error.strerror or error}") from None
        positions = {file: position for file in files if (position := read_position(file)) is not None}
        if not positions:
            raise CameraFailed(f"none of the {len(files)} images in {self._path} has a GPS position in its EXIF data")
        self._files = list(positions)
        self._positions = np.array(list(positions.values()))
        self._modified_ns = modified_ns


def read_position(file: Path) -> tuple[float, float, float] | None:
    """Read the position of an image from its EXIF data.

    Returns:
        Latitude and longitude in degrees, and metres above mean sea level (NaN if unknown). None if the file has no valid
        position.
    """
    try:
        with open_file(file) as opened, Image.open(opened) as picture:
            tags = picture.getexif().get_ifd(IFD.GPSInfo)
        lat = _to_degrees(tags[GPS.GPSLatitude])
        lon = _to_degrees(tags[GPS.GPSLongitude])
        lat = -lat if tags.get(GPS.GPSLatitudeRef) == "S" else lat
        lon = -lon if tags.get(GPS.GPSLongitudeRef) == "W" else lon
        alt = float(tags.get(GPS.GPSAltitude, math.nan))
        # Cameras write the reference as a number or as a byte. 1 means below sea level.
        below_sea_level = tags.get(GPS.GPSAltitudeRef) in {1, b"\x01"}
    except _EXIF_ERRORS as error:
        log.debug("camera: image without position skipped (file=%s error=%s)", path_text(file), error)
        return None
    if not (-90 <= lat <= 90 and -180 <= lon <= 180):
        return None
    return lat, lon, -alt if below_sea_level else alt


def _to_degrees(parts: tuple[float, float, float]) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return degrees + minutes / 60 + seconds / 3600
