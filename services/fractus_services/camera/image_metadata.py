"""EXIF and XMP metadata of an image: position, altitude, direction and time."""

from __future__ import annotations

import io
import math
import struct
from dataclasses import replace
from datetime import UTC, datetime

from fractus_core.policy.footprint import camera_axes
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from fractus_services.camera.pose import Pose

_SOI = b"\xff\xd8"
_APP1 = 0xE1
_EXIF = b"Exif\x00\x00"
_XMP = b"http://ns.adobe.com/xap/1.0/\x00"

_FILM_WIDTH_MM = 36.0
"""Width of 35 mm film, for the equivalent focal length."""

_LEVEL_LOOK = math.sin(math.radians(45.0))
"""Vertical part of the direction of a camera above which the top of the image has a clearer direction than the camera."""

_GIMBAL_LOCK = 1e-6
"""Horizontal part of the image's upward direction below which yaw and roll of the schema cannot be distinguished."""


def with_metadata(
    jpeg: bytes, pose: Pose, *, time_s: float, camera: str, view_width_px: int | None, located: bool = True
) -> bytes:
    """Add EXIF and XMP segments to a JPEG, directly after its start marker as readers expect them.

    Args:
        jpeg: Unfiltered image without metadata.
        pose: Pose of the camera. Unknown values are omitted.
        time_s: Unix time in seconds.
        camera: Make and model, or an empty string.
        view_width_px: Width of the full view before cropping, in pixels. None if the field of view of the pose does not give
            the focal length.
        located: False to omit position, height and direction.

    Raises:
        ValueError: The data is not a JPEG.
    """
    if not jpeg.startswith(_SOI):
        raise ValueError("EXIF and XMP require a JPEG")
    focal_px = None
    if pose.lens is not None and view_width_px is not None and 0.0 < pose.lens.horizontal_deg < 180.0:
        focal_px = view_width_px / 2 / math.tan(math.radians(pose.lens.horizontal_deg) / 2)
    if not located:
        pose = replace(pose, lat=None, lon=None, home=None, attitude=None, lens=None)
    width_px = image_width_px(jpeg)
    exif = _exif(pose, datetime.fromtimestamp(time_s, UTC), camera, None if focal_px is None else focal_px / width_px)
    return _SOI + _segment(exif) + _segment(_XMP + _xmp(pose).encode()) + jpeg[len(_SOI) :]


def without_metadata(jpeg: bytes) -> bytes:
    """Return a JPEG of `with_metadata` without its EXIF and XMP segments."""
    end = len(_SOI)
    while jpeg[end : end + 2] == bytes((0xFF, _APP1)):
        end += 2 + int.from_bytes(jpeg[end + 2 : end + 4])
    return _SOI + jpeg[end:]


def image_width_px(jpeg: bytes) -> int:
    """Return the width of an image in pixels, from its header."""
    with Image.open(io.BytesIO(jpeg)) as image:
        return image.width


def _segment(body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, _APP1, len(body) + 2) + body


def _exif(pose: Pose, time: datetime, camera: str, focal_widths: float | None) -> bytes:
    """Return EXIF data (CIPA DC-008, version 2.32).

    Args:
        pose: Pose of the camera.
        time: Time of the image in UTC.
        camera: Make and model, or an empty string.
        focal_widths: Focal length as a multiple of the width of the image. None if it is unknown.
    """
    exif = Image.Exif()
    exif[Base.Software] = "Fractus"
    if camera:
        exif[Base.Model] = camera.encode("ascii", "replace").decode()
    exif[Base.DateTime] = time.strftime("%Y:%m:%d %H:%M:%S")
    inner = exif.get_ifd(IFD.Exif)
    inner[Base.ExifVersion] = b"0232"
    inner[Base.OffsetTime] = "+00:00"
    inner[Base.DateTimeOriginal] = time.strftime("%Y:%m:%d %H:%M:%S")
    inner[Base.OffsetTimeOriginal] = "+00:00"
    inner[Base.SubsecTimeOriginal] = f"{time.microsecond // 1000:03d}"
    if focal_widths is not None:
        inner[Base.FocalLengthIn35mmFilm] = max(round(focal_widths * _FILM_WIDTH_MM), 1)
    if pose.lat is not None and pose.lon is not None:
        gps = exif.get_ifd(IFD.GPSInfo)
        gps[GPS.GPSVersionID] = b"\x02\x03\x00\x00"
        gps[GPS.GPSLatitudeRef] = "N" if pose.lat >= 0 else "S"
        gps[GPS.GPSLatitude] = _sexagesimal(pose.lat)
        gps[GPS.GPSLongitudeRef] = "E" if pose.lon >= 0 else "W"
        gps[GPS.GPSLongitude] = _sexagesimal(pose.lon)
        if pose.home is not None:
            amsl_m = pose.home.amsl_m + pose.altitude_m
            # The altitude is unsigned. The reference is 1 below sea level.
            gps[GPS.GPSAltitudeRef] = b"\x01" if amsl_m < 0 else b"\x00"
            gps[GPS.GPSAltitude] = round(abs(amsl_m), 3)
        gps[GPS.GPSTimeStamp] = (time.hour, time.minute, time.second + time.microsecond // 1000 / 1000)
        direction_deg = _direction_deg(pose)
        if direction_deg is not None:
            gps[GPS.GPSImgDirectionRef] = "T"  # true north
            gps[GPS.GPSImgDirection] = _bearing_deg(direction_deg, 2)
        gps[GPS.GPSMapDatum] = "WGS-84"
        gps[GPS.GPSDateStamp] = time.strftime("%Y:%m:%d")
        gps[GPS.GPSHPositioningError] = round(pose.position_error_m, 3)
    data = exif.tobytes()
    return data if data.startswith(_EXIF) else _EXIF + data


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Convert degrees to degrees, minutes and seconds. Seconds are rounded to 1e-6, which is less than a millimetre."""
    # Round first: otherwise the seconds could be rounded up to 60.
    whole, rest = divmod(round(abs(degrees) * 3_600_000_000), 3_600_000_000)
    minutes, microseconds = divmod(rest, 60_000_000)
    return whole, minutes, microseconds / 1e6


def _bearing_deg(degrees: float, digits: int) -> float:
    """Return a bearing from 0 to less than 360 degrees, rounded. A bearing that is rounded up to 360 becomes 0."""
    return round(degrees % 360, digits) % 360


def _direction_deg(pose: Pose) -> float | None:
    """Return the direction of the image, clockwise from true north, or None if it is unknown.

    The direction is the camera's direction. If the camera looks steeply down or up, it is the direction of the top or bottom of the image.
    """
    if pose.lens is None or pose.attitude is None:
        return None
    axis, _, up = camera_axes(pose.lens, pose.attitude)
    if abs(axis[2]) <= _LEVEL_LOOK:
        return math.degrees(math.atan2(axis[1], axis[0]))
    sign = math.copysign(1.0, axis[2])
    return math.degrees(math.atan2(sign * up[1], sign * up[0]))


def _schema_angles_deg(pose: Pose) -> dict[str, float]:
    """Return yaw, pitch and roll of the camera by the convention of Pix4D, without unknown angles.

    The angles are zero if the camera looks straight down and the top of the image is north. They rotate about the axes of the
    image: yaw about the direction of the camera, then pitch about the right side (90 looks to the horizon), then roll about the
    top of the image. Source: Pix4D, "Yaw, Pitch, Roll and Omega, Phi, Kappa angles".
    """
    lens = pose.lens
    if lens is None:
        return {}
    if pose.attitude is None:
        # A gimbal keeps roll and pitch constant. Only the yaw depends on the unknown attitude of the airframe.
        return {"Pitch": lens.pitch_deg + 90.0, "Roll": 0.0} if lens.stabilised else {}
    axis, right, up = camera_axes(lens, pose.attitude)
    # Rows of the rotation matrix with the columns up, right, axis: north, east, down.
    if math.hypot(up[0], up[1]) < _GIMBAL_LOCK:
        yaw = math.atan2(-right[0], right[1])
        return {"Yaw": math.degrees(yaw), "Pitch": math.copysign(90.0, -up[2]), "Roll": 0.0}
    pitch = math.degrees(math.asin(max(-1.0, min(1.0, -up[2]))))
    yaw = math.degrees(math.atan2(up[1], up[0]))
    roll = math.degrees(math.atan2(right[2], axis[2]))
    if abs(roll) > 90.0:
        # The camera looks above the horizon. The same rotation with a pitch above 90 degrees has the smaller roll.
        return {"Yaw": yaw + 180.0, "Pitch": 180.0 - pitch, "Roll": roll - math.copysign(180.0, roll)}
    return {"Yaw": yaw, "Pitch": pitch, "Roll": roll}


def _xmp(pose: Pose) -> str:
    """Return attitude and position error in Pix4D's `Camera` schema, which photogrammetry programs read.

    The schema also has an altitude above ground and a focal length in millimetres. They are omitted, because the ground below the
    camera and the size of its sensor are unknown.
    """
    known = _schema_angles_deg(pose)
    if "Yaw" in known:
        known["Yaw"] = _bearing_deg(known["Yaw"], 4)
    if pose.lat is not None:
        known["GPSXYAccuracy"] = pose.position_error_m
    tags = "".join(f' Camera:{name}="{value + 0.0:.4f}"' for name, value in known.items() if math.isfinite(value))
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""'
        f' xmlns:Camera="http://pix4d.com/camera/1.0/"{tags}/></rdf:RDF></x:xmpmeta><?xpacket end="r"?>'
    )
