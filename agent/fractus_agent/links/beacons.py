"""Beacons: each node tells its name on its direct interface, so that others learn who is in reach.

A beacon proves nothing; it only says where pairing is worth an attempt.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
from collections.abc import Callable

from fractus_core.api.names import is_subdomain

log = logging.getLogger(__name__)

PORT = 46810
INTERVAL_S = 0.5
MAX_BYTES = 512
SO_BINDTODEVICE = 25


def beacon_socket(device: str) -> socket.socket:
    """A socket that sends and hears beacons on one device only.

    Raises:
        OSError: there is no such device, or no right to bind to it.
    """
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        found.setsockopt(socket.SOL_SOCKET, SO_BINDTODEVICE, device.encode() + b"\0")
        found.bind(("", PORT))
    except OSError:
        found.close()
        raise
    return found


def encode(node: str) -> bytes:
    """A beacon of a node."""
    return json.dumps({"fractus": 1, "node": node}).encode()


def decode(data: bytes) -> str | None:
    """Whose beacon this is; None for anything else."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return None
    node = content.get("node") if isinstance(content, dict) and content.get("fractus") == 1 else None
    return node if isinstance(node, str) and is_subdomain(node) else None


class Beacons(asyncio.DatagramProtocol):
    """Sends the beacons of this node, and tells of those of others.

    Args:
        node: this node.
        heard: called with the name of each node that is heard.
    """

    def __init__(self, node: str, heard: Callable[[str], None]) -> None:
        self._node = node
        self._heard = heard
        self._broken = asyncio.Event()

    def datagram_received(self, data: bytes, _addr: object) -> None:
        """Tell of a beacon."""
        node = decode(data[:MAX_BYTES])
        if node is not None and node != self._node:
            self._heard(node)

    def error_received(self, exc: Exception) -> None:
        """A beacon was not sent: the device may be down for a moment, or have been replaced by one of its name."""
        log.debug("links: beacon not sent (error=%s)", exc)
        self._broken.set()

    async def run(self, device: str) -> None:
        """Send and hear beacons on a device until cancelled; also on one that comes later, or comes back."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                transport, _ = await loop.create_datagram_endpoint(lambda: self, sock=beacon_socket(device))
            except OSError as error:
                log.debug("links: no beacons (device=%s error=%s)", device, error)
                await asyncio.sleep(INTERVAL_S)
                continue
            self._broken.clear()
            try:
                while not self._broken.is_set():
                    transport.sendto(encode(self._node), ("255.255.255.255", PORT))
                    await asyncio.sleep(INTERVAL_S)
            finally:
                transport.close()
