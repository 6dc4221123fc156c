"""Pictures as arrays: Pillow and OpenCV on demand, decoding with bounds, cropping, JPEG."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import io
from typing import Any

import numpy as np
import numpy.typing as npt

from fractus_services.errors import PreconditionFailed

Pixels = npt.NDArray[np.uint8]
"""Height, width, and blue, green, red: 8 bits each."""

QUALITY = 90
_M_MMAP_THRESHOLD = -3
_OWN_PAGES_BYTES = 128_000
"""Larger blocks get pages of their own, which glibc gives back to the system at once: a third less memory at peak, and no holes in the
memory of every thread that worked on a picture."""
MAX_PIXELS = 50_000_000
MAX_BYTES = 64_000_000
_STRIP_ROWS = 64
"""Pillow hands pixels over in pieces of 64 kB, for which the threads that work on pictures keep memory."""
_REVERSED = slice(None, None, -1)
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
"""What is read; Pillow has readers for many others, which no camera needs and which strangers could feed."""


class NotAPicture(PreconditionFailed):
    """Bytes that hold no picture, or one that is too large."""

    def __init__(self, reason: str) -> None:
        super().__init__("FilterUnavailable", reason)


@functools.cache
def pillow() -> Any:
    """Pillow, which reads, resizes and writes pictures: a service which takes none does without it."""
    from PIL import Image  # noqa: PLC0415 - see above

    with contextlib.suppress(OSError, AttributeError):  # of glibc; others give memory back by themselves
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _OWN_PAGES_BYTES)
    return Image


@functools.cache
def opencv() -> Any:
    """OpenCV, on one thread: 20 MB that a service does without as long as no filter looks into a picture."""
    import cv2  # noqa: PLC0415 - see above

    cv2.setNumThreads(1)
    return cv2


def decoded(data: bytes) -> Pixels:
    """The pixels of a JPEG, PNG or the like, turned upright; all metadata is dropped.

    Raises:
        NotAPicture: it cannot be decoded, or not to its end.
    """
    if not data or len(data) > MAX_BYTES:
        raise NotAPicture(f"{len(data)} bytes are no picture; at most {MAX_BYTES // 1_000_000} MB are read")
    image = pillow()
    from PIL import ImageOps  # noqa: PLC0415 - as above

    try:
        with image.open(io.BytesIO(data), formats=FORMATS) as source:
            if source.width * source.height > MAX_PIXELS:
                raise NotAPicture(f"{source.width}x{source.height} pixels are too many; at most {MAX_PIXELS} are read")
            ImageOps.exif_transpose(source, in_place=True)
            deep = source.mode.startswith("I;16")
            shallow = image.fromarray((np.asarray(source) >> 8).astype(np.uint8)) if deep else source
            return _pixels(shallow if shallow.mode == "RGB" else shallow.convert("RGB"), _REVERSED)
    except NotAPicture:
        raise
    except Exception as error:
        raise NotAPicture(f"the {len(data)} bytes cannot be decoded as {' or '.join(FORMATS)}: {error}") from None


def _pixels(image: Any, channels: slice = slice(None)) -> Pixels:
    """A picture of Pillow's as an array: in strips, or there would be three copies of a large one at a time."""
    pixels = np.empty((image.height, image.width, 3), np.uint8)
    for top in range(0, image.height, _STRIP_ROWS):
        strip = image.crop((0, top, image.width, min(top + _STRIP_ROWS, image.height)))
        pixels[top : top + _STRIP_ROWS] = np.asarray(strip)[..., channels]
    return pixels


def encoded(picture: Pixels) -> bytes:
    """A JPEG of the pixels and of nothing else.

    Raises:
        NotAPicture: it cannot be encoded.
    """
    out = io.BytesIO()
    try:
        size = (picture.shape[1], picture.shape[0])
        image = pillow().frombuffer("RGB", size, np.ascontiguousarray(picture), "raw", "BGR", 0, 1)
        image.save(out, "JPEG", quality=QUALITY)
    except (OSError, SystemError, ValueError):
        raise NotAPicture(f"a picture of {picture.shape[1]}x{picture.shape[0]} pixels cannot be encoded") from None
    return out.getvalue()


def resized(picture: Pixels, width: int, height: int) -> Pixels:
    """The picture in another size: averages where it gets smaller, blends where it gets larger."""
    image = pillow()
    how = image.Resampling.BOX if picture.shape[1] > width else image.Resampling.BILINEAR
    return _pixels(image.fromarray(np.ascontiguousarray(picture)).resize((width, height), how))


def source_size(width: int, height: int, native: tuple[int, int]) -> tuple[int, int]:
    """Pixels to ask a camera for, in its own proportions, so that they can be cropped to a width and height."""
    scale = max(width / native[0], height / native[1])
    return max(round(native[0] * scale), width), max(round(native[1] * scale), height)


def cropped(picture: Pixels, width: int, height: int) -> Pixels:
    """The middle of a picture in the proportions of a width and height."""
    rows, columns = picture.shape[:2]
    scale = max(width / columns, height / rows)
    kept_columns, kept_rows = min(round(width / scale), columns), min(round(height / scale), rows)
    left, top = (columns - kept_columns) // 2, (rows - kept_rows) // 2
    return picture[top : top + kept_rows, left : left + kept_columns]


def fitted(picture: Pixels, width: int, height: int) -> Pixels:
    """The middle of a picture in other proportions and of another size; never more than it shows."""
    middle = cropped(picture, width, height)
    return np.ascontiguousarray(middle) if middle.shape[:2] == (height, width) else resized(middle, width, height)


def reduced(picture: Pixels, width: int) -> Pixels:
    """The picture at a width, or as it is where it is narrower."""
    rows, columns = picture.shape[:2]
    if columns <= width:
        return picture
    return resized(picture, width, max(round(rows * width / columns), 1))
