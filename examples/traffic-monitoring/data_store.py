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
RESULTS = Path("/tmp/results.jsonl")  # nosec B108  # an emptyDir: survives a restart of the container
MAX_BYTES = 32 * 2**20
log = logging.getLogger("data-store")
writing = threading.Lock()
kept: set[str | None] = set()


def keep(body: bytes, headers: Message) -> dict[str, Any]:
    """Store a result once. Two ImageCheckers may check the same picture when the path changes.

    Raises:
        ValueError: it is not a JSON object.
        OSError: the store is full.
    """
    result = json.loads(body)
    if not isinstance(result, dict):
        raise ValueError("a result is a JSON object")  # noqa: TRY004 (error of the sender)
    line = json.dumps(result, separators=(",", ":")) + "\n"
    request = result.get("request")
    with writing:
        if request is not None and request in kept:
            return {"kept": False}
    with writing, RESULTS.open("a") as file:
        if file.tell() + len(line) > MAX_BYTES:
            raise OSError(f"the store is full at {MAX_BYTES} bytes")
        file.write(line)
        kept.add(request)
    log.info("kept %s of %s", result.get("picture"), result.get("source"))
    return {"kept": True}


def results(body: bytes, headers: Message) -> list[Any]:
    """Return all stored results, oldest first."""
    with writing:
        lines = RESULTS.read_text().splitlines() if RESULTS.exists() else []
    return [json.loads(line) for line in lines]


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    before = results(b"", Message())
    kept.update(result.get("request") for result in before)
    log.info("listening on port %d, %d results kept before", PORT, len(before))
    serve(PORT, get={"/results": results}, post={"/results": keep})
