"""Byte links to an autopilot over TCP, UDP and serial lines, with the URLs that MAVLink tools use."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import termios
import time
import tty
from collections.abc import Callable
from typing import Any, Protocol

from fractus_runtime.loopback import is_loopback
from fractus_runtime.mavlink_codec import Parser

from fractus_services.mobility.mavlink.vehicle_identification import is_vehicle_heartbeat

Receive = Callable[[bytes], None]
Closed = Callable[[Exception | None], None]

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 5.0
PEER_SILENCE_S = 3.0
"""Time without datagrams after which the autopilot may continue from another port."""


class BadUrl(ValueError):
    """The URL of the autopilot is invalid."""


class Transport(Protocol):
    """Open byte link."""

    def write(self, data: bytes) -> None:
        """Send bytes without waiting."""

    def close(self) -> None:
        """Close the link."""


class _Stream(asyncio.Protocol):
    def __init__(self, receive: Receive, closed: Closed) -> None:
        self._receive = receive
        self._closed = closed

    def data_received(self, data: bytes) -> None:
        self._receive(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._closed(exc)


class _Datagrams(asyncio.DatagramProtocol):
    """UDP link.

    A listening link belongs to the sender of the first heartbeat of an autopilot. Datagrams of other senders are dropped until that
    sender has been silent for a while.

    Args:
        receive: Callback for received bytes.
        closed: Callback invoked once when the link breaks.
        connected: True if the socket is connected to its peer and receives nothing from other senders.
    """

    def __init__(self, receive: Receive, closed: Closed, connected: bool) -> None:
        self._receive = receive
        self._closed = closed
        self._connected = connected
        self._peer: tuple[Any, ...] | None = None
        self._received_at = 0.0
        self._transport: Any = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        if not self._connected and not self._from_peer(data, addr):
            return
        self._receive(data)

    def _from_peer(self, data: bytes, addr: tuple[Any, ...]) -> bool:
        now = time.monotonic()
        if addr != self._peer:
            if self._peer is not None and now - self._received_at < PEER_SILENCE_S:
                return False
            if not _from_autopilot(data):
                return False
            log.info("link: autopilot detected (host=%s, port=%s)", addr[0], addr[1])
            self._peer = addr
        self._received_at = now
        return True

    def connection_lost(self, exc: Exception | None) -> None:
        self._closed(exc)

    def write(self, data: bytes) -> None:
        if self._transport is None:
            return
        if self._connected:
            self._transport.sendto(data)
        elif self._peer is not None:
            self._transport.sendto(data, self._peer)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


def _from_autopilot(data: bytes) -> bool:
    """Return True if a datagram contains an intact heartbeat of a flight controller."""
    return any(map(is_vehicle_heartbeat, Parser().feed(data)))


class _Serial:
    """Serial device in raw mode, read by the event loop."""

    def __init__(self, device: str, baud: int, receive: Receive, closed: Closed) -> None:
        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            raise BadUrl(f"serial speed {baud} is not supported; use 57600, 115200 or 921600")
        self._receive = receive
        self._closed = closed
        self._loop = asyncio.get_running_loop()
        self._fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            _configure(self._fd, speed)
        except termios.error as error:
            os.close(self._fd)
            raise OSError(*error.args) from error
        self._loop.add_reader(self._fd, self._readable)

    def _readable(self) -> None:
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return
        except OSError as error:
            self._fail(error)
            return
        if data:
            self._receive(data)
        else:
            self._fail(None)

    def _fail(self, error: Exception | None) -> None:
        self.close()
        self._closed(error)

    def write(self, data: bytes) -> None:
        if self._fd >= 0:
            try:
                os.write(self._fd, data)
            except BlockingIOError:
                return  # The line is busy. Drop the message, because the next setpoint replaces it.
            except OSError as error:
                self._fail(error)

    def close(self) -> None:
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1


def _configure(fd: int, speed: int) -> None:
    """Configure a raw line without modem control for exclusive use, because an autopilot has one owner."""
    tty.setraw(fd)
    settings = termios.tcgetattr(fd)
    settings[2] = (settings[2] | termios.CLOCAL | termios.CREAD) & ~termios.CRTSCTS
    settings[4] = settings[5] = speed
    termios.tcsetattr(fd, termios.TCSANOW, settings)
    fcntl.ioctl(fd, termios.TIOCEXCL)


async def open_link(url: str, receive: Receive, closed: Closed) -> Transport:
    """Open a link.

    Args:
        url: `tcp:HOST:PORT`, `udpin:HOST:PORT`, `udpout:HOST:PORT` or `serial:DEVICE:BAUD`. MAVLink does not authenticate
            senders, so `udpin` accepts loopback addresses only. `udpout` and `tcp` choose their peer.
        receive: Callback for received bytes.
        closed: Callback invoked once when the link breaks.

    Raises:
        BadUrl: The URL is invalid.
        OSError: The link cannot be opened.
    """
    scheme, _, rest = url.partition(":")
    address, _, number = rest.rpartition(":")
    if scheme not in {"tcp", "udpin", "udpout", "serial"} or not address or not number.isdigit():
        raise BadUrl(
            f"{url!r} is not an autopilot URL; use tcp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD"
        )
    if scheme == "udpin" and not is_loopback(address):
        raise BadUrl(f"{url!r} would accept an autopilot on any host; use udpin:127.0.0.1:{number}")
    if scheme == "serial":
        return _Serial(address, int(number), receive, closed)
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(CONNECT_TIMEOUT_S):
        if scheme == "tcp":
            transport, _ = await loop.create_connection(lambda: _Stream(receive, closed), address, int(number))
            return transport
        endpoint = (address, int(number))
        _, protocol = await loop.create_datagram_endpoint(
            lambda: _Datagrams(receive, closed, scheme == "udpout"),
            local_addr=endpoint if scheme == "udpin" else None,
            remote_addr=endpoint if scheme == "udpout" else None,
        )
        return protocol
