"""Link-local IPv4 addresses of direct interfaces.

Each node derives its address from its name, so that nodes need not agree on addresses. The address translation of the
kernel needs IPv4, and it cannot translate to IPv6 link-local addresses. If two names give the same address, pairing
fails, because the certificate at that address belongs to another node.
"""

from __future__ import annotations

import errno
import hashlib
import socket
from ipaddress import IPv4Address, IPv4Network
from typing import Any

from pyroute2 import AsyncIPRoute, NetlinkError

LINK_LOCAL = IPv4Network("169.254.0.0/16")
_FIRST = int(IPv4Address("169.254.1.0"))
_COUNT = 254 * 256
"""RFC 3927 reserves the first and last 256 addresses of 169.254.0.0/16."""

RAISED = " [raised by fractus-agent]"
"""Suffix that marks a device as brought up by the agent, in the device's alias.

The mark remains if the agent is killed, and disappears at a reboot. If the device already has an alias, the suffix is
appended.
"""
_MAX_ALIAS_BYTES = 255
_IFF_UP = 1
_MAIN_TABLE = 254


def link_address(node: str) -> IPv4Address:
    """Return the address of a node on its direct links."""
    number = int.from_bytes(hashlib.sha256(node.encode()).digest()[:4], "big")
    return IPv4Address(_FIRST + number % _COUNT)


class NoDevice(Exception):
    """The network device does not exist."""


class DeviceAddresses:
    """Link-local addresses and up state of one device, in the network namespace of the process.

    Args:
        device: Name of the device. It may appear and disappear.
    """

    def __init__(self, device: str) -> None:
        self._device = device

    async def other_traffic(self) -> str:
        """Return evidence that the device carries traffic other than direct links, or an empty string.

        Raises:
            NoDevice: The device does not exist.
            NetlinkError: The kernel refused a request.
            OSError: Netlink is not available.
        """
        async with AsyncIPRoute() as route:
            index = await self._index(route)
            for address in await _addresses(route, index):
                if address not in LINK_LOCAL:
                    return f"it has the address {address}"
            async for entry in await route.route("dump", family=socket.AF_INET):
                hops = [entry.get("oif"), *(hop["oif"] for hop in entry.get("multipath") or ())]
                if entry["dst_len"] == 0 and entry.get("table") == _MAIN_TABLE and index in hops:
                    return "it has a default route"
        return ""

    async def set(self, address: IPv4Address) -> None:
        """Bring the device up with this link-local address. Remove other link-local addresses, which a crash may have left.

        Raises:
            NoDevice: The device does not exist.
            NetlinkError: The kernel refused a request.
            OSError: Netlink is not available.
        """
        async with AsyncIPRoute() as route:
            index = await self._index(route)
            link = (await route.link("get", index=index))[0]
            if not link["flags"] & _IFF_UP:
                alias = _alias(link).removesuffix(RAISED) + RAISED
                # pyroute2 appends a NUL byte to the alias. If the alias has no room for the suffix, the device is not
                # marked, and `clear` does not take it down.
                mark = {"ifalias": alias} if len(alias.encode()) < _MAX_ALIAS_BYTES else {}
                await route.link("set", index=index, state="up", **mark)
            # Delete other addresses before this address is added. Otherwise this address could become the secondary
            # address of another one, and the kernel deletes secondary addresses together with their primary address.
            for other in await _addresses(route, index):
                if other in LINK_LOCAL and other != address:
                    await _delete_address(route, index, other)
            await route.addr(
                "replace",
                index=index,
                address=str(address),
                prefixlen=LINK_LOCAL.prefixlen,
                broadcast=str(LINK_LOCAL.broadcast_address),
            )

    async def clear(self) -> None:
        """Remove all link-local addresses. Take the device down if this or an earlier agent brought it up.

        Raises:
            NetlinkError: The kernel refused a request.
            OSError: Netlink is not available.
        """
        async with AsyncIPRoute() as route:
            try:
                index = await self._index(route)
            except NoDevice:
                return
            for address in await _addresses(route, index):
                if address in LINK_LOCAL:
                    await _delete_address(route, index, address)
            alias = _alias((await route.link("get", index=index))[0])
            if alias.endswith(RAISED):
                await route.link("set", index=index, state="down", ifalias=alias.removesuffix(RAISED))

    async def _index(self, route: AsyncIPRoute) -> int:
        indexes = await route.link_lookup(ifname=self._device)
        if not indexes:
            raise NoDevice(f"the node has no network device {self._device}")
        return int(indexes[0])


async def _addresses(route: AsyncIPRoute, index: int) -> list[IPv4Address]:
    entries = [entry async for entry in await route.addr("dump", index=index, family=socket.AF_INET)]
    return [IPv4Address(entry.get("local")) for entry in entries if entry["index"] == index and entry.get("local")]


async def _delete_address(route: AsyncIPRoute, index: int, address: IPv4Address) -> None:
    try:
        await route.addr("del", index=index, address=str(address), prefixlen=LINK_LOCAL.prefixlen)
    except NetlinkError as error:
        if error.code != errno.EADDRNOTAVAIL:  # another program has deleted it
            raise


def _alias(link: Any) -> str:
    """Return the alias of a device. An alias that is not UTF-8 counts as empty and is replaced."""
    alias = link.get("ifalias")
    return alias if isinstance(alias, str) else ""
