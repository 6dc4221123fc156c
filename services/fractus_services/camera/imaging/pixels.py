"""Pictures as arrays: OpenCV on demand, decoding with bounds, cropping, JPEG."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
from typing import Any

import numpy as np
import numpy.typing as npt

from fractus_services.errors import PreconditionFailed

Pixels = npt.NDArray[np.uint8]
"""Height, width, and blue, green, red: 8 bits each."""

QUALITY = 90
_M_MMAP_THRESHOLD = -3
_OWN_PAGES_BYTES = 1_000_000
"""Larger blocks get pages of their own, which glibc gives back to the system at once: a third less memory at peak."""
MAX_PIXELS = 50_000_000
MAX_BYTES = 64_000_000


class NotAPicture(PreconditionFailed):
    """Bytes that hold no picture, or one that is too large."""

    def __init__(self, reason: str) -> None:
        super().__init__("FilterUnavailable", reason)


@functools.cache
def opencv() -> Any:
    """OpenCV, on one thread: 30 MB that a service which takes no picture does without."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))
    import cv2  # noqa: PLC0415 - see above

    cv2.setNumThreads(1)
    with contextlib.suppress(OSError, AttributeError):  # of glibc; others give memory back by themselves
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _OWN_PAGES_BYTES)
    return cv2


def decoded(data: bytes) -> Pixels:
    """The pixels of a JPEG, PNG or the like, turned upright; all metadata is dropped.

    Raises:
        NotAPicture: it cannot be decoded.
    """
    cv2 = opencv()
    if not data or len(data) > MAX_BYTES:
        raise NotAPicture(f"{len(data)} bytes are no picture; at most {MAX_BYTES // 1_000_000} MB are read")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise NotAPicture(f"the picture cannot be decoded: {error.err}") from None
    if picture is None:
        raise NotAPicture(f"the {len(data)} bytes are not a picture in a format that OpenCV reads")
    return np.asarray(picture, np.uint8)


def encoded(picture: Pixels) -> bytes:
    """A JPEG of the pixels and of nothing else.

    Raises:
        NotAPicture: it cannot be encoded.
    """
    cv2 = opencv()
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise NotAPicture(f"a picture of {picture.shape[1]}x{picture.shape[0]} pixels cannot be encoded")
    return bytes(data)


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
    cv2 = opencv()
    middle = cropped(picture, width, height)
    if middle.shape[:2] == (height, width):
        return np.ascontiguousarray(middle)
    how = cv2.INTER_AREA if middle.shape[1] > width else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(middle, (width, height), interpolation=how), np.uint8)


def reduced(picture: Pixels, width: int) -> Pixels:
    """The picture at a width, or as it is where it is narrower."""
    rows, columns = picture.shape[:2]
    if columns <= width:
        return picture
    cv2 = opencv()
    size = (width, max(round(rows * width / columns), 1))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
