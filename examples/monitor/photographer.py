"""Photographer: takes a picture every PERIOD_S seconds, and stores it in the directory PICTURES (optional)."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from pathlib import Path

import fractus

log = logging.getLogger("photographer")


async def photograph(period_s: float, folder: Path | None) -> None:
    """Take pictures until SIGTERM."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGTERM, stop.set)
    due_s = loop.time()
    async with fractus.camera(reconnect_timeout_s=1.0) as camera:
        while not stop.is_set():
            try:
                picture = await camera.take()
                log.info("%s: %d bytes", picture.info.name, len(picture.data))
                if folder is not None:
                    (folder / picture.info.name).write_bytes(picture.data)
            except fractus.PolicyDenied as refusal:
                log.info("picture refused: %s", refusal)
            except fractus.FractusError as error:
                log.warning("picture failed: %s", error)
            due_s += period_s
            try:
                await asyncio.wait_for(stop.wait(), max(due_s - loop.time(), 0.0))
            except TimeoutError:
                continue


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    pictures = Path(os.environ["PICTURES"]) if "PICTURES" in os.environ else None
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
    asyncio.run(photograph(float(os.environ.get("PERIOD_S", "4")), pictures))
