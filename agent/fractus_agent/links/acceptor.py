"""The end that is asked: takes sessions of the nodes that a DirectLink names, and no more than it has room for."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections import defaultdict
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

ACCEPT_RETRY_S = 0.2


class Acceptor:
    """Takes sessions on a direct interface.

    Args:
        directory: certificate, key and authority of this node; read for each session, since they are renewed.
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
        self._turns: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def peers(self) -> frozenset[str]:
        """The nodes that are linked to this one."""
        return frozenset(self._sessions)

    async def run(self, address: IPv4Address) -> None:
        """Take sessions until cancelled.

        Raises:
            OSError: the port cannot be bound, or a file is missing.
            ssl.SSLError: the node's certificate cannot be used.
        """
        server_context(self._directory)
        loop = asyncio.get_running_loop()
        with socket.create_server((str(address), PORT), backlog=MAX_PENDING) as listening:
            listening.setblocking(False)
            try:
                while True:
                    try:
                        connection, _ = await loop.sock_accept(listening)
                    except OSError as error:  # too many open files, or the peer was gone again
                        log.warning("links: connection not accepted (error=%s)", error)
                        await asyncio.sleep(ACCEPT_RETRY_S)
                        continue
                    self._take(connection)
            finally:
                for task in self._tasks:
                    task.cancel()
                await asyncio.gather(*self._tasks, return_exceptions=True)

    def _take(self, connection: socket.socket) -> None:
        """Begin a handshake, if there is room for one."""
        if self._pending >= MAX_PENDING:
            connection.close()
            return
        self._pending += 1
        task = asyncio.create_task(self._asked(connection))
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("links: session failed", exc_info=error)

    async def _asked(self, connection: socket.socket) -> None:
        """One session, from its handshake to its end."""
        session: Session | None = None
        try:
            try:
                session = await self._met(connection)
            finally:
                self._pending -= 1
            if session is not None:
                await self._hold(session)
        finally:
            if session is not None:
                if self._sessions.get(session.peer) is asyncio.current_task():
                    del self._sessions[session.peer]
                await session.close()

    async def _met(self, connection: socket.socket) -> Session | None:
        """The session of a node that has proven its name and is accepted; None for any other, which is told why."""
        session: Session | None = None
        try:
            reader, writer = await _encrypted(connection, self._directory)
            session = Session(reader, writer, proven_node(writer))
            await session.receive(HANDSHAKE_TIMEOUT_S)
            reason = self._refusal(session.peer)
            if not reason:
                # From here on the place is taken; a node that asks again has lost its old session, whether this end has
                # noticed or not.
                if (old := self._sessions.get(session.peer)) is not None:
                    old.cancel()
                self._sessions[session.peer] = _this_task()
            await session.send({"accepted": not reason, "reason": reason})
        except (LinkLost, PairingFailed, OSError, TimeoutError) as error:
            log.warning("links: pairing failed (error=%s)", error)
            reason = str(error) or "time-out"
        except BaseException:
            if session is not None:
                session.abort()
            raise
        if reason and session is not None:
            log.info("links: refused (peer=%s reason=%s)", session.peer, reason)
            if self._sessions.get(session.peer) is asyncio.current_task():
                del self._sessions[session.peer]
            await session.close()
        return None if reason else session

    def _refusal(self, peer: str) -> str:
        if len(self._sessions) >= self._max_peers and peer not in self._sessions:
            return f"{len(self._sessions)} nodes are linked already"
        try:
            return self._permits(peer)
        except Exception:
            log.exception("links: whether a node may link is unknown, so it may not (peer=%s)", peer)
            return "it is not known whether the link is permitted"

    async def _hold(self, session: Session) -> None:
        # Traffic of the peer's old session is moved back before that of this one is moved.
        async with self._turns[session.peer]:
            log.info("links: up (peer=%s)", session.peer)
            try:
                async with asyncio.TaskGroup() as both:
                    both.create_task(session.keep())
                    both.create_task(_run(self._linked, session))
            except* LinkLost as lost:
                log.info("links: lost (peer=%s reason=%s)", session.peer, lost.exceptions[0])


async def _encrypted(connection: socket.socket, directory: Path) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Streams over TLS on an accepted connection.

    Raises:
        OSError: the handshake failed, or took too long.
        PairingFailed: this node's certificate cannot be read at this moment.
    """
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader(limit=MAX_LINE_BYTES)
    protocol = asyncio.StreamReaderProtocol(reader)
    try:
        context = server_context(directory)
        transport, _ = await loop.connect_accepted_socket(
            lambda: protocol, connection, ssl=context, ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S
        )
    except (OSError, ssl.SSLError) as error:
        with contextlib.suppress(OSError):
            connection.close()
        raise PairingFailed(f"no TLS session: {error}") from error
    except BaseException:
        connection.close()
        raise
    return reader, asyncio.StreamWriter(transport, protocol, reader, loop)


def _this_task() -> asyncio.Task[None]:
    task = asyncio.current_task()
    assert task is not None
    return task


async def _run(linked: Callable[[Session], Awaitable[None]], session: Session) -> None:
    await linked(session)
