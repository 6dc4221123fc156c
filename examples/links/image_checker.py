"""ImageChecker, in the cloud and at the edge: receives pictures and discards them (thesis 8.9.3).

It logs a JSON line for each picture.
"""

from __future__ import annotations

import asyncio
import json
import os
import time

import fractus

PORT = 8080


async def check(request: fractus.Request) -> bytes:
    """Return the name of the receiving instance."""
    by = os.environ["FRACTUS_NODE"]
    number = int(request.id.rpartition("-")[2])
    line = {"event": "received", "picture": number, "at": round(time.time(), 4), "by": by, "attempt": request.attempt}
    print(json.dumps(line), flush=True)
    return json.dumps({"by": by}).encode()


if __name__ == "__main__":
    asyncio.run(fractus.Responder({"check": check}, PORT).serve())
