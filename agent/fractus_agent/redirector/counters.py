"""Reading the counters of a set of marks: how many bytes connections with each mark have moved."""

from __future__ import annotations

import errno
import socket
import struct

from fractus_agent.redirector.netlink import Netlink, NetlinkError, attribute, attributes

_GET_ELEMENTS = 10 << 8 | 13
_LIST_TABLE, _LIST_SET, _LIST_ELEMENTS = 1, 2, 3
_ELEMENT_KEY, _ELEMENT_EXPRESSION, _DATA_VALUE, _EXPRESSION_DATA, _COUNTER_BYTES = 1, 7, 1, 2, 1


def counted(netlink: Netlink, table: str, name: str) -> dict[int, int]:
    """Bytes by mark; none where the set is not there.

    Args:
        netlink: a netfilter socket.
        table: of IPv4.
        name: of a set of marks with counters.

    Raises:
        NetlinkError: the kernel does not tell.
    """
    request = struct.pack(">BBH", socket.AF_INET, 0, 0)
    request += attribute(_LIST_TABLE, table.encode() + b"\0") + attribute(_LIST_SET, name.encode() + b"\0")
    found = {}
    try:
        for answer in netlink.dump(_GET_ELEMENTS, request):
            for _, element in attributes(_inside(answer[4:], _LIST_ELEMENTS)):
                key = _inside(element, _ELEMENT_KEY, _DATA_VALUE)
                amount = _inside(element, _ELEMENT_EXPRESSION, _EXPRESSION_DATA, _COUNTER_BYTES)
                if len(key) == 4 and len(amount) == 8:
                    found[struct.unpack("=I", key)[0]] = struct.unpack(">Q", amount)[0]
    except NetlinkError as error:
        if error.errno != errno.ENOENT:
            raise
    return found


def _inside(data: bytes, *kinds: int) -> bytes:
    """The value of an attribute in an attribute; empty where it is not there."""
    for wanted in kinds:
        data = next((value for kind, value in attributes(data) if kind == wanted), b"")
    return data
