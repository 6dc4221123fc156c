"""Planned switches under way: old connections finish on the path that they are on, while the drone's end goes on deciding."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping

from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft import Endpoint, RedirectFailed
from fractus_agent.redirector.redirector import Redirector

log = logging.getLogger(__name__)


class Drains:
    """Switches services whose old path still lives.

    Args:
        redirector: of this node.
        ended: called when one has ended.
    """

    def __init__(self, redirector: Redirector, ended: Callable[[], None]) -> None:
        self._redirector = redirector
        self._ended = ended
        self._on_link: dict[asyncio.Task[object], bool] = {}

    @property
    def on_link(self) -> bool:
        """Whether connections may be on the direct link still, which their services have left."""
        return any(self._on_link.values())

    async def begin(self, targets: Mapping[Endpoint, Endpoint | None]) -> None:
        """Lead services elsewhere; their old connections are closed as they become idle, in the background.

        Raises:
            NetlinkError: the kernel refused.
            RedirectFailed: our table is gone and cannot be made again.
        """
        direct = self._redirector.redirects.keys()
        for on_link in (True, False):
            if some := {service: to for service, to in targets.items() if (service in direct) is on_link}:
                task: asyncio.Task[object] = asyncio.create_task(self._redirector.switch(some, planned=True))
                self._on_link[task] = on_link
                await asyncio.sleep(0)  # the map is written, or refused, before a switch waits for anything
                if task.done():
                    del self._on_link[task]
                    task.result()
                else:
                    task.add_done_callback(self._over)

    def _over(self, task: asyncio.Task[object]) -> None:
        del self._on_link[task]
        if not task.cancelled() and (error := task.exception()) is not None:
            if not isinstance(error, NetlinkError | RedirectFailed):
                log.error("links: a switch failed", exc_info=error)
            else:
                log.warning("links: old connections are not drained (error=%s)", error)
        self._ended()

    async def cut(self, *, on_link: bool) -> None:
        """A path is gone: close at once what is on it still."""
        tasks = [task for task, whether in self._on_link.items() if whether is on_link]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
