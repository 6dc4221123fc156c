"""What an agent that was killed has left in the kernel: its table, whose guards no time-out ends, and marked connections."""

from __future__ import annotations

import socket
import struct
from contextlib import closing

from fractus_agent.redirector import nft, tables
from fractus_agent.redirector.conntrack import Conntrack
from fractus_agent.redirector.netlink import NETLINK_NETFILTER, Netlink, attributes

_LIST_TABLES, _NAME = 10 << 8 | 1, 1


def table_is_left() -> bool:
    """Whether our table is there.

    Raises:
        NetlinkError: the kernel does not tell.
    """
    with closing(Netlink(NETLINK_NETFILTER)) as netlink:
        answers = list(netlink.dump(_LIST_TABLES, struct.pack(">BBH", socket.AF_INET, 0, 0)))
    names = [value for answer in answers for kind, value in attributes(answer[4:]) if kind == _NAME]
    return nft.TABLE.encode() + b"\0" in names


def remove() -> None:
    """Remove our tables, and then the connections that they marked.

    Raises:
        RedirectFailed: nft is missing, or refuses.
        NetlinkError: the kernel refused.
    """
    tables.remove()
    with closing(Netlink(NETLINK_NETFILTER)) as netlink:
        Conntrack(netlink).forget_all()
