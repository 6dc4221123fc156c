"""Planned switches in progress: old connections finish on their path in the background while decisions continue."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping

from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft_maps import Endpoint, RedirectFailed
from fractus_agent.redirector.redirector import Redirector

log = logging.getLogger(__name__)


class ConnectionDrain:
    """Switches services whose old path still works. Their old connections may finish on that path.

    Args:
        redirector: Redirector of this node.
        on_end: Called when a drain has ended.
    """

    def __init__(self, redirector: Redirector, on_end: Callable[[], None]) -> None:
        self._redirector = redirector
        self._on_end = on_end
        self._on_link: dict[asyncio.Task[object], bool] = {}

    @property
    def on_link(self) -> bool:
        """True if old connections may still use the direct link although their services use the cloud path now."""
        return any(self._on_link.values())

    async def begin(self, targets: Mapping[Endpoint, Endpoint | None]) -> None:
        """Redirect services, and drain their old connections in the background.

        Args:
            targets: Target by virtual endpoint of a service, None for the cloud path.

        Raises:
            NetlinkError: The kernel refused the transaction.
            RedirectFailed: The table was removed, and cannot be created again.
        """
        direct = self._redirector.redirects.keys()
        for on_link in (True, False):
            selected = {service: to for service, to in targets.items() if (service in direct) is on_link}
            if not selected:
                continue
            task: asyncio.Task[object] = asyncio.create_task(self._redirector.switch(selected, planned=True))
            self._on_link[task] = on_link
            await asyncio.sleep(0)  # run the task until it has written the map or failed
            if task.done():
                del self._on_link[task]
                task.result()
            else:
                task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[object]) -> None:
        del self._on_link[task]
        if not task.cancelled() and (error := task.exception()) is not None:
            if isinstance(error, NetlinkError | RedirectFailed):
                log.warning("links: old connections not drained (error=%s)", error)
            else:
                log.error("links: switch failed", exc_info=error)
        self._on_end()

    async def cut(self, *, on_link: bool) -> None:
        """Close the connections on a lost path at once.

        Args:
            on_link: True if the direct link is lost, False if the cloud path is lost.
        """
        tasks = [task for task, drains_link in self._on_link.items() if drains_link is on_link]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
