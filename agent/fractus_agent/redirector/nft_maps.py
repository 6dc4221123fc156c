"""Elements of the agent's nftables maps, replaced in one raw netlink transaction, and the byte counters.

The table itself is created with `nft` from the text of `ruleset`. A switch changes map elements only. The measured costs
of the alternatives (the `nft` program, libnftables, pyroute2) are in docs/decisions/0025.
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

from fractus_agent.redirector.netlink import (
    NLA_F_NESTED,
    NLM_F_ACK,
    NLM_F_CREATE,
    Netlink,
    NetlinkError,
    attribute,
    attributes,
    encode_message,
    nested,
)

TABLE = "fractus"
TARGETS = "targets"
MARKS = "marks"
PEERS = "peers"
SENT = "sent"
RECEIVED = "received"
GUARDED = "guarded"
CALLERS = "callers"

MARK_MASK = 0xFFF00000
MARK_BASE = 0xF6A00000
"""Connection mark of redirected connections. The lower bits contain the service number, which changes with each switch."""

MAX_NUMBER = 0xFFFFF

_SUBSYSTEM = 10 << 8
_NEW_ELEMENTS = _SUBSYSTEM | 12
_GET_ELEMENTS = _SUBSYSTEM | 13
_DELETE_ELEMENTS = _SUBSYSTEM | 14
_BEGIN = 0x10
_END = 0x11
_LIST_TABLE = 1
_LIST_SET = 2
_LIST_ELEMENTS = 3
_LIST_ELEMENT = 1
_ELEMENT_KEY = 1
_ELEMENT_DATA = 2
_ELEMENT_TIMEOUT = 4
_ELEMENT_EXPRESSION = 7
_DATA_VALUE = 1
_EXPRESSION_DATA = 2
_COUNTER_BYTES = 1

_MARK = struct.Struct("=HHHHI")
"""Encoding of a connection mark as the data of a map element."""
_MARK_DATA = _ELEMENT_DATA | NLA_F_NESTED

ENDPOINTS = 4096
"""Number of endpoints whose encoded messages are cached."""

ELEMENTS_PER_MESSAGE = 256
"""Limit of elements per message, because an attribute is limited to 64 KiB."""


@dataclass(frozen=True, slots=True, order=True)
class Endpoint:
    """Destination of packets.

    Attributes:
        address: IPv4 address.
        port: TCP or UDP port.
        protocol: IPPROTO_TCP or IPPROTO_UDP.
    """

    address: IPv4Address
    port: int
    protocol: int = socket.IPPROTO_TCP

    def __hash__(self) -> int:
        # Endpoints are looked up often, and the hash of IPv4Address is slow because it formats the address as text.
        return hash((int(self.address), self.port, self.protocol))


@dataclass(frozen=True, slots=True)
class Redirect:
    """Destination address translation for connections to one endpoint.

    Attributes:
        virtual: Endpoint that clients connect to.
        target: Endpoint that receives the connections instead.
    """

    virtual: Endpoint
    target: Endpoint


Callers = Mapping[Endpoint, Collection[IPv4Address]]
"""Addresses of the allowed clients by guarded endpoint.

Calls of other clients are not redirected. If the endpoint is a pod of this node, they are dropped.
"""
NO_GUARDS: Callers = MappingProxyType({})


class RedirectFailed(RuntimeError):
    """The kernel did not accept the rules."""


class NftMaps:
    """Replaces the elements of the agent's maps.

    Args:
        netlink: Netfilter socket in the node's network namespace.
        make_table: Creates the table with the given callers. Called again if someone removed the table, for example
            with `nft flush ruleset`.
        callers: Callers that the table contains already.
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
        """Replace the elements in one transaction: every packet sees either all old or all new elements.

        All elements are replaced even if few change. This refreshes the timeouts of the remaining elements without a
        gap. It also does not fail if an old element has just timed out, as a deletion by key would.

        Args:
            redirects: All redirects from now on.
            marks: All services and the numbers of their new connections. None keeps the marks.
            timeout_s: Time for which redirects and peers are valid unless they are written again, in seconds.
            peers: Addresses of nodes whose connections over direct interfaces are redirected. None keeps the peers.
            callers: Allowed clients by guarded endpoint. None keeps the callers.

        Raises:
            NetlinkError: The kernel refused the transaction. Nothing has changed.
            RedirectFailed: The table was removed, and cannot be created again.
        """
        timeout_ms = round(timeout_s * 1000)
        changes = _replace_elements(TARGETS, [_redirect_element(redirect, timeout_ms) for redirect in redirects])
        if marks is not None:
            changes += _replace_elements(MARKS, [_mark_element(service, number) for service, number in marks])
        if peers is not None:
            changes += _replace_elements(PEERS, [_peer_element(peer, timeout_ms) for peer in peers])
        if callers is not None:
            pairs = [(endpoint, client) for endpoint, clients in callers.items() for client in clients]
            changes += _replace_elements(GUARDED, [nested(_LIST_ELEMENT, _key(endpoint)) for endpoint in callers])
            changes += _replace_elements(CALLERS, [nested(_LIST_ELEMENT, _key(*pair)) for pair in pairs])
        try:
            self._transact(changes)
        except NetlinkError as error:
            if error.errno != errno.ENOENT:
                raise
            self._make_table(self._callers if callers is None else callers)
            self._transact(changes)
        if callers is not None:
            self._callers = dict(callers)

    def recreate_table(self) -> None:
        """Create the table again, for another device.

        The new table contains the callers. The next write adds all other elements.

        Raises:
            RedirectFailed: nft refused the table.
        """
        self._make_table(self._callers)

    def byte_counts(self) -> dict[int, tuple[int, int]]:
        """Return the bytes sent and received over direct interfaces, by service number.

        Raises:
            NetlinkError: The counters cannot be read.
        """
        sent = _read_counters(self._netlink, SENT)
        received = _read_counters(self._netlink, RECEIVED)
        return {mark - MARK_BASE: (sent.get(mark, 0), received.get(mark, 0)) for mark in {*sent, *received}}

    def _transact(self, changes: Sequence[tuple[int, bytes]]) -> None:
        numbered = [(kind, self._netlink.sequence(), body) for kind, body in changes]
        fence = struct.pack(">BBH", socket.AF_UNSPEC, 0, _SUBSYSTEM >> 8)
        batch = [encode_message(kind, NLM_F_ACK | NLM_F_CREATE, number, body) for kind, number, body in numbered]
        first = self._netlink.sequence()
        begin = encode_message(_BEGIN, 0, first, fence)
        end = encode_message(_END, 0, self._netlink.sequence(), fence)
        self._netlink.send(b"".join((begin, *batch, end)))
        self._netlink.acknowledged({number for _, number, _ in numbered}, refusals=frozenset({first}))


def _replace_elements(name: str, elements: Sequence[bytes]) -> list[tuple[int, bytes]]:
    """Return the messages that replace all elements of a map."""
    header = _set_header(name)
    starts = range(0, len(elements), ELEMENTS_PER_MESSAGE)
    batches = (elements[start : start + ELEMENTS_PER_MESSAGE] for start in starts)
    additions = ((_NEW_ELEMENTS, header + nested(_LIST_ELEMENTS, *batch)) for batch in batches)
    return [(_DELETE_ELEMENTS, header), *additions]


def _set_header(name: str) -> bytes:
    header = struct.pack(">BBH", socket.AF_INET, 0, 0)
    return header + attribute(_LIST_TABLE, TABLE.encode() + b"\0") + attribute(_LIST_SET, name.encode() + b"\0")


# Traffic is switched between the same endpoints repeatedly, and encoding messages is most of the work of a switch.
@lru_cache(ENDPOINTS)
def _redirect_element(redirect: Redirect, timeout_ms: int) -> bytes:
    target = _data(_address_and_port(redirect.target))
    timeout = attribute(_ELEMENT_TIMEOUT, struct.pack(">Q", timeout_ms))
    return nested(_LIST_ELEMENT, _key(redirect.virtual), target, timeout)


@lru_cache(ENDPOINTS)
def _key(endpoint: Endpoint, client: IPv4Address | None = None) -> bytes:
    address = endpoint.address.packed
    if client is not None:
        address = client.packed + address
    protocol = struct.pack("=Bxxx", endpoint.protocol)
    port = struct.pack(">HH", endpoint.port, 0)
    return nested(_ELEMENT_KEY, attribute(_DATA_VALUE, address + protocol + port))


def _address_and_port(endpoint: Endpoint) -> bytes:
    """Encode address and port, each padded to a register of four bytes."""
    return endpoint.address.packed + struct.pack(">HH", endpoint.port, 0)


def _mark_element(service: Endpoint, number: int) -> bytes:
    """Encode an element of the map of marks. Only its end depends on the service number, so the rest is cached."""
    return _mark_element_prefix(service) + _mark(number)


@lru_cache(ENDPOINTS)
def _mark_element_prefix(service: Endpoint) -> bytes:
    return nested(_LIST_ELEMENT, _key(service), _mark(0))[: -_MARK.size]


def _mark(number: int) -> bytes:
    return _MARK.pack(_MARK.size, _MARK_DATA, 8, _DATA_VALUE, MARK_BASE | number)


def _peer_element(address: IPv4Address, timeout_ms: int) -> bytes:
    key = nested(_ELEMENT_KEY, attribute(_DATA_VALUE, address.packed))
    return nested(_LIST_ELEMENT, key, attribute(_ELEMENT_TIMEOUT, struct.pack(">Q", timeout_ms)))


def _data(value: bytes) -> bytes:
    return nested(_ELEMENT_DATA, attribute(_DATA_VALUE, value))


def _read_counters(netlink: Netlink, name: str) -> dict[int, int]:
    """Return the bytes by mark of a set with counters, empty if the set does not exist.

    Raises:
        NetlinkError: The kernel refused the request, or did not respond.
    """
    counters = {}
    try:
        for response in netlink.dump(_GET_ELEMENTS, _set_header(name)):
            for _, element in attributes(_nested_value(response[4:], _LIST_ELEMENTS)):
                mark = _nested_value(element, _ELEMENT_KEY, _DATA_VALUE)
                count = _nested_value(element, _ELEMENT_EXPRESSION, _EXPRESSION_DATA, _COUNTER_BYTES)
                if len(mark) == 4 and len(count) == 8:
                    counters[struct.unpack("=I", mark)[0]] = struct.unpack(">Q", count)[0]
    except NetlinkError as error:
        if error.errno != errno.ENOENT:
            raise
    return counters


def _nested_value(data: bytes, *kinds: int) -> bytes:
    """Return the value of an attribute inside nested attributes, empty if it is missing."""
    for outer in kinds:
        data = next((value for kind, value in attributes(data) if kind == outer), b"")
    return data
