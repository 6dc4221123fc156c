"""The camera that needs no hardware: a drawn test picture with grid, place and time."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from fractus_services.camera.drivers.driver import CaptureRequest
from fractus_services.camera.pixels import Pixels, opencv

GRID_PX = 80


class TestPattern:
    """Draws a grid, the node's name, and where and when it is."""

    latency_s = 0.0

    def capture(self, wanted: CaptureRequest) -> Pixels:
        """See `Driver`."""
        cv2 = opencv()
        now, width, height = wanted.now, wanted.width, wanted.height
        picture = np.empty((height, width, 3), np.uint8)
        rows = np.linspace(0, 1, height, dtype=np.float32)[:, None]
        columns = np.linspace(0, 1, width, dtype=np.float32)[None, :]
        picture[..., 0] = (60 + 40 * columns).astype(np.uint8)
        picture[..., 1] = (90 + 60 * rows + 0 * columns).astype(np.uint8)
        picture[..., 2] = np.uint8(70 + int(now.time_s) % 40)
        picture[::GRID_PX, :] = picture[:, ::GRID_PX] = (200, 200, 200)
        centre = (width // 2, height // 2)
        cv2.drawMarker(picture, centre, (255, 255, 255), cv2.MARKER_CROSS, max(min(width, height) // 10, 8), 2)
        scale = max(height / 900, 0.3)
        place = f"{now.lat:.7f} {now.lon:.7f} {now.altitude_m:.1f} m" if now.lat is not None else "no fix"
        moment = datetime.fromtimestamp(now.time_s, UTC).isoformat(timespec="milliseconds")
        for i, line in enumerate((wanted.label, place, moment), 1):
            at = (int(20 * scale), int(40 * scale * i))
            cv2.putText(picture, line, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), max(int(3 * scale), 2))
            cv2.putText(picture, line, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1)
        return picture

    def close(self) -> None:
        """Nothing to close."""
