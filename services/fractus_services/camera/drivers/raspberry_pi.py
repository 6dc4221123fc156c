"""Cameras of the Raspberry Pi, by its library picamera2."""

from __future__ import annotations

from typing import Any

import numpy as np

from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest, as_described
from fractus_services.camera.pixels import Pixels


class RaspberryPiCamera:
    """A camera module, started at the first picture and again after it failed.

    Args:
        number: of the camera, as `rpicam-hello --list-cameras` counts.
    """

    latency_s = 0.3
    """In the dark a slow sensor may deliver the frame that it was already exposing."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._camera: Any = None

    def capture(self, wanted: CaptureRequest) -> Pixels:
        """See `Driver`."""
        if self._camera is None:
            self._camera = self._started(wanted)
        try:
            # What picamera2 calls RGB888 has blue first in memory, as OpenCV expects it.
            picture = self._camera.capture_array("main")
        except (RuntimeError, OSError) as error:
            self.close()
            raise CameraFailed(
                f"camera {self._number} gives no picture ({error}); it is started again next time"
            ) from error
        return as_described(np.ascontiguousarray(picture[:, :, :3], np.uint8), wanted)

    def close(self) -> None:
        """See `Driver`."""
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.close()

    def _started(self, wanted: CaptureRequest) -> Any:
        try:
            from picamera2 import Picamera2  # noqa: PLC0415 - there on a Raspberry Pi only
        except ImportError:
            raise CameraFailed(
                "picamera2 is not installed; on a Raspberry Pi: apt-get install python3-picamera2, and a Python that sees it"
            ) from None
        try:
            camera = Picamera2(self._number)
        except (IndexError, RuntimeError, OSError) as error:
            raise CameraFailed(
                f"there is no camera {self._number} ({error}); check its cable and its connection"
            ) from None
        try:
            camera.configure(camera.create_still_configuration(main={"size": wanted.native, "format": "RGB888"}))
            camera.start()
        except (RuntimeError, OSError, ValueError) as error:
            camera.close()
            raise CameraFailed(f"camera {self._number} does not start: {error}") from None
        return camera
