"""Serves the page of `fractus view` with events of a test, without a flight or a cluster."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager

from aiohttp import web
from fractus_view.events import Event
from fractus_view.hub import Hub
from fractus_view.server import ViewServer


class PageSource:
    """`Source` of events that the test publishes."""

    def __init__(self) -> None:
        self.hub = Hub()
        self.pictures: dict[str, bytes] = {}
        self._loop = asyncio.new_event_loop()

    def publish(self, *events: Event) -> None:
        """Send events to the page, or add them to its first state if the page is not served yet."""
        if not self._loop.is_running():
            self.hub.publish(events)
            return
        asyncio.run_coroutine_threadsafe(self._publish(events), self._loop).result(20)

    async def _publish(self, events: tuple[Event, ...]) -> None:
        self.hub.publish(events)

    def picture(self, id_: str) -> bytes | None:
        return self.pictures.get(id_)

    def stream(self, last_id: str) -> AsyncIterator[bytes]:
        return self.hub.stream(last_id)

    async def run(self) -> None:
        pass

    @contextmanager
    def serving(self, **options: object) -> Iterator[str]:
        """Serve the page in a thread, and yield its address with the token."""
        server = ViewServer(self, frozenset(), **options)  # type: ignore[arg-type]
        runner = web.AppRunner(server.application(), shutdown_timeout=0.1)
        thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        thread.start()

        async def start() -> int:
            await runner.setup()
            await web.TCPSite(runner, "127.0.0.1", 0).start()
            return int(runner.addresses[0][1])

        port = asyncio.run_coroutine_threadsafe(start(), self._loop).result(20)
        try:
            yield f"http://127.0.0.1:{port}/?token={server.token}"
        finally:
            asyncio.run_coroutine_threadsafe(runner.cleanup(), self._loop).result(20)
            self._loop.call_soon_threadsafe(self._loop.stop)
            thread.join(20)
            self._loop.close()
