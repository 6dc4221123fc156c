"""DataStore, in the cloud: stores the results of the ImageCheckers as JSON lines for the lifetime of its pod."""

from __future__ import annotations

import json
import logging
import threading
from email.message import Message
from pathlib import Path
from typing import Any

from web import serve

PORT = 8080
RESULTS = Path("/tmp/results.jsonl")  # nosec B108  # an emptyDir: it survives a restart of the container
MAX_BYTES = 32 * 2**20
log = logging.getLogger("data-store")
lock = threading.Lock()
stored: set[str | None] = set()
"""Ids of the requests whose results are stored."""


def store(body: bytes, headers: Message) -> dict[str, Any]:
    """Store a result once. Two ImageCheckers may check the same picture if the path of the traffic changes.

    Raises:
        ValueError: The body is not a JSON object.
        OSError: The store is full.
    """
    result = json.loads(body)
    if not isinstance(result, dict):
        raise ValueError("a result must be a JSON object")  # noqa: TRY004 (the sender receives status 400)
    line = json.dumps(result, separators=(",", ":")) + "\n"
    request = result.get("request")
    with lock:
        if request is not None and request in stored:
            return {"stored": False}
    with lock, RESULTS.open("a") as file:
        if file.tell() + len(line) > MAX_BYTES:
            raise OSError(f"the store is full at {MAX_BYTES} bytes")
        file.write(line)
        stored.add(request)
    log.info("stored %s of %s", result.get("picture"), result.get("source"))
    return {"stored": True}


def results(body: bytes, headers: Message) -> list[Any]:
    """Return all stored results, oldest first."""
    with lock:
        lines = RESULTS.read_text().splitlines() if RESULTS.exists() else []
    return [json.loads(line) for line in lines]


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    earlier = results(b"", Message())
    stored.update(result.get("request") for result in earlier)
    log.info("listening on port %d (stored results: %d)", PORT, len(earlier))
    serve(PORT, get={"/results": results}, post={"/results": store})
