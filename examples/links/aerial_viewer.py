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
LIFE = uuid.uuid4().hex
"""Unique per start, because picture numbers start again after a restart and request ids must not repeat."""
log = logging.getLogger("viewer")


async def watch() -> None:
    """Take and send pictures until SIGTERM, without waiting for earlier ones."""
    over = asyncio.Event()
    sending = set[asyncio.Task[None]]()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGTERM, over.set)
    begun = loop.time()
    async with fractus.camera(reconnect_timeout_s=1.0) as camera, fractus.requester("ImageChecker") as checker:
        for number in itertools.count(1):
            task = asyncio.create_task(pass_on(camera, checker, number))
            sending.add(task)
            task.add_done_callback(sending.discard)
            try:
                await asyncio.wait_for(over.wait(), max(begun + number * PERIOD_S - loop.time(), 0.0))
            except TimeoutError:
                continue
            break
        await asyncio.gather(*sending)


async def pass_on(camera: fractus.Camera, checker: fractus.Requester, number: int) -> None:
    """Take a picture and send it to the ImageChecker."""
    try:
        picture = await look(camera)
    except fractus.FractusError as error:
        log.info("no picture %d: %s", number, error)
        return
    request = f"{os.environ['FRACTUS_INSTANCE']}-{LIFE}-{number}"
    tell("sent", number, bytes=len(picture))
    begun = time.monotonic()
    try:
        answer = json.loads(await checker.request("check", picture, request_id=request))
    except fractus.FractusError as error:
        log.warning("picture %d is lost: %s", number, error)
        return
    tell("answered", number, by=answer["by"], took_s=round(time.monotonic() - begun, 4))


async def look(camera: fractus.Camera) -> bytes:
    """Return a picture of the drone's camera, or random bytes of the same size if there is no camera."""
    if size := int(os.environ.get("PICTURE_BYTES", "0")):
        return os.urandom(size)
    return (await camera.take()).data


def tell(event: str, number: int, **more: Any) -> None:
    """Log the result of one picture as a JSON line."""
    print(json.dumps({"event": event, "picture": number, "at": round(time.time(), 4), **more}), flush=True)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    asyncio.run(watch())
