"""TCP proxy in a MAVLink link. It forwards bytes, records both directions as a tlog, and can cut the link."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.tlog import Framer, TlogWriter

POLL_S = 0.2
READ_SIZE = 64 * 1024
CONNECT_S = 2.0
BACKLOG_LIMIT = 1024 * 1024


@dataclass(slots=True, eq=False)
class _End:
    """One end of a connection, with the bytes that are still to be sent to it."""

    socket: socket.socket
    framer: Framer
    server: bool
    peer: _End | None = None
    backlog: bytes = b""


class LinkTap:
    """Forwards each client of a listening socket to a server, in one thread.

    While the link is cut, existing and new connections stay open and all data is dropped, as with a radio out of range.

    Args:
        listener: Listening socket. The tap closes it.
        connect: Connects to the server. If it raises OSError or ExperimentError, the client is disconnected.
        log: File of the tlog.

    Attributes:
        received_bytes: Bytes that servers sent and the tap forwarded.
    """

    def __init__(self, listener: socket.socket, connect: Callable[[], socket.socket], log: Path) -> None:
        self._connect = connect
        self.received_bytes = 0
        self._log = TlogWriter(log)
        self._connected = True
        self._stop = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._listener = listener
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._ends: set[_End] = set()
        self._thread = threading.Thread(target=self._run, name="link-tap", daemon=True)
        self._thread.start()

    @classmethod
    def between(cls, port: int, target: tuple[str, int], log: Path) -> LinkTap:
        """Return a tap between a loopback port and a server."""
        listener = socket.create_server(("127.0.0.1", port))
        return cls(listener, lambda: socket.create_connection(target, CONNECT_S), log)

    def set_link(self, *, connected: bool) -> None:
        """Forward all traffic, or drop all traffic."""
        self._connected = connected

    def close(self) -> None:
        """Close all connections and the log."""
        self._stop.set()
        self._thread.join(5.0)
        for end in tuple(self._ends):
            end.socket.close()
        self._listener.close()
        self._selector.close()
        self._log.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            for key, events in self._selector.select(POLL_S):
                if key.data is None:
                    self._accept()
                    continue
                if events & selectors.EVENT_READ:
                    self._read(key.data)
                if events & selectors.EVENT_WRITE and key.data in self._ends:
                    self._send(key.data)

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:
            return
        try:
            server = self._connect()
        except (OSError, ExperimentError):
            client.close()
            return
        near = _End(client, Framer(self._log), server=False)
        far = _End(server, Framer(self._log), server=True)
        near.peer = far
        far.peer = near
        for end in (near, far):
            end.socket.setblocking(False)
            end.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._ends.add(end)
            self._selector.register(end.socket, selectors.EVENT_READ, end)

    def _read(self, end: _End) -> None:
        try:
            data = end.socket.recv(READ_SIZE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._disconnect(end)
            return
        if not self._connected or end.peer is None:
            return
        end.framer.feed(data, time.time_ns() // 1000)
        if end.server:
            self.received_bytes += len(data)
        peer = end.peer
        if len(peer.backlog) < BACKLOG_LIMIT:
            peer.backlog += data
        self._send(peer)

    def _send(self, end: _End) -> None:
        try:
            sent = end.socket.send(end.backlog) if end.backlog else 0
        except BlockingIOError:
            sent = 0
        except OSError:
            self._disconnect(end)
            return
        end.backlog = end.backlog[sent:]
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if end.backlog else 0)
        self._selector.modify(end.socket, events, end)

    def _disconnect(self, end: _End) -> None:
        """Close both ends of a connection."""
        for either in (end, end.peer):
            if either is not None and either in self._ends:
                self._ends.discard(either)
                with contextlib.suppress(KeyError, ValueError):
                    self._selector.unregister(either.socket)
                either.socket.close()
