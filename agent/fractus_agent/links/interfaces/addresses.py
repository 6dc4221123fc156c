"""Addresses of a network device, and whether it is up, over netlink: no program to run, nothing to parse."""

from __future__ import annotations

import errno
import fcntl
import socket
import struct
from collections.abc import Iterator
from contextlib import closing
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path

from fractus_agent.redirector.netlink import (
    NETLINK_ROUTE,
    NLM_F_ACK,
    NLM_F_CREATE,
    NLM_F_REPLACE,
    Netlink,
    NetlinkError,
    attribute,
    attributes,
    message,
)

ROUTES = Path("/proc/net/route")
"""The main routing table, of the network namespace that the process is in."""
LINK_LOCAL = IPv4Network("169.254.0.0/16")

RAISED = b" [raised by fractus-agent]"
"""Added to the alias of a device that was brought up here: it stays with the device when the agent is killed, and ends with a
reboot. What its owner wrote there stays before it."""
_MAX_ALIAS = 255

_NEW_LINK, _LIST_LINKS, _NEW_ADDRESS, _DELETE_ADDRESS, _LIST_ADDRESSES = 16, 18, 20, 21, 22
_LINK = struct.Struct("=BxHiII")
_ADDRESS = struct.Struct("=BBBBI")
_PEER, _LOCAL, _BROADCAST, _ALIAS = 1, 2, 4, 20
_IFF_UP = 1
_GET_FLAGS = 0x8913
_NAME_AND_FLAGS = struct.Struct("=16sH22x")


class NoDevice(Exception):
    """There is no network device of this name."""


class Addresses:
    """The link-local addresses of one device in the network namespace that the process is in.

    Args:
        device: its name; it may come and go.
    """

    def __init__(self, device: str) -> None:
        self._device = device

    def other_traffic(self) -> str:
        """What shows that the device carries other traffic of the node than that of direct links; empty when nothing does.

        Raises:
            NoDevice: there is none.
            NetlinkError: the kernel refused.
        """
        index = self._index()
        with closing(Netlink(NETLINK_ROUTE)) as netlink:
            for address in _all(netlink, index):
                if address not in LINK_LOCAL:
                    return f"it has the address {address}"
        return "a default route leads over it" if _default_route(ROUTES.read_text(), self._device) else ""

    def set(self, address: IPv4Address) -> None:
        """Bring the device up with this link-local address and no other, so that one that a crash left does not stay.

        Raises:
            NoDevice: there is none.
            NetlinkError: the kernel refused.
        """
        index = self._index()
        with closing(Netlink(NETLINK_ROUTE)) as netlink:
            if not self._is_up():
                alias = _alias(netlink, index).removesuffix(RAISED) + RAISED
                # Without room for our mark the device stays up in the end.
                mark = attribute(_ALIAS, alias) if len(alias) <= _MAX_ALIAS else b""
                _ask(netlink, _NEW_LINK, 0, _link(index, _IFF_UP) + mark)
            _ask(netlink, _NEW_ADDRESS, NLM_F_CREATE | NLM_F_REPLACE, _described(index, address))
            for other in _listed(netlink, index):
                if other != address:
                    _ask(netlink, _DELETE_ADDRESS, 0, _described(index, other))

    def clear(self) -> None:
        """Take all link-local addresses away, and have the device down again where it was not up before, by an earlier agent too.

        Raises:
            NetlinkError: the kernel refused.
        """
        try:
            index = self._index()
        except NoDevice:
            return
        with closing(Netlink(NETLINK_ROUTE)) as netlink:
            for address in list(_listed(netlink, index)):
                _ask(netlink, _DELETE_ADDRESS, 0, _described(index, address))
            alias = _alias(netlink, index)
            if alias.endswith(RAISED):
                _ask(netlink, _NEW_LINK, 0, _link(index, 0) + attribute(_ALIAS, alias.removesuffix(RAISED)))

    def _is_up(self) -> bool:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            try:
                found = fcntl.ioctl(asking, _GET_FLAGS, _NAME_AND_FLAGS.pack(self._device.encode(), 0))
            except OSError as error:
                raise NoDevice(f"the node has no network device {self._device}") from error
        return bool(_NAME_AND_FLAGS.unpack(found)[1] & _IFF_UP)

    def _index(self) -> int:
        try:
            return socket.if_nametoindex(self._device)
        except OSError as error:
            raise NoDevice(f"the node has no network device {self._device}") from error


def _link(index: int, flags: int) -> bytes:
    return _LINK.pack(socket.AF_UNSPEC, 0, index, flags, _IFF_UP)


def _alias(netlink: Netlink, index: int) -> bytes:
    """The alias of a device; empty without one."""
    for body in list(netlink.dump(_LIST_LINKS, _LINK.pack(socket.AF_UNSPEC, 0, 0, 0, 0))):
        if _LINK.unpack_from(body)[2] == index:
            return next((value for kind, value in attributes(body[_LINK.size :]) if kind == _ALIAS), b"").rstrip(b"\0")
    return b""


def _described(index: int, address: IPv4Address) -> bytes:
    head = _ADDRESS.pack(socket.AF_INET, LINK_LOCAL.prefixlen, 0, 0, index)
    packed = address.packed
    broadcast = LINK_LOCAL.broadcast_address.packed
    return head + attribute(_LOCAL, packed) + attribute(_PEER, packed) + attribute(_BROADCAST, broadcast)


def _default_route(routes: str, device: str) -> bool:
    fields = (line.split() for line in routes.splitlines()[1:])
    return any((field[0], field[1], field[7]) == (device, "00000000", "00000000") for field in fields)


def _listed(netlink: Netlink, index: int) -> Iterator[IPv4Address]:
    return (address for address in _all(netlink, index) if address in LINK_LOCAL)


def _all(netlink: Netlink, index: int) -> Iterator[IPv4Address]:
    for body in list(netlink.dump(_LIST_ADDRESSES, _ADDRESS.pack(socket.AF_INET, 0, 0, 0, 0))):
        if _ADDRESS.unpack_from(body)[4] != index:
            continue
        local = next((value for kind, value in attributes(body[_ADDRESS.size :]) if kind == _LOCAL), b"")
        if len(local) == 4:
            yield IPv4Address(local)


def _ask(netlink: Netlink, kind: int, flags: int, body: bytes) -> None:
    sequence = netlink.sequence()
    netlink.send(message(kind, NLM_F_ACK | flags, sequence, body))
    # What was deleted or added by another program in between is as it should be.
    netlink.acknowledged({sequence}, ignore=frozenset({errno.EADDRNOTAVAIL, errno.EEXIST}))


__all__ = ["Addresses", "NetlinkError", "NoDevice"]
