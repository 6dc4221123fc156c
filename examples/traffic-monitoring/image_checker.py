"""ImageChecker, near the camera or in the cloud: reads a picture's header and reports to the DataStore."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import os
import struct

import fractus
from web import post

PORT = 8080
log = logging.getLogger("image-checker")


async def check(request: fractus.Request) -> bytes:
    """Return the properties of the picture, and send them to the DataStore with the request id that identifies repetitions.

    Raises:
        ValueError: it is no picture.
        OSError: the DataStore is away; the sender repeats its request.
    """
    line, _, picture = request.body.partition(b"\n")
    told = json.loads(line)
    kind, width, height = measure(picture)
    result = {
        "request": request.id,
        "picture": str(told.get("picture", "")),
        "source": str(told.get("source", "")),
        "by": os.environ.get("FRACTUS_INSTANCE", "") + "@" + os.environ.get("FRACTUS_NODE", ""),
        "kind": kind,
        "width": width,
        "height": height,
        "bytes": len(picture),
        "sha256": hashlib.sha256(picture).hexdigest(),
        "summary": f"{kind} {width}x{height}, {8 * len(picture) / (width * height):.2f} bits a pixel",
    }
    headers = {"Content-Type": "application/json"}
    await asyncio.to_thread(post, fractus.egress("DataStore"), "/results", json.dumps(result).encode(), headers)
    log.info("%s from %s: %s", result["picture"], result["source"], result["summary"])
    return json.dumps(result).encode()


def measure(picture: bytes) -> tuple[str, int, int]:
    """Return type, width and height of a PNG or JPEG from its header.

    Raises:
        ValueError: it is neither, or its headers are broken.
    """
    if picture.startswith(b"\x89PNG\r\n\x1a\n") and len(picture) > 24:
        width, height = struct.unpack_from(">II", picture, 16)
        return "PNG", max(width, 1), max(height, 1)
    at = 2 if picture.startswith(b"\xff\xd8") else len(picture)
    while at + 9 < len(picture) and picture[at] == 0xFF:
        marker = picture[at + 1]
        length = struct.unpack_from(">H", picture, at + 2)[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start-of-frame segment
            height, width = struct.unpack_from(">HH", picture, at + 5)
            return "JPEG", max(width, 1), max(height, 1)
        at += 2 + length
    raise ValueError("this is neither a PNG nor a JPEG")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    log.info("listening on port %d", PORT)
    asyncio.run(fractus.Responder({"check": check}, PORT).serve())
