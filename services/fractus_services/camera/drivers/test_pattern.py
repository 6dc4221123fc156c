"""Camera driver without hardware: draws a test pattern with a grid, the node name, the position and the time."""

from __future__ import annotations

from datetime import UTC, datetime

import cv2
import numpy as np

from fractus_services.camera.drivers.driver import CaptureRequest
from fractus_services.camera.pixels import Pixels

GRID_PX = 80


class TestPattern:
    """Draws a grid, the label of the request, the position and the time."""

    __test__ = False  # not a test class of pytest
    latency_s = 0.0

    def capture(self, request: CaptureRequest) -> Pixels:
        """See `CameraDriver`."""
        situation = request.situation
        width = request.width
        height = request.height
        picture = np.empty((height, width, 3), np.uint8)
        rows = np.linspace(0, 1, height, dtype=np.float32)[:, None]
        columns = np.linspace(0, 1, width, dtype=np.float32)[None, :]
        picture[..., 0] = (60 + 40 * columns).astype(np.uint8)
        picture[..., 1] = (90 + 60 * rows + 0 * columns).astype(np.uint8)
        picture[..., 2] = np.uint8(70 + int(situation.time_s) % 40)
        picture[::GRID_PX, :] = picture[:, ::GRID_PX] = (200, 200, 200)
        centre = (width // 2, height // 2)
        cv2.drawMarker(picture, centre, (255, 255, 255), cv2.MARKER_CROSS, max(min(width, height) // 10, 8), 2)
        scale = max(height / 900, 0.3)
        position = "no fix"
        if situation.lat is not None:
            position = f"{situation.lat:.7f} {situation.lon:.7f} {situation.altitude_m:.1f} m"
        time = datetime.fromtimestamp(situation.time_s, UTC).isoformat(timespec="milliseconds")
        for i, line in enumerate((request.label, position, time), 1):
            origin = (int(20 * scale), int(40 * scale * i))
            cv2.putText(picture, line, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), max(int(3 * scale), 2))
            cv2.putText(picture, line, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1)
        return picture

    def close(self) -> None:
        """See `CameraDriver`."""
