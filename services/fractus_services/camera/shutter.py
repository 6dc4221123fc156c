"""Takes pictures on a thread of its own: a camera that hangs blocks nothing but itself."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Callable

from fractus_services.camera.drivers.driver import TIMEOUT_S, CameraFailed, CaptureRequest, Driver
from fractus_services.camera.filters import MOTION_PX
from fractus_services.camera.pixels import Pixels, reduced

_Answer = asyncio.Future[list[Pixels]]


class Shutter:
    """One camera.

    Args:
        driver: its driver.
        timeout_s: for one picture; after that the camera counts as broken until it answers.
    """

    def __init__(self, driver: Driver, timeout_s: float = TIMEOUT_S + 1.0) -> None:
        self._driver = driver
        self._timeout_s = timeout_s
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._busy_since_s: float | None = None

    @property
    def latency_s(self) -> float:
        """How many seconds before `expose` begins its first picture may have been exposed, at most."""
        return self._driver.latency_s

    async def expose(self, wanted: CaptureRequest, count: int = 1, apart_s: float = 0.0) -> list[Pixels]:
        """Pictures one after the other; the one in the middle in full, the others reduced to `MOTION_PX`.

        Args:
            wanted: what is asked of the camera.
            count: how many.
            apart_s: seconds between them.

        Raises:
            CameraFailed: the camera gives none, or none in time.
        """
        if self._busy_since_s is not None:
            silent_s = time.monotonic() - self._busy_since_s
            raise CameraFailed(f"the camera has not answered for {silent_s:.0f} s; check it and its connection")
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
            self._thread.start()
        loop = asyncio.get_running_loop()
        answer: _Answer = loop.create_future()
        self._busy_since_s = time.monotonic()
        self._work.put(lambda: self._take(wanted, count, apart_s, loop, answer))
        try:
            async with asyncio.timeout(count * (self._timeout_s + apart_s)):
                return await answer
        except TimeoutError:
            raise CameraFailed(
                f"the camera gave no picture in {self._timeout_s:.0f} s; check it and its connection"
            ) from None

    def close(self) -> None:
        """Close the camera once it has finished."""
        self._work.put(None)

    def _run(self) -> None:
        while (job := self._work.get()) is not None:
            job()
        self._driver.close()

    def _take(
        self, wanted: CaptureRequest, count: int, apart_s: float, loop: asyncio.AbstractEventLoop, answer: _Answer
    ) -> None:
        pictures: list[Pixels] = []
        failure: Exception | None = None
        try:
            for i in range(count):
                if i:
                    time.sleep(apart_s)
                picture = self._driver.capture(wanted)
                pictures.append(picture if i == count // 2 else reduced(picture, MOTION_PX))
        except Exception as error:  # a driver may raise anything; it belongs to the caller
            failure = error
        self._busy_since_s = None
        if not loop.is_closed():
            loop.call_soon_threadsafe(_settle, answer, pictures, failure)


def _settle(answer: _Answer, pictures: list[Pixels], failure: Exception | None) -> None:
    if answer.done():
        return
    if failure is not None:
        answer.set_exception(failure)
    else:
        answer.set_result(pictures)
