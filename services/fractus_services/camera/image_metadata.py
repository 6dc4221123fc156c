"""Metadata of a picture: EXIF and XMP with place, height, direction and time."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime

from fractus_services.camera.pose import Pose, directions

_SOI = b"\xff\xd8"
_APP1 = 0xE1
_EXIF = b"Exif\x00\x00"
_XMP = b"http://ns.adobe.com/xap/1.0/\x00"


def with_metadata(jpeg: bytes, pose: Pose, *, time_s: float, camera: str, view_width_px: int | None) -> bytes:
    """The JPEG of an unfiltered picture with EXIF and XMP segments right after its start, as readers expect them.

    Args:
        jpeg: the picture, without metadata.
        pose: where it was taken; what is unknown is left out.
        time_s: Unix time.
        camera: make and model; may be empty.
        view_width_px: pixels of the whole view, before the picture was cropped; None where the pose's field of view does not
            tell the focal length.

    Raises:
        ValueError: the bytes are no JPEG.
    """
    if not jpeg.startswith(_SOI):
        raise ValueError("only a JPEG can carry EXIF and XMP")
    exif = _exif(pose, datetime.fromtimestamp(time_s, UTC), camera)
    return _SOI + _segment(exif) + _segment(_XMP + _xmp(pose, view_width_px).encode()) + jpeg[len(_SOI) :]


def _segment(body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, _APP1, len(body) + 2) + body


def _exif(pose: Pose, moment: datetime, camera: str) -> bytes:
    from PIL import Image  # noqa: PLC0415 - 15 MB that a service which takes no picture does without
    from PIL.ExifTags import GPS, IFD, Base  # noqa: PLC0415

    exif = Image.Exif()
    exif[Base.Software] = "Fractus"
    if camera:
        exif[Base.Model] = camera.encode("ascii", "replace").decode()
    exif[Base.DateTime] = moment.strftime("%Y:%m:%d %H:%M:%S")
    inner = exif.get_ifd(IFD.Exif)
    inner[Base.DateTimeOriginal] = moment.strftime("%Y:%m:%d %H:%M:%S")
    inner[Base.OffsetTimeOriginal] = "+00:00"
    inner[Base.SubsecTimeOriginal] = f"{moment.microsecond // 1000:03d}"
    if pose.lat is not None and pose.lon is not None:
        gps = exif.get_ifd(IFD.GPSInfo)
        gps[GPS.GPSVersionID] = b"\x02\x03\x00\x00"
        gps[GPS.GPSLatitudeRef], gps[GPS.GPSLatitude] = "N" if pose.lat >= 0 else "S", _sexagesimal(pose.lat)
        gps[GPS.GPSLongitudeRef], gps[GPS.GPSLongitude] = "E" if pose.lon >= 0 else "W", _sexagesimal(pose.lon)
        if pose.home is not None:
            amsl_m = pose.home.amsl_m + pose.altitude_m
            # EXIF has no sign here: the reference says whether it is below sea level.
            gps[GPS.GPSAltitudeRef] = b"\x01" if amsl_m < 0 else b"\x00"
            gps[GPS.GPSAltitude] = round(abs(amsl_m), 3)
        gps[GPS.GPSTimeStamp] = (moment.hour, moment.minute, moment.second + moment.microsecond // 1000 / 1000)
        _, _, yaw_deg = directions(pose)
        if yaw_deg is not None:
            gps[GPS.GPSImgDirectionRef], gps[GPS.GPSImgDirection] = "T", round(yaw_deg % 360, 3)  # from true north
        gps[GPS.GPSMapDatum], gps[GPS.GPSDateStamp] = "WGS-84", moment.strftime("%Y:%m:%d")
        gps[GPS.GPSHPositioningError] = round(pose.position_error_m, 3)
    data = exif.tobytes()
    return data if data.startswith(_EXIF) else _EXIF + data


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Degrees, minutes and seconds to a millionth of a second's tenth: below a centimetre."""
    whole, rest = divmod(abs(degrees) * 3600, 3600)
    minutes, seconds = divmod(rest, 60)
    return whole, minutes, round(seconds, 6)


def _xmp(pose: Pose, view_width_px: int | None) -> str:
    """Attitude and height as Pix4D's `Camera` schema has them, which photogrammetry reads."""
    roll_deg, pitch_deg, yaw_deg = directions(pose)
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
