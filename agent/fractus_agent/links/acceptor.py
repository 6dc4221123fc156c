"""The end that is asked: takes sessions of the nodes that a DirectLink names, and no more than it has room for."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable
from ipaddress import IPv4Address
from pathlib import Path

from fractus_agent.links.pairing import (
    HANDSHAKE_TIMEOUT_S,
    MAX_LINE_BYTES,
    PORT,
    LinkLost,
    PairingFailed,
    Session,
    proven_node,
    server_context,
)

log = logging.getLogger(__name__)

MAX_PENDING = 8
"""Handshakes at one time: each costs a signature, and anyone in reach can ask for one."""


class Acceptor:
    """Takes sessions on a direct interface.

    Args:
        directory: certificate, key and authority of this node.
        permits: whether a node may link to this one now; what it returns is the reason why not, empty for a yes.
        linked: runs while a session lasts: moves traffic, and moves it back.
        max_peers: sessions at one time.
    """

    def __init__(
        self,
        directory: Path,
        permits: Callable[[str], str],
        linked: Callable[[Session], Awaitable[None]],
        *,
        max_peers: int = 4,
    ) -> None:
        self._directory = directory
        self._permits = permits
        self._linked = linked
        self._max_peers = max_peers
        self._pending = 0
        self._sessions: dict[str, asyncio.Task[None]] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def peers(self) -> frozenset[str]:
        """The nodes that are linked to this one."""
        return frozenset(self._sessions)

    async def run(self, address: IPv4Address) -> None:
        """Take sessions until cancelled.

        Raises:
            OSError: the port cannot be bound.
            ssl.SSLError: the node's certificate cannot be used.
        """
        server = await asyncio.start_server(
            self._asked, str(address), PORT, ssl=server_context(self._directory), limit=MAX_LINE_BYTES,
            ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S,
        )  # fmt: skip
        try:
            await server.serve_forever()
        finally:
            server.close()
            for task in [*self._sessions.values(), *self._tasks]:
                task.cancel()
            await asyncio.gather(*self._sessions.values(), *self._tasks, return_exceptions=True)

    async def _asked(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._pending >= MAX_PENDING:
            writer.transport.abort()
            return
        self._pending += 1
        session: Session | None = None
        try:
            session = Session(reader, writer, proven_node(writer))
            await session.receive(HANDSHAKE_TIMEOUT_S)
            reason = self._refusal(session.peer)
            await session.send({"accepted": not reason, "reason": reason})
        except (LinkLost, PairingFailed) as error:
            log.warning("links: pairing failed (error=%s)", error)
            reason = str(error)
        finally:
            self._pending -= 1
        if session is None or reason:
            if session is not None:
                log.info("links: refused (peer=%s reason=%s)", session.peer, reason)
            writer.transport.abort() if session is None else await session.close()
            return
        # A node that asks again has lost its old session, whether this end has noticed or not.
        if (old := self._sessions.get(session.peer)) is not None:
            old.cancel()
            await asyncio.gather(old, return_exceptions=True)
        task = asyncio.create_task(self._hold(session))
        self._sessions[session.peer] = task
        task.add_done_callback(lambda done: self._ended(session.peer, done))

    def _refusal(self, peer: str) -> str:
        if len(self._sessions) >= self._max_peers and peer not in self._sessions:
            return f"{len(self._sessions)} nodes are linked already"
        return self._permits(peer)

    async def _hold(self, session: Session) -> None:
        log.info("links: up (peer=%s)", session.peer)
        try:
            async with asyncio.TaskGroup() as both:
                both.create_task(session.keep())
                both.create_task(_run(self._linked, session))
        except* LinkLost as lost:
            log.info("links: lost (peer=%s reason=%s)", session.peer, lost.exceptions[0])
        finally:
            await session.close()

    def _ended(self, peer: str, task: asyncio.Task[None]) -> None:
        if self._sessions.get(peer) is task:
            del self._sessions[peer]
        with contextlib.suppress(asyncio.CancelledError):
            if (error := task.exception()) is not None:
                log.error("links: session failed (peer=%s)", peer, exc_info=error)


async def _run(linked: Callable[[Session], Awaitable[None]], session: Session) -> None:
    await linked(session)
