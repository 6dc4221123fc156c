"""Cameras of Linux (V4L2): USB and CSI cameras with a /dev/video device."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest, as_described
from fractus_services.camera.pixels import Pixels, opencv

_STALE_FRAMES = 4
"""Pictures that the driver's buffers hold from before."""


class VideoDevice:
    """A video device, opened at the first picture and again after it failed.

    Args:
        path: such as /dev/video0.
    """

    latency_s = 0.0

    def __init__(self, path: str) -> None:
        self._path = path
        self._device: Any = None

    def capture(self, wanted: CaptureRequest) -> Pixels:
        """See `Driver`."""
        cv2 = opencv()
        if not Path(self._path).exists():
            self.close()
            raise CameraFailed(f"there is no {self._path}; connect the camera, or correct its connection")
        if self._device is None:
            self._device = self._opened(wanted)
        for _ in range(_STALE_FRAMES):
            self._device.grab()
        try:
            done, picture = self._device.read()
        except cv2.error as error:
            self.close()
            raise CameraFailed(f"{self._path} gives no picture ({error.err}); it is opened again next time") from None
        if not done or picture is None:
            self.close()
            raise CameraFailed(f"{self._path} gives no picture; it is opened again next time")
        return as_described(np.asarray(picture, np.uint8), wanted)

    def close(self) -> None:
        """See `Driver`."""
        if self._device is not None:
            self._device.release()
            self._device = None

    def _opened(self, wanted: CaptureRequest) -> Any:
        cv2 = opencv()
        device = cv2.VideoCapture(self._path, cv2.CAP_V4L2)
        if not device.isOpened():
            device.release()
            raise CameraFailed(f"{self._path} cannot be opened as a camera; is it one, and may this service use it?")
        device.set(cv2.CAP_PROP_FRAME_WIDTH, wanted.native[0])
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted.native[1])
        device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        return device
