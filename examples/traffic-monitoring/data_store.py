"""DataStore, in the cloud: stores the results of the ImageCheckers as JSON lines for the lifetime of its pod."""

from __future__ import annotations

import asyncio
import json
import logging
from pathlib import Path

import fractus

PORT = 8080
RESULTS = Path("/tmp/results.jsonl")  # nosec B108  # an emptyDir: it survives a restart of the container
MAX_BYTES = 32 * 2**20
log = logging.getLogger("data-store")


class DataStore:
    """Stores results in a file.

    Args:
        path: The file. Results that it already contains are kept.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        lines = path.read_text().splitlines() if path.exists() else []
        self._stored = {json.loads(line).get("request") for line in lines}

    async def store(self, request: fractus.Request) -> bytes:
        """Store a result once. Two ImageCheckers may check the same picture if the path of the traffic changes.

        Raises:
            ValueError: The body is not a JSON object.
            OSError: The store is full.
        """
        result = json.loads(request.body)
        if not isinstance(result, dict):
            raise ValueError("a result must be a JSON object")  # noqa: TRY004 (the sender must not repeat the request)
        if result.get("request") in self._stored:
            return b""
        line = json.dumps(result, separators=(",", ":")) + "\n"
        with self._path.open("a") as file:
            if file.tell() + len(line) > MAX_BYTES:
                raise OSError(f"the store is full at {MAX_BYTES} bytes")
            file.write(line)
        self._stored.add(result.get("request"))
        log.info("stored %s of %s", result.get("picture"), result.get("source"))
        return b""


async def main() -> None:
    """Serve requests until SIGTERM."""
    store = DataStore(RESULTS)
    log.info("listening on port %d", PORT)
    await fractus.Responder({"store": store.store}, PORT).serve()


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    asyncio.run(main())
