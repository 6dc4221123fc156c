"""Camera driver for Raspberry Pi camera modules, based on picamera2."""

from __future__ import annotations

from typing import Any

import numpy as np

from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest, check_native_size
from fractus_services.camera.pixels import Pixels


class RaspberryPiCamera:
    """A camera module. It is started for the first image, and again after a failure.

    Args:
        number: Camera number as `rpicam-hello --list-cameras` lists it.
    """

    latency_s = 0.3
    """In low light, the sensor may return a frame whose exposure began this long before the request."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._camera: Any = None

    def capture(self, request: CaptureRequest) -> Pixels:
        """See `CameraDriver`."""
        if self._camera is None:
            self._camera = self._start(request)
        try:
            # In memory, the format RGB888 of picamera2 has blue first, as OpenCV expects.
            picture = self._camera.capture_array("main")
        except (RuntimeError, OSError) as error:
            self.close()
            raise CameraFailed(
                f"camera {self._number} returned no image ({error}); the next request restarts it"
            ) from error
        return check_native_size(np.ascontiguousarray(picture[:, :, :3], np.uint8), request)

    def close(self) -> None:
        """See `CameraDriver`."""
        if self._camera is not None:
            camera = self._camera
            self._camera = None
            camera.close()

    def _start(self, request: CaptureRequest) -> Any:
        try:
            # picamera2 exists on a Raspberry Pi only, and takes seconds to import.
            from picamera2 import Picamera2  # noqa: PLC0415
        except ImportError:
            raise CameraFailed(
                "picamera2 is not installed; on a Raspberry Pi run apt-get install python3-picamera2, and use a Python that"
                " finds it"
            ) from None
        try:
            camera = Picamera2(self._number)
        except (IndexError, RuntimeError, OSError) as error:
            raise CameraFailed(f"camera {self._number} not found ({error}); check its cable and connection") from None
        try:
            camera.configure(camera.create_still_configuration(main={"size": request.native, "format": "RGB888"}))
            camera.start()
        except (RuntimeError, OSError, ValueError) as error:
            camera.close()
            raise CameraFailed(f"cannot start camera {self._number}: {error}") from None
        return camera
