"""Beacons: each node broadcasts its name on its direct interface, so that others learn which nodes are in range.

A beacon proves nothing. It only shows that an attempt to pair is worthwhile.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
from collections.abc import Callable

from fractus_core.api.names import is_subdomain
from fractus_runtime.files import parse_json

log = logging.getLogger(__name__)

BEACON_PORT = 46810
BEACON_INTERVAL_S = 0.5
MAX_BEACON_BYTES = 512
SO_BINDTODEVICE = 25


def beacon_socket(device: str) -> socket.socket:
    """Open a socket that sends and receives beacons on one device only.

    Raises:
        OSError: The device does not exist, or the process may not bind to it.
    """
    beacons = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    try:
        beacons.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        beacons.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        beacons.setsockopt(socket.SOL_SOCKET, SO_BINDTODEVICE, device.encode() + b"\0")
        beacons.bind(("", BEACON_PORT))
    except OSError:
        beacons.close()
        raise
    return beacons


def encode(node: str) -> bytes:
    """Encode a beacon of a node."""
    return json.dumps({"fractus": 1, "node": node}).encode()


def decode(data: bytes) -> str | None:
    """Return the node name in a beacon, None for any other datagram."""
    try:
        content = parse_json(data)
    except ValueError:
        return None
    node = content.get("node") if isinstance(content, dict) and content.get("fractus") == 1 else None
    return node if isinstance(node, str) and is_subdomain(node) else None


class Beacons(asyncio.DatagramProtocol):
    """Sends the beacons of this node, and receives the beacons of other nodes.

    Args:
        node: Name of this node.
        on_beacon: Called with the node name of each received beacon.
    """

    def __init__(self, node: str, on_beacon: Callable[[str], None]) -> None:
        self._node = node
        self._on_beacon = on_beacon
        self._broken = asyncio.Event()

    def datagram_received(self, data: bytes, _addr: object) -> None:
        """Handle a received beacon."""
        node = decode(data[:MAX_BEACON_BYTES])
        if node is not None and node != self._node:
            self._on_beacon(node)

    def error_received(self, exc: Exception) -> None:
        """Handle a failure to send a beacon. The device may be down, or its name may now belong to another device."""
        log.debug("links: beacon not sent (error=%s)", exc)
        self._broken.set()

    async def run(self, device: str) -> None:
        """Send and receive beacons on a device until cancelled. The device may appear and disappear."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                transport, _ = await loop.create_datagram_endpoint(lambda: self, sock=beacon_socket(device))
            except OSError as error:
                log.debug("links: beacons not started (device=%s error=%s)", device, error)
                await asyncio.sleep(BEACON_INTERVAL_S)
                continue
            self._broken.clear()
            try:
                while not self._broken.is_set():
                    transport.sendto(encode(self._node), ("255.255.255.255", BEACON_PORT))
                    await asyncio.sleep(BEACON_INTERVAL_S)
            finally:
                transport.close()
