"""Images as pixel arrays: decoding within limits, cropping, resizing and JPEG encoding."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageOps

from fractus_services.errors import PreconditionFailed

Pixels = npt.NDArray[np.uint8]
"""Array of shape (height, width, 3) with blue, green and red channels of 8 bits, as OpenCV uses it."""

JPEG_QUALITY = 90
MAX_PIXELS = 50_000_000
MAX_BYTES = 64_000_000
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
"""Formats that are decoded. Other decoders of Pillow are excluded, because untrusted data could exploit them."""


class InvalidImage(PreconditionFailed):
    """The data is not a readable image, or the image is too large."""

    def __init__(self, reason: str) -> None:
        super().__init__("FilterUnavailable", reason)


def decode_image(data: bytes) -> Pixels:
    """Decode an image, rotate it upright as its EXIF orientation requires, and drop all metadata.

    Raises:
        InvalidImage: The data cannot be decoded completely, or exceeds `MAX_BYTES` or `MAX_PIXELS`.
    """
    if not data or len(data) > MAX_BYTES:
        raise InvalidImage(f"cannot decode an image of {len(data)} bytes; the limit is {MAX_BYTES // 1_000_000} MB")
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as source:
            if source.width * source.height > MAX_PIXELS:
                raise InvalidImage(
                    f"cannot decode an image of {source.width}x{source.height} pixels; the limit is {MAX_PIXELS} pixels"
                )
            ImageOps.exif_transpose(source, in_place=True)
            if source.mode.startswith("I;16"):
                image: Image.Image = Image.fromarray((np.asarray(source) >> 8).astype(np.uint8))
            else:
                image = source
            return np.ascontiguousarray(np.asarray(image.convert("RGB"))[..., ::-1])
    except InvalidImage:
        raise
    except Exception as error:
        raise InvalidImage(f"cannot decode {len(data)} bytes as {' or '.join(FORMATS)}: {error}") from None


def encode_jpeg(picture: Pixels) -> bytes:
    """Encode pixels as a JPEG without metadata.

    Raises:
        InvalidImage: JPEG does not support this size.
    """
    out = io.BytesIO()
    height, width = picture.shape[:2]
    try:
        image = Image.frombuffer("RGB", (width, height), np.ascontiguousarray(picture), "raw", "BGR", 0, 1)
        image.save(out, "JPEG", quality=JPEG_QUALITY)
    except (OSError, SystemError, ValueError):
        raise InvalidImage(f"cannot encode an image of {width}x{height} pixels as JPEG") from None
    return out.getvalue()


def resize(picture: Pixels, width: int, height: int) -> Pixels:
    """Resize an image. Shrinking averages pixels, and enlarging interpolates linearly."""
    resampling = Image.Resampling.BOX if picture.shape[1] > width else Image.Resampling.BILINEAR
    return np.array(Image.fromarray(np.ascontiguousarray(picture)).resize((width, height), resampling))


def limit_width(picture: Pixels, width: int) -> Pixels:
    """Shrink an image to a width, or return it unchanged if it is narrower."""
    rows, columns = picture.shape[:2]
    if columns <= width:
        return picture
    return resize(picture, width, max(round(rows * width / columns), 1))


def source_size(width: int, height: int, native: tuple[int, int]) -> tuple[int, int]:
    """Return the smallest size with the aspect ratio of `native` that can be cropped to `width` and `height`."""
    scale = max(width / native[0], height / native[1])
    return max(round(native[0] * scale), width), max(round(native[1] * scale), height)


def crop_to_aspect_ratio(picture: Pixels, width: int, height: int) -> Pixels:
    """Return the largest centred part of an image that has the aspect ratio of `width` and `height`."""
    rows, columns = picture.shape[:2]
    scale = max(width / columns, height / rows)
    kept_columns = min(round(width / scale), columns)
    kept_rows = min(round(height / scale), rows)
    left = (columns - kept_columns) // 2
    top = (rows - kept_rows) // 2
    return picture[top : top + kept_rows, left : left + kept_columns]


def crop_and_resize(picture: Pixels, width: int, height: int) -> Pixels:
    """Crop an image to the aspect ratio of `width` and `height`, and resize it to that size."""
    middle = crop_to_aspect_ratio(picture, width, height)
    if middle.shape[:2] == (height, width):
        return np.ascontiguousarray(middle)
    return resize(middle, width, height)
