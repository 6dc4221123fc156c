"""Pictures with a GPS position in their EXIF metadata."""

from __future__ import annotations

from pathlib import Path

from PIL import Image


def save(
    path: Path, lat: float, lon: float, amsl_m: float | None, colour: tuple[int, int, int] = (10, 200, 30)
) -> None:
    """Write a picture with a GPS position in its EXIF metadata, as a camera does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()

    exif[0x010F] = "Fractus"  # Pillow writes no EXIF to a PNG if the main directory has no tag

    def parts(angle: float) -> tuple[float, float, float]:
        minutes, seconds = divmod(round(angle * 3600, 4), 60)
        return float(minutes // 60), float(minutes % 60), seconds

    gps = {1: "S" if lat < 0 else "N", 2: parts(abs(lat)), 3: "W" if lon < 0 else "E", 4: parts(abs(lon))}
    if amsl_m is not None:
        gps |= {5: b"\x01" if amsl_m < 0 else b"\x00", 6: abs(amsl_m)}
    exif.get_ifd(0x8825).update(gps)
    Image.new("RGB", (80, 60), colour).save(path, exif=exif)
