"""ImageChecker, near the camera or in the cloud: reads a picture's header and reports to the DataStore."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import os
import struct

import fractus

PORT = 8080
STORE_TIMEOUT_S = 5.0
log = logging.getLogger("image-checker")


class ImageChecker:
    """Checks pictures.

    Args:
        store: Client of the DataStore.
    """

    def __init__(self, store: fractus.Requester) -> None:
        self._store = store

    async def check(self, request: fractus.Request) -> bytes:
        """Return the properties of a picture, and send them to the DataStore. The request id identifies repeated requests.

        Raises:
            ValueError: The request contains no picture.
            Unavailable: The DataStore is unreachable. The sender repeats its request.
        """
        first_line, _, picture = request.body.partition(b"\n")
        header = json.loads(first_line)
        kind, width, height = measure(picture)
        result = {
            "request": request.id,
            "picture": str(header.get("picture", "")),
            "source": str(header.get("source", "")),
            "by": os.environ.get("FRACTUS_INSTANCE", "") + "@" + os.environ.get("FRACTUS_NODE", ""),
            "kind": kind,
            "width": width,
            "height": height,
            "bytes": len(picture),
            "sha256": hashlib.sha256(picture).hexdigest(),
            "summary": f"{kind} {width}x{height}, {8 * len(picture) / (width * height):.2f} bits per pixel",
        }
        body = json.dumps(result).encode()
        await self._store.request("store", body, timeout_s=STORE_TIMEOUT_S, request_id=request.id)
        log.info("%s from %s: %s", result["picture"], result["source"], result["summary"])
        return body


def measure(picture: bytes) -> tuple[str, int, int]:
    """Return type, width and height of a PNG or JPEG from its header.

    Raises:
        ValueError: The picture has another type, or its header is damaged.
    """
    if picture.startswith(b"\x89PNG\r\n\x1a\n") and len(picture) > 24:
        width, height = struct.unpack_from(">II", picture, 16)
        return "PNG", max(width, 1), max(height, 1)
    offset = 2 if picture.startswith(b"\xff\xd8") else len(picture)
    while offset + 9 < len(picture) and picture[offset] == 0xFF:
        marker = picture[offset + 1]
        length = struct.unpack_from(">H", picture, offset + 2)[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start-of-frame segment
            height, width = struct.unpack_from(">HH", picture, offset + 5)
            return "JPEG", max(width, 1), max(height, 1)
        offset += 2 + length
    raise ValueError("the picture is neither a PNG nor a JPEG")


async def main() -> None:
    """Serve requests until SIGTERM."""
    log.info("listening on port %d", PORT)
    async with fractus.requester("DataStore") as store:
        await fractus.Responder({"check": ImageChecker(store).check}, PORT).serve()


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    asyncio.run(main())
