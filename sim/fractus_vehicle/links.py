"""Links of the vehicle: TCP server, UDP in and out, serial devices and pseudo terminals.

All links are non-blocking and polled once per tick. A peer that does not read fills only its own bounded outbox.
"""

from __future__ import annotations

import math
import os
import selectors
import socket
import termios
import tty
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from fractus_services.mavlink_server.channel import Channel

from fractus_vehicle.simulation import Craft

READ_SIZE = 16 * 1024
READS_PER_POLL = 8
MAX_CLIENTS = 16
DATAGRAM_SIZE = 1400
MAX_PORT = 65535


class LinkError(ValueError):
    """A link specification that is invalid or cannot be opened."""


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """Parsed link specification: `tcp`, `udpin`, `udpout` with host and port, `serial` or `pty` with a path."""

    kind: str
    host: str = ""
    port: int = 0
    path: str = ""
    baud: int = 115200

    @classmethod
    def parse(cls, text: str) -> LinkSpec:
        """Parse `kind:host:port`, `serial:path[:baud]` or `pty:path`.

        Raises:
            LinkError: The text has none of these forms.
        """
        kind, _, rest = text.partition(":")
        if kind in ("tcp", "tcpin", "udpin", "udpout", "udp"):
            host, colon, port = rest.rpartition(":")
            if not colon or not port.isdigit() or int(port) > MAX_PORT:
                raise LinkError(f"link {text!r}: expected {kind}:HOST:PORT")
            kind = {"tcpin": "tcp", "udp": "udpin"}.get(kind, kind)
            return cls(kind, host or "0.0.0.0", int(port))  # nosec B104  # noqa: S104 - what `tcp::5760` means in MAVLink
        if kind == "serial" and rest:
            path, _, baud = rest.rpartition(":")
            return cls(kind, path=path, baud=int(baud)) if baud.isdigit() and path else cls(kind, path=rest)
        if kind == "pty" and rest:
            return cls(kind, path=rest)
        raise LinkError(f"link {text!r}: expected tcp:, udpin:, udpout:, serial: or pty:")

    def shifted(self, by: int) -> LinkSpec:
        """Return the link of the vehicle with index `by` in a formation. Its port or path differs for each index.

        Ports of TCP links are 10 apart.

        Raises:
            LinkError: The port number would be too large.
        """
        if by == 0:
            return self
        if self.path:
            return replace(self, path=f"{self.path}-{by}")
        port = self.port + by * (10 if self.kind == "tcp" else 1)
        if port > MAX_PORT:
            raise LinkError(f"link {self}: vehicle {by + 1} would need port {port}; use a lower first port")
        return replace(self, port=port)

    def __str__(self) -> str:
        return f"{self.kind}:{self.path}" if self.path else f"{self.kind}:{self.host}:{self.port}"


class Hub:
    """All links of all vehicles, multiplexed by one selector."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._flushers: list[Callable[[], None]] = []
        self._closers: list[Callable[[], None]] = []

    def open(self, spec: LinkSpec, craft: Craft, port: int) -> None:
        """Open a link of a vehicle as its serial port number `port`.

        Raises:
            LinkError: The address is in use or the device is missing.
        """
        try:
            if spec.kind == "tcp":
                _TcpServer(self, spec, craft, port)
            elif spec.kind in ("udpin", "udpout"):
                _Udp(self, spec, craft, port)
            else:
                _Terminal(self, spec, craft, port)
        except OSError as error:
            raise LinkError(f"link {spec}: {error.strerror or error}") from error

    def watch(self, fileno: int, on_readable: Callable[[], None]) -> None:
        """Call `on_readable` in each poll in which the descriptor is readable."""
        self._selector.register(fileno, selectors.EVENT_READ, on_readable)

    def forget(self, fileno: int) -> None:
        """Stop watching a descriptor."""
        self._selector.unregister(fileno)

    def add_flush(self, flush: Callable[[], None]) -> None:
        """Register a function that is called at each flush."""
        self._flushers.append(flush)

    def remove_flush(self, flush: Callable[[], None]) -> None:
        """Stop calling `flush`."""
        self._flushers.remove(flush)

    def add_close(self, close: Callable[[], None]) -> None:
        """Register a function that is called when the hub closes."""
        self._closers.append(close)

    def poll(self, timeout_s: float = 0.0) -> None:
        """Receive available data. If no data is available, wait for data up to `timeout_s`."""
        for key, _ in self._selector.select(timeout_s):
            key.data()

    def wait(self, timeout_s: float) -> bool:
        """Wait until data is available for the next poll, or the timeout expires. Return True if data is available.

        The timeout is rounded down to milliseconds, because the selector would round it up.
        """
        return bool(self._selector.select(math.floor(timeout_s * 1e3) / 1e3))

    def flush(self) -> None:
        """Send all queued data."""
        for flush in tuple(self._flushers):
            flush()

    def close(self) -> None:
        """Close all links."""
        for close in self._closers:
            close()
        self._selector.close()


class _TcpServer:
    def __init__(self, hub: Hub, spec: LinkSpec, craft: Craft, port: int) -> None:
        self._hub = hub
        self._craft = craft
        self._port = port
        self._clients: set[_TcpClient] = set()
        family = socket.AF_INET6 if ":" in spec.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((spec.host, spec.port))
            self._socket.listen(MAX_CLIENTS)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)
        hub.watch(self._socket.fileno(), self._accept)
        hub.add_close(self._close)

    def _accept(self) -> None:
        try:
            connection, _ = self._socket.accept()
        except (BlockingIOError, ConnectionError):
            return
        if len(self._clients) >= MAX_CLIENTS:
            connection.close()
            return
        client = _TcpClient(self._hub, connection, self._craft, self._port, gone=self._clients.discard)
        self._clients.add(client)

    def _close(self) -> None:
        for client in tuple(self._clients):
            client.close()
        self._socket.close()


class _TcpClient:
    def __init__(
        self, hub: Hub, connection: socket.socket, craft: Craft, port: int, *, gone: Callable[[_TcpClient], None]
    ) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._hub = hub
        self._socket = connection
        self._craft = craft
        self._gone = gone
        self._channel = craft.open("tcp", port)
        self._unsent = b""
        hub.watch(connection.fileno(), self._read)
        hub.add_flush(self._flush)

    def _read(self) -> None:
        for _ in range(READS_PER_POLL):
            try:
                data = self._socket.recv(READ_SIZE)
            except BlockingIOError:
                return
            except OSError:
                self.close()
                return
            if not data:
                self.close()
                return
            self._craft.receive(self._channel, data)
            if len(data) < READ_SIZE:
                return

    def _flush(self) -> None:
        if not self._unsent:
            self._unsent = self._channel.take()
        if not self._unsent:
            return
        try:
            sent = self._socket.send(self._unsent)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        self._unsent = self._unsent[sent:]

    def close(self) -> None:
        """Close the connection and its channel."""
        self._hub.forget(self._socket.fileno())
        self._hub.remove_flush(self._flush)
        self._craft.close(self._channel)
        self._socket.close()
        self._gone(self)


class _Udp:
    def __init__(self, hub: Hub, spec: LinkSpec, craft: Craft, port: int) -> None:
        self._hub = hub
        self._craft = craft
        self._port = port
        family = socket.AF_INET6 if ":" in spec.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        # Channels by the address of the peer. A `udpout` link has only one channel, with the key None.
        self._channels: dict[tuple[str, int] | None, Channel] = {}
        try:
            if spec.kind == "udpin":
                self._socket.bind((spec.host, spec.port))
            else:
                self._socket.connect((spec.host, spec.port))
                self._channels[None] = craft.open("udp", port)
        except OSError:
            self._socket.close()
            raise
        hub.watch(self._socket.fileno(), self._read)
        hub.add_flush(self._flush)
        hub.add_close(self._socket.close)

    def _read(self) -> None:
        for _ in range(READS_PER_POLL * 8):
            try:
                data, address = self._socket.recvfrom(READ_SIZE)
            except (BlockingIOError, ConnectionError):
                return
            key = None if None in self._channels else address
            channel = self._channels.get(key)
            if channel is None:
                if len(self._channels) >= MAX_CLIENTS:
                    oldest = next(iter(self._channels))
                    self._craft.close(self._channels.pop(oldest))
                channel = self._channels[key] = self._craft.open("udp", self._port)
            self._craft.receive(channel, data)

    def _flush(self) -> None:
        for key, channel in self._channels.items():
            while channel.frames:
                datagram = channel.take_frame()
                while channel.frames and len(datagram) + len(channel.frames[0]) <= DATAGRAM_SIZE:
                    datagram += channel.take_frame()
                try:
                    if key is None:
                        self._socket.send(datagram)
                    else:
                        self._socket.sendto(datagram, key)
                except (BlockingIOError, ConnectionError):
                    break


class _Terminal:
    """A serial device, or a pseudo terminal whose far end is linked at a path."""

    def __init__(self, hub: Hub, spec: LinkSpec, craft: Craft, port: int) -> None:
        self._craft = craft
        self._far: int | None = None
        self._link: Path | None = None
        if spec.kind == "pty":
            path = Path(spec.path)
            if path.exists() and not path.is_symlink():
                raise LinkError(f"link {spec}: path exists and is not a symbolic link; use another path")
            self._fd, self._far = os.openpty()
            tty.setraw(self._far)
            self._link = path
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(os.ttyname(self._far))
        else:
            self._fd = os.open(spec.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            if os.isatty(self._fd):
                _set_speed(self._fd, spec.baud)
        os.set_blocking(self._fd, False)
        self._channel = craft.open(spec.kind, port)
        self._unsent = b""
        hub.watch(self._fd, self._read)
        hub.add_flush(self._flush)
        hub.add_close(self._close)

    def _read(self) -> None:
        try:
            data = os.read(self._fd, READ_SIZE)
        except OSError:
            return
        self._craft.receive(self._channel, data)

    def _flush(self) -> None:
        self._unsent = self._unsent or self._channel.take()
        if not self._unsent:
            return
        try:
            sent = os.write(self._fd, self._unsent)
        except OSError:
            return
        self._unsent = self._unsent[sent:]

    def _close(self) -> None:
        os.close(self._fd)
        if self._far is not None:
            os.close(self._far)
        if self._link is not None:
            self._link.unlink(missing_ok=True)


def _set_speed(fd: int, baud: int) -> None:
    tty.setraw(fd)
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise LinkError(f"baud rate {baud} is not supported on this system")
    attributes = termios.tcgetattr(fd)
    attributes[4] = attributes[5] = speed
    termios.tcsetattr(fd, termios.TCSANOW, attributes)
