"""AerialViewer, a passenger: sends one picture per second to the ImageChecker over the best path.

It logs a JSON line for each sent picture and each response.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import os
import signal
import time
import uuid
from typing import Any

import fractus

PERIOD_S = float(os.environ.get("PERIOD_S", "1"))
START_ID = uuid.uuid4().hex
"""Random id of this process. Picture numbers begin at 1 after a restart, and request ids must not repeat."""
log = logging.getLogger("viewer")


async def watch() -> None:
    """Take and send pictures until SIGTERM. A slow picture does not delay the next one."""
    stop = asyncio.Event()
    sending = set[asyncio.Task[None]]()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGTERM, stop.set)
    start_s = loop.time()
    async with fractus.camera(reconnect_timeout_s=1.0) as camera, fractus.requester("ImageChecker") as checker:
        for number in itertools.count(1):
            task = asyncio.create_task(take_and_send(camera, checker, number))
            sending.add(task)
            task.add_done_callback(sending.discard)
            try:
                await asyncio.wait_for(stop.wait(), max(start_s + number * PERIOD_S - loop.time(), 0.0))
            except TimeoutError:
                continue
            break
        await asyncio.gather(*sending)


async def take_and_send(camera: fractus.Camera, checker: fractus.Requester, number: int) -> None:
    """Take a picture and send it to the ImageChecker."""
    try:
        picture = await take_picture(camera)
    except fractus.FractusError as error:
        log.info("picture %d failed: %s", number, error)
        return
    request = f"{os.environ['FRACTUS_INSTANCE']}-{START_ID}-{number}"
    log_event("sent", number, bytes=len(picture))
    start_s = time.monotonic()
    try:
        response = json.loads(await checker.request("check", picture, request_id=request))
    except fractus.FractusError as error:
        log.warning("picture %d lost: %s", number, error)
        return
    log_event("answered", number, by=response["by"], took_s=round(time.monotonic() - start_s, 4))


async def take_picture(camera: fractus.Camera) -> bytes:
    """Return a picture of the drone's camera, or random bytes of the same size if there is no camera."""
    if size := int(os.environ.get("PICTURE_BYTES", "0")):
        return os.urandom(size)
    return (await camera.take()).data


def log_event(event: str, number: int, **details: Any) -> None:
    """Log an event of one picture as a JSON line."""
    print(json.dumps({"event": event, "picture": number, "at": round(time.time(), 4), **details}), flush=True)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    asyncio.run(watch())
