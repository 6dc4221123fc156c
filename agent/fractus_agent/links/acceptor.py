"""Accepting end of pairing: accepts sessions of the nodes that a DirectLink names, up to a limit."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections import defaultdict
from collections.abc import Callable, Coroutine
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from fractus_agent.links.pairing import (
    HANDSHAKE_TIMEOUT_S,
    MAX_LINE_BYTES,
    PAIRING_PORT,
    LinkLost,
    PairingFailed,
    Session,
    authenticated_node,
    server_context,
)

log = logging.getLogger(__name__)

MAX_PENDING = 8
"""Limit of concurrent handshakes. Each handshake costs a signature, and any device in range can start handshakes."""

_ACCEPT_RETRY_S = 0.2


class Acceptor:
    """Accepts pairing sessions on a direct interface.

    Args:
        directory: Directory of this node's certificate, key and authority. Read for each session, because they are
            renewed.
        refusal: Returns the reason why a node may not link to this node now, empty if it may.
        on_session: Runs while a session lasts. It moves traffic to the link at the start of the session, and back to
            the cloud path at its end.
        max_peers: Limit of concurrent sessions.
    """

    def __init__(
        self,
        directory: Path,
        refusal: Callable[[str], str],
        on_session: Callable[[Session], Coroutine[Any, Any, None]],
        *,
        max_peers: int = 4,
    ) -> None:
        self._directory = directory
        self._refusal_of = refusal
        self._on_session = on_session
        self._max_peers = max_peers
        self._pending = 0
        self._sessions: dict[str, asyncio.Task[None]] = {}
        self._locks: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def peers(self) -> frozenset[str]:
        """Names of the nodes that are linked to this node."""
        return frozenset(self._sessions)

    async def run(self, address: IPv4Address) -> None:
        """Accept sessions until cancelled.

        Raises:
            OSError: The port cannot be bound, or a file is missing.
            ssl.SSLError: The node's certificate is not usable.
        """
        server_context(self._directory)
        loop = asyncio.get_running_loop()
        with socket.create_server((str(address), PAIRING_PORT), backlog=MAX_PENDING) as listener:
            listener.setblocking(False)
            try:
                while True:
                    try:
                        connection, _ = await loop.sock_accept(listener)
                    except OSError as error:  # too many open files, or the peer has closed the connection
                        log.warning("links: connection not accepted (error=%s)", error)
                        await asyncio.sleep(_ACCEPT_RETRY_S)
                        continue
                    self._start(connection)
            finally:
                for task in self._tasks:
                    task.cancel()
                await asyncio.gather(*self._tasks, return_exceptions=True)

    def _start(self, connection: socket.socket) -> None:
        """Start a session, unless too many handshakes are pending."""
        if self._pending >= MAX_PENDING:
            connection.close()
            return
        self._pending += 1
        task = asyncio.create_task(self._run_session(connection))
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("links: session failed", exc_info=error)

    async def _run_session(self, connection: socket.socket) -> None:
        """Run one session from its handshake to its end."""
        session: Session | None = None
        try:
            try:
                session = await self._handshake(connection)
            finally:
                self._pending -= 1
            if session is not None:
                await self._hold(session)
        finally:
            if session is not None:
                if self._sessions.get(session.peer) is asyncio.current_task():
                    del self._sessions[session.peer]
                await session.close()

    async def _handshake(self, connection: socket.socket) -> Session | None:
        """Return the session of an authenticated and accepted node. Refuse any other node with a reason."""
        session: Session | None = None
        try:
            reader, writer = await _open_tls(connection, self._directory)
            session = Session(reader, writer, authenticated_node(writer))
            await session.receive(HANDSHAKE_TIMEOUT_S)
            reason = self._refusal(session.peer)
            if not reason:
                # The node counts as linked from here on. A node that pairs again has lost its old session.
                if (old := self._sessions.get(session.peer)) is not None:
                    old.cancel()
                self._sessions[session.peer] = _this_task()
            await session.send({"accepted": not reason, "reason": reason})
        except (LinkLost, PairingFailed, OSError, TimeoutError) as error:
            # Every radio in range can cause this line, so its rate is limited.
            log.warning("links: pairing failed (error=%s)", error, extra={"limit_by": "pairing"})
            reason = str(error) or "timeout"
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
            return f"{len(self._sessions)} other nodes are linked already"
        try:
            return self._refusal_of(peer)
        except Exception:
            log.exception("links: permission check failed, pairing refused (peer=%s)", peer)
            return "internal error in the permission check"

    async def _hold(self, session: Session) -> None:
        # Traffic of the peer's old session is moved back before traffic of this session moves.
        async with self._locks[session.peer]:
            log.info("links: up (peer=%s)", session.peer)
            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(session.run())
                    tasks.create_task(self._on_session(session))
            except* LinkLost as lost:
                log.info("links: lost (peer=%s reason=%s)", session.peer, lost.exceptions[0])


async def _open_tls(connection: socket.socket, directory: Path) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Return TLS streams on an accepted connection.

    Raises:
        PairingFailed: The handshake failed or timed out, or this node's certificate cannot be read.
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
        raise PairingFailed(f"TLS handshake failed: {error}") from error
    except BaseException:
        connection.close()
        raise
    return reader, asyncio.StreamWriter(transport, protocol, reader, loop)


def _this_task() -> asyncio.Task[None]:
    task = asyncio.current_task()
    assert task is not None
    return task
