"""The picture source that needs no camera: a rendered test picture with grid, place and time."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

GRID_PX = 80
QUALITY = 85


def render(width: int, height: int, lines: tuple[str, ...], time_s: float) -> bytes:
    """A JPEG of so many pixels that shows a grid and some lines of text.

    Args:
        width: pixels.
        height: pixels.
        lines: text, from the top left down.
        time_s: Unix time, for the colour of the ground and the text.
    """
    import cv2  # noqa: PLC0415 - 30 MB that a service which takes no picture does without

    cv2.setNumThreads(1)
    picture = np.empty((height, width, 3), np.uint8)
    rows = np.linspace(0, 1, height, dtype=np.float32)[:, None]
    columns = np.linspace(0, 1, width, dtype=np.float32)[None, :]
    picture[..., 0] = (60 + 40 * columns).astype(np.uint8)
    picture[..., 1] = (90 + 60 * rows + 0 * columns).astype(np.uint8)
    picture[..., 2] = np.uint8(70 + int(time_s) % 40)
    picture[::GRID_PX, :] = picture[:, ::GRID_PX] = (200, 200, 200)
    centre = (width // 2, height // 2)
    cv2.drawMarker(picture, centre, (255, 255, 255), cv2.MARKER_CROSS, max(min(width, height) // 10, 8), 2)
    scale = max(height / 900, 0.3)
    moment = datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds")
    for i, line in enumerate((*lines, moment), 1):
        at = (int(20 * scale), int(40 * scale * i))
        cv2.putText(picture, line, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), max(int(3 * scale), 2))
        cv2.putText(picture, line, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1)
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise ValueError(f"a picture of {width}x{height} pixels cannot be encoded")
    return bytes(encoded)
