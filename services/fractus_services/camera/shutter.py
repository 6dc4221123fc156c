"""Camera thread: calls the blocking camera driver without blocking the event loop."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Callable

from fractus_services.camera.drivers.driver import CameraDriver, CameraFailed, CaptureRequest
from fractus_services.camera.motion_detection import MAX_MOTION_WIDTH_PX
from fractus_services.camera.pixels import Pixels, limit_width

_FramesFuture = asyncio.Future[list[Pixels]]


class Shutter:
    """Takes images with one camera on a thread.

    Args:
        driver: Driver of the camera.
        timeout_s: Time for one image, in seconds. Afterwards the camera counts as failed until the driver returns.
    """

    def __init__(self, driver: CameraDriver, timeout_s: float = 6.0) -> None:
        self._driver = driver
        self._timeout_s = timeout_s
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._busy_since_s: float | None = None

    @property
    def latency_s(self) -> float:
        """Maximum age of the first image when `expose` is called, in seconds."""
        return self._driver.latency_s

    async def expose(self, request: CaptureRequest, count: int = 1, interval_s: float = 0.0) -> list[Pixels]:
        """Take one or several frames. All but the middle frame are reduced to the width that motion detection needs.

        Args:
            request: Request for the image.
            count: Number of frames.
            interval_s: Interval between frames, in seconds.

        Raises:
            CameraFailed: The camera failed or returned no image in time.
        """
        if self._busy_since_s is not None:
            silent_s = time.monotonic() - self._busy_since_s
            raise CameraFailed(f"the camera has not responded for {silent_s:.0f} s; check it and its connection")
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
            self._thread.start()
        loop = asyncio.get_running_loop()
        frames: _FramesFuture = loop.create_future()
        self._busy_since_s = time.monotonic()
        self._jobs.put(lambda: self._take(request, count, interval_s, loop, frames))
        try:
            async with asyncio.timeout(count * (self._timeout_s + interval_s)):
                return await frames
        except TimeoutError:
            raise CameraFailed(
                f"the camera returned no image within {self._timeout_s:.0f} s; check it and its connection"
            ) from None

    def close(self) -> None:
        """Close the camera after the current job."""
        self._jobs.put(None)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()
        self._driver.close()

    def _take(
        self,
        request: CaptureRequest,
        count: int,
        interval_s: float,
        loop: asyncio.AbstractEventLoop,
        frames: _FramesFuture,
    ) -> None:
        pictures: list[Pixels] = []
        failure: Exception | None = None
        try:
            for i in range(count):
                if i:
                    time.sleep(interval_s)
                picture = self._driver.capture(request)
                pictures.append(picture if i == count // 2 else limit_width(picture, MAX_MOTION_WIDTH_PX))
        except Exception as error:  # A driver may raise any exception. The caller of `expose` receives it.
            failure = error
        self._busy_since_s = None
        if not loop.is_closed():
            loop.call_soon_threadsafe(_resolve, frames, pictures, failure)


def _resolve(frames: _FramesFuture, pictures: list[Pixels], failure: Exception | None) -> None:
    """Set the result of a future, unless its caller has stopped waiting."""
    if frames.done():
        return
    if failure is not None:
        frames.set_exception(failure)
    else:
        frames.set_result(pictures)
