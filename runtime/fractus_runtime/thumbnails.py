"""Thumbnails of pictures: small JPEGs of bounded size."""

from __future__ import annotations

import io

from PIL import Image

WIDTH_PX = 320
HEIGHT_PX = 240
"""Maximum size of a thumbnail in pixels."""

MAX_BYTES = 40_000
"""Maximum size of a thumbnail in bytes."""

MAX_PIXELS = 64_000_000
"""Maximum size of a picture. Larger pictures have no thumbnail, because decoding them needs too much memory."""

_QUALITIES = (70, 40, 15)


def thumbnail(jpeg: bytes) -> bytes | None:
    """Return a thumbnail without metadata (JPEG), or None if the picture is damaged or too large."""
    try:
        with Image.open(io.BytesIO(jpeg), formats=("JPEG",)) as picture:
            if picture.width * picture.height > MAX_PIXELS:
                return None
            # The decoder of JPEG scales by up to 8, which saves most of the time and memory.
            picture.draft("RGB", (WIDTH_PX, HEIGHT_PX))
            small = picture.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    small.thumbnail((WIDTH_PX, HEIGHT_PX))
    for quality in _QUALITIES:
        buffer = io.BytesIO()
        small.save(buffer, "JPEG", quality=quality)
        if buffer.tell() <= MAX_BYTES:
            return buffer.getvalue()
    return None
