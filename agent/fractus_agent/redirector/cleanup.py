"""Removal of kernel state left by a killed agent: its nftables table and its marked connections.

The redirects in the table time out by themselves, but the guards of endpoints do not.
"""

from __future__ import annotations

import socket
import struct
from contextlib import closing

from fractus_agent.redirector import ruleset
from fractus_agent.redirector.connections import Conntrack
from fractus_agent.redirector.netlink import NETLINK_NETFILTER, Netlink, attributes
from fractus_agent.redirector.nft_maps import TABLE

_LIST_TABLES = 10 << 8 | 1
_NAME = 1


def table_exists() -> bool:
    """Return True if the agent's table exists.

    Raises:
        NetlinkError: The kernel refused the request, or did not respond.
    """
    with closing(Netlink(NETLINK_NETFILTER)) as netlink:
        responses = list(netlink.dump(_LIST_TABLES, struct.pack(">BBH", socket.AF_INET, 0, 0)))
    names = [value for response in responses for kind, value in attributes(response[4:]) if kind == _NAME]
    return TABLE.encode() + b"\0" in names


def remove_all() -> None:
    """Remove the agent's tables, and then the connections that they marked.

    Raises:
        RedirectFailed: nft is missing, or refused the removal.
        NetlinkError: The kernel refused the request, or did not respond.
    """
    ruleset.remove()
    with closing(Netlink(NETLINK_NETFILTER)) as netlink:
        Conntrack(netlink).delete_all()
