"""Limit of the connections to a web server (aiohttp). Clients without authorization can neither keep nor use up connections."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from aiohttp import web

MAX_CONNECTIONS = 512
UNAUTHORIZED_TIMEOUT_S = 10.0
"""Time after which a connection without an authorized request is closed."""


class ConnectionLimit:
    """Limits the open connections.

    At the limit, the oldest connection without an authorized request is closed for a new one, so that idle connections never
    keep a user out. A new connection is refused only if all others are authorized.

    Args:
        factory: Returns the protocol of a new connection.
        maximum: Maximum number of open connections.
    """

    def __init__(self, factory: Callable[[], asyncio.Protocol], maximum: int = MAX_CONNECTIONS) -> None:
        self._factory = factory
        self._maximum = maximum
        self._open: dict[_Connection, None] = {}

    def __call__(self) -> asyncio.Protocol:
        """Return the protocol of a new connection."""
        return _Connection(self._factory(), self)

    def opened(self, connection: _Connection) -> None:
        """Add a connection, and close another connection if there are too many."""
        self._open[connection] = None
        if len(self._open) > self._maximum:
            oldest = next((other for other in self._open if not other.authorized), connection)
            self.close(oldest)

    def closed(self, connection: _Connection) -> None:
        """Remove a connection."""
        self._open.pop(connection, None)

    def close(self, connection: _Connection) -> None:
        """Close a connection at once."""
        self.closed(connection)
        connection.abort()


class _Connection(asyncio.Protocol):
    """Passes the events of a connection to the protocol of the web server."""

    def __init__(self, inner: asyncio.Protocol, limit: ConnectionLimit) -> None:
        self.authorized = False
        self._inner = inner
        self._limit = limit
        self._transport: asyncio.BaseTransport | None = None
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        self._inner.connection_made(transport)
        self._timer = asyncio.get_running_loop().call_later(UNAUTHORIZED_TIMEOUT_S, self._expire)
        self._limit.opened(self)

    def _expire(self) -> None:
        if not self.authorized:
            self._limit.close(self)

    def abort(self) -> None:
        """Close the connection without waiting for the client."""
        if isinstance(self._transport, asyncio.WriteTransport):
            self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._limit.closed(self)
        self._inner.connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        return self._inner.eof_received()

    def pause_writing(self) -> None:
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        self._inner.resume_writing()


def mark_authorized(request: web.Request) -> None:
    """Keep the connection of an authorized request open."""
    protocol = request.transport.get_protocol() if request.transport is not None else None
    if isinstance(protocol, _Connection):
        protocol.authorized = True
