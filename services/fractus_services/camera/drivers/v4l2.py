"""Camera driver for Linux video devices (V4L2), such as USB and CSI cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest, check_native_size
from fractus_services.camera.pixels import Pixels

_BUFFERED_FRAMES = 4
"""Number of old frames that the buffers of the kernel driver hold."""


class VideoDevice:
    """A video device. It is opened for the first image, and again after a failure.

    Args:
        path: Path of the device, such as /dev/video0.
    """

    latency_s = 0.0

    def __init__(self, path: str) -> None:
        self._path = path
        self._device: Any = None

    def capture(self, request: CaptureRequest) -> Pixels:
        """See `CameraDriver`."""
        if not Path(self._path).exists():
            self.close()
            raise CameraFailed(f"{self._path} does not exist; connect the camera, or correct its connection")
        if self._device is None:
            self._device = self._open(request)
        for _ in range(_BUFFERED_FRAMES):
            self._device.grab()
        try:
            done, picture = self._device.read()
        except cv2.error as error:
            self.close()
            raise CameraFailed(f"{self._path} returned no image ({error.err}); the next request reopens it") from None
        if not done or picture is None:
            self.close()
            raise CameraFailed(f"{self._path} returned no image; the next request reopens it")
        return check_native_size(np.asarray(picture, np.uint8), request)

    def close(self) -> None:
        """See `CameraDriver`."""
        if self._device is not None:
            self._device.release()
            self._device = None

    def _open(self, request: CaptureRequest) -> Any:
        device = cv2.VideoCapture(self._path, cv2.CAP_V4L2)
        if not device.isOpened():
            device.release()
            raise CameraFailed(
                f"cannot open {self._path} as a camera; check that it is a video device and that this service may use it"
            )
        device.set(cv2.CAP_PROP_FRAME_WIDTH, request.native[0])
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, request.native[1])
        device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        return device
