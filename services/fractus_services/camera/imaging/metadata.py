"""Metadata of a picture: EXIF and XMP with place, height, direction and time."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from datetime import UTC, datetime

from fractus_services.camera.pose.pose import Pose, directions

_SOI = b"\xff\xd8"
_APP1 = 0xE1
_EXIF = b"Exif\x00\x00"
_XMP = b"http://ns.adobe.com/xap/1.0/\x00"


@dataclass(frozen=True, slots=True)
class PictureFacts:
    """What is known of a picture without filters.

    Attributes:
        time_s: Unix time.
        camera: make and model; may be empty.
        lat: degrees north; None while the position was unknown.
        lon: degrees east.
        amsl_m: metres above mean sea level; None where home was unknown.
        altitude_m: metres above home.
        position_error_m: bound of the error of lat and lon.
        roll_deg: of the camera, with pitch and yaw; None while the attitude was unknown.
        pitch_deg: 0 looks at the horizon, -90 straight down.
        yaw_deg: clockwise from true north.
        focal_px: focal length in pixels; None where the field of view is unknown.
    """

    time_s: float
    camera: str = ""
    lat: float | None = None
    lon: float | None = None
    amsl_m: float | None = None
    altitude_m: float = 0.0
    position_error_m: float = 0.0
    roll_deg: float | None = None
    pitch_deg: float | None = None
    yaw_deg: float | None = None
    focal_px: float | None = None

    @classmethod
    def of(cls, pose: Pose, time_s: float, camera: str, view_width_px: int) -> PictureFacts:
        """What a pose tells of a picture that was taken there.

        Args:
            pose: where it was taken.
            time_s: Unix time.
            camera: make and model.
            view_width_px: pixels of the whole view, before the picture was cropped.
        """
        roll_deg, pitch_deg, yaw_deg = directions(pose)
        half = math.radians(pose.lens.horizontal_deg) / 2 if pose.lens is not None else None
        return cls(
            time_s=float(time_s),
            camera=camera,
            lat=pose.lat,
            lon=pose.lon,
            amsl_m=pose.home.amsl_m + pose.altitude_m if pose.home is not None else None,
            altitude_m=pose.altitude_m,
            position_error_m=pose.position_error_m,
            roll_deg=roll_deg,
            pitch_deg=pitch_deg,
            yaw_deg=yaw_deg,
            focal_px=view_width_px / 2 / math.tan(half) if half else None,
        )


def with_metadata(jpeg: bytes, facts: PictureFacts) -> bytes:
    """The JPEG with EXIF and XMP segments right after its start, as readers expect them.

    Raises:
        ValueError: the bytes are no JPEG.
    """
    if not jpeg.startswith(_SOI):
        raise ValueError("only a JPEG can be tagged")
    return _SOI + _segment(_exif(facts)) + _segment(_XMP + _xmp(facts).encode()) + jpeg[len(_SOI) :]


def _segment(body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, _APP1, len(body) + 2) + body


def _exif(facts: PictureFacts) -> bytes:
    from PIL import Image  # noqa: PLC0415 - 15 MB that a service which takes no picture does without
    from PIL.ExifTags import GPS, IFD, Base  # noqa: PLC0415

    moment = datetime.fromtimestamp(facts.time_s, UTC)
    exif = Image.Exif()
    exif[Base.Software] = "Fractus"
    if facts.camera:
        exif[Base.Model] = facts.camera.encode("ascii", "replace").decode()
    exif[Base.DateTime] = moment.strftime("%Y:%m:%d %H:%M:%S")
    inner = exif.get_ifd(IFD.Exif)
    inner[Base.DateTimeOriginal] = moment.strftime("%Y:%m:%d %H:%M:%S")
    inner[Base.OffsetTimeOriginal] = "+00:00"
    inner[Base.SubsecTimeOriginal] = f"{moment.microsecond // 1000:03d}"
    if facts.lat is not None and facts.lon is not None:
        gps = exif.get_ifd(IFD.GPSInfo)
        gps[GPS.GPSVersionID] = b"\x02\x03\x00\x00"
        gps[GPS.GPSLatitudeRef], gps[GPS.GPSLatitude] = "N" if facts.lat >= 0 else "S", _sexagesimal(facts.lat)
        gps[GPS.GPSLongitudeRef], gps[GPS.GPSLongitude] = "E" if facts.lon >= 0 else "W", _sexagesimal(facts.lon)
        if facts.amsl_m is not None:
            # EXIF has no sign here: the reference says whether it is below sea level.
            gps[GPS.GPSAltitudeRef] = b"\x01" if facts.amsl_m < 0 else b"\x00"
            gps[GPS.GPSAltitude] = round(abs(facts.amsl_m), 3)
        gps[GPS.GPSTimeStamp] = (moment.hour, moment.minute, moment.second + moment.microsecond // 1000 / 1000)
        if facts.yaw_deg is not None:
            gps[GPS.GPSImgDirectionRef], gps[GPS.GPSImgDirection] = "T", round(facts.yaw_deg % 360, 3)  # true north
        gps[GPS.GPSMapDatum], gps[GPS.GPSDateStamp] = "WGS-84", moment.strftime("%Y:%m:%d")
        gps[GPS.GPSHPositioningError] = round(facts.position_error_m, 3)
    data = exif.tobytes()
    return data if data.startswith(_EXIF) else _EXIF + data


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Degrees, minutes and seconds to a millionth of a second's tenth: below a centimetre."""
    whole, rest = divmod(abs(degrees) * 3600, 3600)
    minutes, seconds = divmod(rest, 60)
    return whole, minutes, round(seconds, 6)


def _xmp(facts: PictureFacts) -> str:
    """Attitude and height as Pix4D's `Camera` schema has them, which photogrammetry reads."""
    known = {
        "AboveGroundAltitude": facts.altitude_m if facts.lat is not None else None,
        "Roll": facts.roll_deg,
        "Pitch": facts.pitch_deg,
        "Yaw": None if facts.yaw_deg is None else facts.yaw_deg % 360,
        "GPSXYAccuracy": facts.position_error_m if facts.lat is not None else None,
        "PerspectiveFocalLength": facts.focal_px,
    }
    tags = "".join(
        f' Camera:{name}="{value:.4f}"' for name, value in known.items() if value is not None and math.isfinite(value)
    )
    units = ' Camera:PerspectiveFocalLengthUnits="pixel"' if facts.focal_px is not None else ""
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""'
        f' xmlns:Camera="http://pix4d.com/camera/1.0/"{tags}{units}/></rdf:RDF></x:xmpmeta><?xpacket end="r"?>'
    )
