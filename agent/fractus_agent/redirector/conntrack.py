"""Forgetting connections: the kernel's entries for redirected connections, deleted by mark in one message.

An established connection keeps the address translation of its first packet, whatever the map says later. Deleted one by
one, entries cost seconds beside thousands of others; by mark it is one message that the kernel works off itself.
"""

from __future__ import annotations

import errno
import socket
import struct

from fractus_agent.redirector.netlink import NLM_F_ACK, Netlink, attribute, message
from fractus_agent.redirector.nft import MARK_BASE, MARK_MASK

_DELETE = 1 << 8 | 2
_MARK, _MARK_MASK = 8, 21
ALL_BITS = 0xFFFFFFFF


class Conntrack:
    """Deletes entries of connections that we redirected.

    Args:
        netlink: a netfilter socket in the node's network namespace.
    """

    def __init__(self, netlink: Netlink) -> None:
        self._netlink = netlink

    def forget(self, service: int) -> None:
        """Delete the entries of one service's connections; their next packet is routed by the map as it is then.

        Raises:
            NetlinkError: the kernel refused.
        """
        self._delete(MARK_BASE | service, ALL_BITS)

    def forget_all(self) -> None:
        """Delete the entries of all connections that carry a mark of ours.

        Raises:
            NetlinkError: the kernel refused.
        """
        self._delete(MARK_BASE, MARK_MASK)

    def _delete(self, mark: int, mask: int) -> None:
        sequence = self._netlink.sequence()
        body = struct.pack(">BBH", socket.AF_INET, 0, 0)
        body += attribute(_MARK, struct.pack(">I", mark)) + attribute(_MARK_MASK, struct.pack(">I", mask))
        self._netlink.send(message(_DELETE, NLM_F_ACK, sequence, body))
        self._netlink.acknowledged({sequence}, ignore=frozenset({errno.ENOENT}))
