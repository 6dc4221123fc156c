"""ARP entries of the kernel: the hardware address of a node on a link."""

from __future__ import annotations

import errno
import socket
from ipaddress import IPv4Address

from pyroute2 import AsyncIPRoute, NetlinkError

_PERMANENT = 0x80


async def flush(address: IPv4Address) -> None:
    """Delete the ARP entries of an address, so that the kernel resolves it again. Permanent entries stay.

    Anyone in range can claim an address, and the kernel keeps the claim for up to a minute after they have left.

    Raises:
        NetlinkError: The kernel refused the request.
        OSError: Netlink is not available.
    """
    async with AsyncIPRoute() as route:
        entries = [entry async for entry in await route.neigh("dump", family=socket.AF_INET)]
        for entry in entries:
            if entry.get("dst") != str(address) or entry["state"] & _PERMANENT:
                continue
            try:
                await route.neigh("del", dst=str(address), ifindex=entry["ifindex"])
            except NetlinkError as error:
                if error.code != errno.ENOENT:  # the kernel has deleted it
                    raise
