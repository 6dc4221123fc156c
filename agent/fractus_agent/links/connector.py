"""The end that asks: keeps the one direct link of a drone where it is wanted, and says how far it is."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from fractus_core.linking import NO_LINK, Link, Phase

from fractus_agent.links.addressing import link_address
from fractus_agent.links.interfaces import neighbours
from fractus_agent.links.pairing import LinkLost, PairingFailed, Session, ask
from fractus_agent.redirector.netlink import NetlinkError

log = logging.getLogger(__name__)

SILENT_S = 0.8
"""Who does not answer for so long may be asked at hardware that had its address before; TCP asks again after a second."""


class Connector:
    """Pairs with the wanted peer, and holds the session until another one is wanted or the link is lost.

    It does not try again by itself: after a failure the link is down, and the next decision on the wanted peer counts what the
    failure taught.

    Args:
        node: this node.
        directory: certificate, key and authority of this node.
        linked: runs while a session lasts: moves traffic, and moves it back.
        changed: called after each change of `link`, with the reason.
        address_of: the address of a peer on the link.
    """

    def __init__(
        self,
        node: str,
        directory: Path,
        linked: Callable[[Session], Awaitable[None]],
        changed: Callable[[Link, str], None],
        *,
        address_of: Callable[[str], IPv4Address] = link_address,
    ) -> None:
        self._node = node
        self._directory = directory
        self._linked = linked
        self._changed = changed
        self._address_of = address_of
        self._task: asyncio.Task[None] | None = None
        self.link: Link = NO_LINK

    async def want(self, peer: str, about: Mapping[str, Any] | None = None) -> None:
        """Link to a peer; a link to another one ends first, for a drone has one at a time.

        Args:
            peer: empty for none.
            about: what the peer is told of the link.
        """
        if peer == self.link.peer and self.link.phase is not Phase.NONE:
            return
        await self.close("another peer is wanted" if peer else "no link is wanted")
        if peer:
            self._set(Link(Phase.CONNECTING, peer, time.monotonic()), "pairing")
            self._task = asyncio.create_task(self._connect(peer, about or {}))

    async def close(self, reason: str = "the agent ends") -> None:
        """End the link, if there is one."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        if self.link.phase is not Phase.NONE:
            self._set(NO_LINK, reason)

    def _set(self, link: Link, reason: str) -> None:
        log.info("links: %s (peer=%s reason=%s)", link.phase.value, link.peer or self.link.peer, reason)
        self.link = link
        self._changed(link, reason)

    async def _connect(self, peer: str, about: Mapping[str, Any]) -> None:
        address = self._address_of(peer)
        silent = asyncio.get_running_loop().call_later(SILENT_S, _ask_again, address)
        try:
            session = await ask(self._node, peer, address, self._directory, about)
        except (PairingFailed, OSError) as error:
            self._set(NO_LINK, str(error))
            return
        finally:
            silent.cancel()
        try:
            self._set(Link(Phase.UP, peer, time.monotonic()), "paired")
            # Told before the farewell: over a link that is lost it takes a while, and traffic must not wait for it.
            self._set(NO_LINK, await self._hold(session))
        finally:
            await session.close()

    async def _hold(self, session: Session) -> str:
        """Hold a session; why it is over."""
        work = asyncio.ensure_future(self._linked(session))
        keep = asyncio.create_task(session.keep())
        try:
            done, _ = await asyncio.wait({work, keep}, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except LinkLost as lost:
            return str(lost)
        except Exception:
            log.exception("links: the link's traffic failed (peer=%s)", session.peer)
            return "the link's traffic failed"
        finally:
            for task in (work, keep):
                task.cancel()
            await asyncio.gather(work, keep, return_exceptions=True)
        return "the link's traffic is over"


def _ask_again(address: IPv4Address) -> None:
    try:
        neighbours.forget(address)
    except NetlinkError as error:
        log.warning("links: the kernel does not ask again who has an address (address=%s error=%s)", address, error)
