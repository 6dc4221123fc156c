"""Common part of the viewers: takes pictures at intervals and sends them to the ImageChecker."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import struct
import zlib

import fractus

log = logging.getLogger("viewer")


async def watch(interval_s: float) -> None:
    """Take, retrieve and send pictures until SIGTERM. Failures are logged."""
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    number = 0
    logged_code = ""
    async with fractus.camera(reconnect_timeout_s=1.0) as camera, fractus.requester("ImageChecker") as checker:
        while not stop.is_set():
            number += 1
            try:
                name, picture = await take_picture(camera, number)
                result = json.loads(await checker.request("check", pack(name, os.environ["FRACTUS_INSTANCE"], picture)))
                log.info("sent %s (%d bytes), result of %s: %s", name, len(picture), result["by"], result["summary"])
            except fractus.PolicyDenied as refusal:
                if refusal.code != logged_code:
                    log.info("pictures refused: %s", refusal)
                logged_code = refusal.code
            except fractus.FractusError as error:
                log.warning("picture %d: %s", number, error)
            else:
                logged_code = ""
            try:
                await asyncio.wait_for(stop.wait(), interval_s)
            except TimeoutError:
                continue


async def take_picture(camera: fractus.Camera, number: int) -> tuple[str, bytes]:
    """Return a picture of the node's camera, or a test picture if the node has no camera service."""
    try:
        picture = await camera.take()
    except fractus.Unavailable:
        return f"test-{number}.png", render(160, 120, number)
    return picture.info.name, picture.data


def pack(name: str, source: str, picture: bytes) -> bytes:
    """Encode a picture: a JSON line with its source, followed by its bytes."""
    return json.dumps({"picture": name, "source": source}).encode() + b"\n" + picture


def render(width: int, height: int, number: int) -> bytes:
    """Return a grey PNG of a road with a car whose position depends on the number."""
    rows = []
    for y in range(height):
        road = height // 3 < y < 2 * height // 3
        row = bytearray([90 if road else 150]) * width
        if road and abs(y - height // 2) < height // 12:
            left = number * 7 % (width - 16)
            row[left : left + 16] = bytes([230]) * 16
        rows.append(b"\0" + bytes(row))
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(b"".join(rows))), (b"IEND", b""))
    chunks = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def main(interval_s: float) -> None:
    """Run a viewer until SIGTERM."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    asyncio.run(watch(interval_s))
