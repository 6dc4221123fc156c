"""Which hardware has an address on a link, as the kernel remembers it."""

from __future__ import annotations

import errno
import socket
import struct
from contextlib import closing
from ipaddress import IPv4Address

from fractus_agent.redirector.netlink import (
    NETLINK_ROUTE,
    NLM_F_ACK,
    Netlink,
    attribute,
    attributes,
    message,
)

_DELETE_NEIGHBOUR, _LIST_NEIGHBOURS = 29, 30
_NEIGHBOUR = struct.Struct("=BxxxiHBB")
_DESTINATION = 1
_PERMANENT = 0x80


def forget(address: IPv4Address) -> None:
    """Have the kernel ask again which hardware has an address; what an administrator has set for good stays.

    Anyone in reach can say that it is his, and the kernel believes it for up to a minute after he has left.

    Raises:
        NetlinkError: the kernel refused.
    """
    with closing(Netlink(NETLINK_ROUTE)) as netlink:
        wanted = attribute(_DESTINATION, address.packed)
        for body in list(netlink.dump(_LIST_NEIGHBOURS, _NEIGHBOUR.pack(socket.AF_INET, 0, 0, 0, 0))):
            _, index, state, _, _ = _NEIGHBOUR.unpack_from(body)
            known = dict(attributes(body[_NEIGHBOUR.size :]))
            if known.get(_DESTINATION) != address.packed or state & _PERMANENT:
                continue
            sequence = netlink.sequence()
            described = _NEIGHBOUR.pack(socket.AF_INET, index, 0, 0, 0) + wanted
            netlink.send(message(_DELETE_NEIGHBOUR, NLM_F_ACK, sequence, described))
            netlink.acknowledged({sequence}, ignore=frozenset({errno.ENOENT}))
