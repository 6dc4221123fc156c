"""Program of the link tests: the link manager of one node, in the network namespace of the process.

It reads the node, its DirectLinks and telemetry from files of its folder when they change, and prints the status that it
would write to the API server.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from collections.abc import AsyncGenerator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fractus_agent.links.link_manager import LinkManager
from fractus_agent.store import KubeError, LinkEnd, Listed, WatchEvent
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_core.linking import TelemetrySample
from fractus_runtime.metrics import serve_metrics

POLL_S = 0.2


class FileStore:
    """Fake store that reads its objects from files."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def read(self, name: str) -> Any:
        path = self._folder / name
        return json.loads(path.read_text()) if path.exists() else None

    async def direct_links(self, _end: LinkEnd) -> AsyncGenerator[WatchEvent, None]:
        before = None
        while True:
            links = self.read("links.json")
            if links is not None and links != before:
                before = links
                yield Listed(tuple(links))
            await asyncio.sleep(POLL_S)

    async def is_reachable(self, timeout_s: float) -> bool:
        if self.read("api.json") is False:
            await asyncio.sleep(timeout_s)
            return False
        return True

    async def apply_status(self, _kind: str, name: str, status: dict[str, Any], end: LinkEnd | None = None) -> None:
        if self.read("api.json") is False:
            raise KubeError(0, "Unreachable", "the API server is unreachable")
        print(json.dumps({"link": name, "end": end, "status": status}), flush=True)


async def main(folder: Path) -> None:
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(created).3f %(message)s")
    files = FileStore(folder)

    def resource() -> Drone | EdgeNode:
        body = files.read("node.json")
        return Drone.from_body(body) if body["kind"] == "Drone" else EdgeNode.from_body(body)

    def telemetry() -> TelemetrySample | None:
        sample = files.read("telemetry.json")
        if not sample:
            return None
        return TelemetrySample(sample["lat"], sample["lon"], sample["up"], 0.0, tuple(sample["velocity"]))

    links = LinkManager(
        files, resource().name, folder / "links", folder / "tls",  # type: ignore[arg-type]
        resource=resource, telemetry=telemetry, wall=lambda: datetime.now(UTC), audit=folder / "audit", pods=folder / "pods",
    )  # fmt: skip
    print("ready", flush=True)
    running = asyncio.create_task(links.run())
    loop = asyncio.get_running_loop()
    stdin = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(stdin), sys.stdin)
    reading = asyncio.create_task(stdin.read())
    async with serve_metrics("127.0.0.1:46812", links.metrics):
        await asyncio.wait({running, reading}, return_when=asyncio.FIRST_COMPLETED)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1])))
