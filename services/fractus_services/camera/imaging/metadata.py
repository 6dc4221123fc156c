"""What a picture tells about itself: EXIF and XMP with place, height, direction and time."""

from __future__ import annotations

import io
import math
import struct
from dataclasses import dataclass
from datetime import UTC, datetime

_SOI = b"\xff\xd8"
_APP1 = 0xE1
_EXIF = b"Exif\x00\x00"
_XMP = b"http://ns.adobe.com/xap/1.0/\x00"
_GPS_IFD, _EXIF_IFD = 0x8825, 0x8769


@dataclass(frozen=True, slots=True)
class Facts:
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


def tagged(jpeg: bytes, facts: Facts) -> bytes:
    """The JPEG with EXIF and XMP segments right after its start, as readers expect them.

    Raises:
        ValueError: the bytes are no JPEG.
    """
    if not jpeg.startswith(_SOI):
        raise ValueError("only a JPEG can be tagged")
    return _SOI + _segment(_exif(facts)) + _segment(_XMP + _xmp(facts).encode()) + jpeg[len(_SOI) :]


def _segment(body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, _APP1, len(body) + 2) + body


def _exif(facts: Facts) -> bytes:
    from PIL import Image  # noqa: PLC0415 - 15 MB that a service which takes no picture does without

    moment = datetime.fromtimestamp(facts.time_s, UTC)
    exif = Image.Exif()
    exif[0x0131] = "Fractus"  # Software
    if facts.camera:
        exif[0x0110] = facts.camera.encode("ascii", "replace").decode()  # Model
    exif[0x0132] = moment.strftime("%Y:%m:%d %H:%M:%S")  # DateTime
    inner = exif.get_ifd(_EXIF_IFD)
    inner[0x9003] = moment.strftime("%Y:%m:%d %H:%M:%S")  # DateTimeOriginal
    inner[0x9011] = "+00:00"  # OffsetTimeOriginal
    inner[0x9291] = f"{moment.microsecond // 1000:03d}"  # SubSecTimeOriginal
    if facts.lat is not None and facts.lon is not None:
        gps = exif.get_ifd(_GPS_IFD)
        gps[0] = b"\x02\x03\x00\x00"  # GPSVersionID
        gps[1], gps[2] = "N" if facts.lat >= 0 else "S", _sexagesimal(facts.lat)
        gps[3], gps[4] = "E" if facts.lon >= 0 else "W", _sexagesimal(facts.lon)
        if facts.amsl_m is not None:
            gps[5], gps[6] = b"\x01" if facts.amsl_m < 0 else b"\x00", round(abs(facts.amsl_m), 3)
        gps[7] = (moment.hour, moment.minute, moment.second + moment.microsecond // 1000 / 1000)
        if facts.yaw_deg is not None:
            gps[16], gps[17] = "T", round(facts.yaw_deg % 360, 3)  # GPSImgDirection, true
        gps[18], gps[29] = "WGS-84", moment.strftime("%Y:%m:%d")
        gps[31] = round(facts.position_error_m, 3)  # GPSHPositioningError
    buffer = io.BytesIO(exif.tobytes())
    data = buffer.getvalue()
    return data if data.startswith(_EXIF) else _EXIF + data


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Degrees, minutes and seconds to a millionth of a second's tenth: below a centimetre."""
    whole, rest = divmod(abs(degrees) * 3600, 3600)
    minutes, seconds = divmod(rest, 60)
    return whole, minutes, round(seconds, 6)


def _xmp(facts: Facts) -> str:
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
