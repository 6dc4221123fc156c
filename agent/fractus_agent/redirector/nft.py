"""Our nftables table: swaps of its maps by one raw transaction.

The table is made with `nft`, as `tables` describes it; switching then changes map elements only, over netlink: `nft` as a
process takes 16 ms and libnftables slows down with the rules of kube-proxy, while one transaction takes 0.02 ms, and 0.6 ms
with 64 elements.
"""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from ipaddress import IPv4Address
from types import MappingProxyType

from fractus_agent.redirector.counters import counted
from fractus_agent.redirector.netlink import (
    NLA_F_NESTED,
    NLM_F_ACK,
    NLM_F_CREATE,
    Netlink,
    NetlinkError,
    attribute,
    message,
    nested,
)

TABLE = "fractus"
TARGETS, MARKS, PEERS = "targets", "marks", "peers"
SENT, RECEIVED = "sent", "received"
GUARDED, CALLERS = "guarded", "callers"

MARK_MASK, MARK_BASE = 0xFFF00000, 0xF6A00000
"""Connections that we redirect carry a mark of this range; the lower bits number a service's stay on one path."""

MAX_NUMBER = 0xFFFFF

_SUBSYSTEM = 10 << 8
_NEW_ELEMENTS, _DELETE_ELEMENTS, _BEGIN, _END = _SUBSYSTEM | 12, _SUBSYSTEM | 14, 0x10, 0x11
_LIST_TABLE, _LIST_SET, _LIST_ELEMENTS, _LIST_ELEMENT = 1, 2, 3, 1
_ELEMENT_KEY, _ELEMENT_DATA, _ELEMENT_TIMEOUT, _DATA_VALUE = 1, 2, 4, 1

_MARK, _MARK_DATA = struct.Struct("=HHHHI"), _ELEMENT_DATA | NLA_F_NESTED
"""A mark as the data of an element."""

ENDPOINTS = 4096
"""Endpoints whose messages are kept."""

ELEMENTS_A_MESSAGE = 256
"""An attribute holds 64 KiB."""


@dataclass(frozen=True, slots=True, order=True)
class Endpoint:
    """An address that packets go to.

    Attributes:
        address: IPv4.
        port: TCP or UDP.
        protocol: IPPROTO_TCP or IPPROTO_UDP.
    """

    address: IPv4Address
    port: int
    protocol: int = socket.IPPROTO_TCP

    def __hash__(self) -> int:
        # Looked up all the time, and an address makes text of itself for its own hash.
        return hash((int(self.address), self.port, self.protocol))


@dataclass(frozen=True, slots=True)
class Redirect:
    """What connections to an endpoint go to instead.

    Attributes:
        virtual: where clients connect to.
        target: where they are led.
    """

    virtual: Endpoint
    target: Endpoint


Callers = Mapping[Endpoint, Collection[IPv4Address]]
"""By guarded endpoint, who may call it."""
NO_GUARDS: Callers = MappingProxyType({})


class RedirectFailed(RuntimeError):
    """The kernel did not take the rules."""


class Maps:
    """Replaces the elements of our maps.

    Args:
        netlink: a netfilter socket in the node's network namespace.
        make_table: makes our table, with these guards; again where someone has removed it, as `nft flush ruleset` does.
        callers: guards that the table has already.
    """

    def __init__(self, netlink: Netlink, make_table: Callable[[Callers], None], callers: Callers = NO_GUARDS) -> None:
        self._netlink = netlink
        self._make_table = make_table
        self._callers = callers

    def write(
        self,
        redirects: Iterable[Redirect],
        marks: Iterable[tuple[Endpoint, int]] | None,
        timeout_s: float,
        peers: Iterable[IPv4Address] | None = None,
        callers: Callers | None = None,
    ) -> None:
        """Replace the elements in one transaction: every packet sees either the old ones or the new.

        All are replaced, also when few change: that costs 0.6 ms with 64, refreshes the time-outs of those that stay without
        a gap, and does not fail when one of the old ones timed out a moment ago, as a deletion by name would.

        Args:
            redirects: all that hold from now on.
            marks: all services, where clients connect to, and the number that their new connections carry; None leaves the
                marks as they are.
            timeout_s: for how long redirects hold, and peers may use them, unless they are set again.
            peers: whose connections over direct interfaces are led on; None leaves them as they are.
            callers: by guarded endpoint, which clients are led; None leaves them as they are.

        Raises:
            NetlinkError: nothing was changed.
            RedirectFailed: the table was gone, and cannot be made again.
        """
        timeout_ms = round(timeout_s * 1000)
        changes = _replaced(TARGETS, [_led(redirect, timeout_ms) for redirect in redirects])
        if marks is not None:
            changes += _replaced(MARKS, [_marked(service, number) for service, number in marks])
        if peers is not None:
            changes += _replaced(PEERS, [nested(_LIST_ELEMENT, _address(peer), _lives(timeout_ms)) for peer in peers])
        if callers is not None:
            changes += _replaced(GUARDED, [nested(_LIST_ELEMENT, _key(each)) for each in callers])
            changes += _replaced(
                CALLERS,
                [nested(_LIST_ELEMENT, _key(to, client)) for to, clients in callers.items() for client in clients],
            )
        try:
            self._transact(changes)
        except NetlinkError as error:
            if error.errno != errno.ENOENT:
                raise
            self._make_table(self._callers if callers is None else callers)
            self._transact(changes)
        if callers is not None:
            self._callers = dict(callers)

    def remake(self) -> None:
        """Make the table again, for another device; guards are in it, all else comes with the next write.

        Raises:
            RedirectFailed: nft refuses.
        """
        self._make_table(self._callers)

    def counted(self) -> dict[int, tuple[int, int]]:
        """Bytes sent and received over direct interfaces, by the number that connections carry.

        Raises:
            NetlinkError: the kernel does not tell.
        """
        sent, received = (counted(self._netlink, TABLE, name) for name in (SENT, RECEIVED))
        return {mark - MARK_BASE: (sent.get(mark, 0), received.get(mark, 0)) for mark in {*sent, *received}}

    def _transact(self, changes: Sequence[tuple[int, bytes]]) -> None:
        numbered = [(kind, self._netlink.sequence(), body) for kind, body in changes]
        fence = struct.pack(">BBH", socket.AF_UNSPEC, 0, _SUBSYSTEM >> 8)
        batch = [message(kind, NLM_F_ACK | NLM_F_CREATE, number, body) for kind, number, body in numbered]
        first = self._netlink.sequence()
        begin = message(_BEGIN, 0, first, fence)
        end = message(_END, 0, self._netlink.sequence(), fence)
        self._netlink.send(b"".join((begin, *batch, end)))
        self._netlink.acknowledged({number for _, number, _ in numbered}, refusals=frozenset({first}))


def _replaced(name: str, elements: Sequence[bytes]) -> list[tuple[int, bytes]]:
    """The messages that put these elements in place of all others of a map."""
    header = struct.pack(">BBH", socket.AF_INET, 0, 0)
    header += attribute(_LIST_TABLE, TABLE.encode() + b"\0") + attribute(_LIST_SET, name.encode() + b"\0")
    all_of_them = (_DELETE_ELEMENTS, header)
    batches = (elements[first : first + ELEMENTS_A_MESSAGE] for first in range(0, len(elements), ELEMENTS_A_MESSAGE))
    return [all_of_them, *((_NEW_ELEMENTS, header + nested(_LIST_ELEMENTS, *some)) for some in batches)]


# Traffic is switched between the same endpoints again and again, and messages are most of a switch's work.
@lru_cache(ENDPOINTS)
def _led(redirect: Redirect, timeout_ms: int) -> bytes:
    """An element of the map of redirects."""
    to = _endpoint(redirect.target)
    return nested(_LIST_ELEMENT, _key(redirect.virtual), _data(to), _lives(timeout_ms))


@lru_cache(ENDPOINTS)
def _key(endpoint: Endpoint, client: IPv4Address | None = None) -> bytes:
    address, port = endpoint.address.packed, struct.pack(">HH", endpoint.port, 0)
    if client is not None:
        address = client.packed + address
    return nested(_ELEMENT_KEY, attribute(_DATA_VALUE, address + struct.pack("=Bxxx", endpoint.protocol) + port))


def _endpoint(endpoint: Endpoint) -> bytes:
    """Address and port, each padded to a register of four bytes."""
    return endpoint.address.packed + struct.pack(">HH", endpoint.port, 0)


def _marked(service: Endpoint, number: int) -> bytes:
    """An element of the map of marks; all are equally long, so that only its end differs from what is kept."""
    return _marked_first(service) + _mark(number)


@lru_cache(ENDPOINTS)
def _marked_first(service: Endpoint) -> bytes:
    return nested(_LIST_ELEMENT, _key(service), _mark(0))[: -_MARK.size]


def _mark(number: int) -> bytes:
    return _MARK.pack(_MARK.size, _MARK_DATA, 8, _DATA_VALUE, MARK_BASE | number)


def _lives(timeout_ms: int) -> bytes:
    return attribute(_ELEMENT_TIMEOUT, struct.pack(">Q", timeout_ms))


def _address(address: IPv4Address) -> bytes:
    return nested(_ELEMENT_KEY, attribute(_DATA_VALUE, address.packed))


def _data(value: bytes) -> bytes:
    return nested(_ELEMENT_DATA, attribute(_DATA_VALUE, value))
