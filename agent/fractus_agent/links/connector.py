"""Requesting end of pairing: keeps the direct link of a drone to the selected peer."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Mapping
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from fractus_core.linking import NO_LINK, LinkPhase, LinkState
from pyroute2 import NetlinkError

from fractus_agent.links import arp
from fractus_agent.links.device_addresses import link_address
from fractus_agent.links.pairing import LinkLost, PairingFailed, Session, pair

log = logging.getLogger(__name__)

ARP_FLUSH_S = 0.8
"""Time without a response after which the ARP entry of the peer is flushed, in seconds.

The address of the peer may have belonged to other hardware. TCP repeats its SYN after one second.
"""


class Connector:
    """Pairs with the selected peer, and keeps the session until another peer is selected or the link is lost.

    The connector does not retry. After a failure the link is down, and the next selection of a peer takes the failure into
    account.

    Args:
        node: Name of this node.
        directory: Directory of this node's certificate, key and authority.
        on_session: Runs while a session lasts. It moves traffic to the link at the start of the session, and back to
            the cloud path at its end.
        on_change: Called after each change of `link`, with the reason.
        address_of: Returns the address of a peer on the link.

    Attributes:
        link: Current state of the link.
    """

    def __init__(
        self,
        node: str,
        directory: Path,
        on_session: Callable[[Session], Coroutine[Any, Any, None]],
        on_change: Callable[[LinkState, str], None],
        *,
        address_of: Callable[[str], IPv4Address] = link_address,
    ) -> None:
        self._node = node
        self._directory = directory
        self._on_session = on_session
        self._on_change = on_change
        self._address_of = address_of
        self._task: asyncio.Task[None] | None = None
        self._flushes: set[asyncio.Task[None]] = set()
        self.link: LinkState = NO_LINK

    async def set_peer(self, peer: str, description: Mapping[str, Any] | None = None) -> None:
        """Link to a peer. A link to another peer ends first, because a drone has one link at a time.

        Args:
            peer: Name of the peer, empty for no link.
            description: Description of the link, sent to the peer.
        """
        if peer == self.link.peer and self.link.phase is not LinkPhase.NONE:
            return
        await self.close("another peer is selected" if peer else "no peer is selected")
        if peer:
            self._set(LinkState(LinkPhase.CONNECTING, peer, time.monotonic()), "pairing")
            self._task = asyncio.create_task(self._connect(peer, description or {}))

    async def close(self, reason: str = "the agent ends") -> None:
        """End the current link, if any."""
        task = self._task
        self._task = None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        if self.link.phase is not LinkPhase.NONE:
            self._set(NO_LINK, reason)

    def _set(self, link: LinkState, reason: str) -> None:
        log.info("links: %s (peer=%s reason=%s)", link.phase.value, link.peer or self.link.peer, reason)
        self.link = link
        self._on_change(link, reason)

    async def _connect(self, peer: str, description: Mapping[str, Any]) -> None:
        try:
            session = await self._pair(peer, description)
        except (PairingFailed, OSError) as error:
            self._set(NO_LINK, str(error))
            return
        except Exception:
            # Every failure must end the phase CONNECTING, or no peer would be tried again.
            log.exception("links: pairing failed (peer=%s)", peer)
            self._set(NO_LINK, "internal error during pairing")
            return
        try:
            self._set(LinkState(LinkPhase.UP, peer, time.monotonic()), "paired")
            # The loss is reported before the session is closed, because closing takes a while on a lost link.
            self._set(NO_LINK, await self._hold(session))
        finally:
            await session.close()

    async def _pair(self, peer: str, description: Mapping[str, Any]) -> Session:
        address = self._address_of(peer)
        flush = asyncio.get_running_loop().call_later(ARP_FLUSH_S, self._flush_arp, address)
        try:
            return await pair(self._node, peer, address, self._directory, description)
        finally:
            flush.cancel()

    async def _hold(self, session: Session) -> str:
        """Keep a session until it ends, and return the reason why it ended."""
        traffic = asyncio.create_task(self._on_session(session))
        heartbeats = asyncio.create_task(session.run())
        try:
            done, _ = await asyncio.wait({traffic, heartbeats}, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except LinkLost as lost:
            return str(lost)
        except Exception:
            log.exception("links: traffic handling failed (peer=%s)", session.peer)
            return "traffic handling failed"
        finally:
            for task in (traffic, heartbeats):
                task.cancel()
            await asyncio.gather(traffic, heartbeats, return_exceptions=True)
        return "the link's traffic has ended"

    def _flush_arp(self, address: IPv4Address) -> None:
        task = asyncio.create_task(_flush_arp(address))
        self._flushes.add(task)
        task.add_done_callback(self._flushes.discard)


async def _flush_arp(address: IPv4Address) -> None:
    try:
        await arp.flush(address)
    except (NetlinkError, OSError) as error:
        log.warning("links: cannot flush ARP entry (address=%s error=%s)", address, error)
