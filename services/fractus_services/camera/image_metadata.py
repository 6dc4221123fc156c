"""EXIF and XMP metadata of an image: position, altitude, direction and time."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime

from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from fractus_services.camera.pose import Pose, camera_orientation

_SOI = b"\xff\xd8"
_APP1 = 0xE1
_EXIF = b"Exif\x00\x00"
_XMP = b"http://ns.adobe.com/xap/1.0/\x00"


def with_metadata(jpeg: bytes, pose: Pose, *, time_s: float, camera: str, view_width_px: int | None) -> bytes:
    """Add EXIF and XMP segments to a JPEG, directly after its start marker as readers expect them.

    Args:
        jpeg: Unfiltered image without metadata.
        pose: Pose of the camera. Unknown values are omitted.
        time_s: Unix time in seconds.
        camera: Make and model, or an empty string.
        view_width_px: Width of the full view before cropping, in pixels. None if the field of view of the pose does not give
            the focal length.

    Raises:
        ValueError: The data is not a JPEG.
    """
    if not jpeg.startswith(_SOI):
        raise ValueError("EXIF and XMP require a JPEG")
    exif = _exif(pose, datetime.fromtimestamp(time_s, UTC), camera)
    return _SOI + _segment(exif) + _segment(_XMP + _xmp(pose, view_width_px).encode()) + jpeg[len(_SOI) :]


def _segment(body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, _APP1, len(body) + 2) + body


def _exif(pose: Pose, time: datetime, camera: str) -> bytes:
    exif = Image.Exif()
    exif[Base.Software] = "Fractus"
    if camera:
        exif[Base.Model] = camera.encode("ascii", "replace").decode()
    exif[Base.DateTime] = time.strftime("%Y:%m:%d %H:%M:%S")
    inner = exif.get_ifd(IFD.Exif)
    inner[Base.DateTimeOriginal] = time.strftime("%Y:%m:%d %H:%M:%S")
    inner[Base.OffsetTimeOriginal] = "+00:00"
    inner[Base.SubsecTimeOriginal] = f"{time.microsecond // 1000:03d}"
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
        _, _, yaw_deg = camera_orientation(pose)
        if yaw_deg is not None:
            gps[GPS.GPSImgDirectionRef] = "T"  # true north
            gps[GPS.GPSImgDirection] = round(yaw_deg % 360, 3)
        gps[GPS.GPSMapDatum] = "WGS-84"
        gps[GPS.GPSDateStamp] = time.strftime("%Y:%m:%d")
        gps[GPS.GPSHPositioningError] = round(pose.position_error_m, 3)
    data = exif.tobytes()
    return data if data.startswith(_EXIF) else _EXIF + data


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Convert degrees to degrees, minutes and seconds. Seconds are rounded to 1e-6, which is less than a millimetre."""
    whole, rest = divmod(abs(degrees) * 3600, 3600)
    minutes, seconds = divmod(rest, 60)
    return whole, minutes, round(seconds, 6)


def _xmp(pose: Pose, view_width_px: int | None) -> str:
    """Return attitude and height in Pix4D's `Camera` schema, which photogrammetry programs read."""
    roll_deg, pitch_deg, yaw_deg = camera_orientation(pose)
    half = math.radians(pose.lens.horizontal_deg) / 2 if pose.lens is not None else 0.0
    focal_px = view_width_px / 2 / math.tan(half) if half and view_width_px is not None else None
    known = {
        "AboveGroundAltitude": pose.altitude_m if pose.lat is not None else None,
        "Roll": roll_deg,
        "Pitch": pitch_deg,
        "Yaw": None if yaw_deg is None else yaw_deg % 360,
        "GPSXYAccuracy": pose.position_error_m if pose.lat is not None else None,
        "PerspectiveFocalLength": focal_px,
    }
    tags = "".join(
        f' Camera:{name}="{value:.4f}"' for name, value in known.items() if value is not None and math.isfinite(value)
    )
    units = ' Camera:PerspectiveFocalLengthUnits="pixel"' if focal_px is not None else ""
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""'
        f' xmlns:Camera="http://pix4d.com/camera/1.0/"{tags}{units}/></rdf:RDF></x:xmpmeta><?xpacket end="r"?>'
    )
