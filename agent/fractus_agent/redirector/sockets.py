"""TCP connections of a pod: which are idle, and closing them, through the kernel's socket diagnosis.

A client's socket in its pod still has the virtual address as its peer: the translation happens outside of the pod.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Collection
from dataclasses import dataclass
from ipaddress import IPv4Address

from fractus_agent.redirector.netlink import NLM_F_ACK, NLMSG_ERROR, Netlink, NetlinkError, attributes, message
from fractus_agent.redirector.nft import Endpoint

_BY_FAMILY, _DESTROY = 20, 21
_TCP_INFO = 2
_REQUEST = struct.Struct("=BBBxI")
_ID = struct.Struct(">HH16s16s")
_ID_BYTES = 48
_ANSWER_HEAD = 4
_QUEUES = struct.Struct("=III")
_INFO = struct.Struct("=24xI16x4I60xQQ")
"""tcp_info: unacknowledged segments; ages in ms of the last data sent, ACK sent (always 0), data received, ACK received; bytes
sent and acknowledged, and received."""

_MAPPED = b"\0" * 10 + b"\xff\xff"
TCP_ESTABLISHED, TCP_SYN_SENT, TCP_CLOSE_WAIT = 1, 2, 8
_OPEN = frozenset({TCP_ESTABLISHED, TCP_SYN_SENT, TCP_CLOSE_WAIT})
_STATES = sum(1 << state for state in _OPEN)

JIFFY_MS = 4
"""The kernel tells ages in steps of this."""


@dataclass(frozen=True, slots=True)
class Connection:
    """A TCP connection of a client.

    Attributes:
        identity: of the socket, as the kernel names it.
        family: AF_INET or AF_INET6 (gRPC's sockets are often the latter, with mapped addresses).
        peer: where it was connected to.
        queued: bytes not yet sent.
        unacknowledged: segments sent and not acknowledged.
        sent_ms: age of the last data sent.
        received_ms: age of the last data received.
        acknowledged_ms: age of the last ACK received.
        received_bytes: since it was opened.
        sent_bytes: since it was opened, as far as they were acknowledged.
        unread: bytes that have come and that the client has not read yet; closed, they would be lost.
    """

    identity: bytes
    family: int
    peer: Endpoint
    queued: int = 0
    unacknowledged: int = 0
    sent_ms: int = 0
    received_ms: int = 0
    acknowledged_ms: int = 0
    received_bytes: int = 0
    sent_bytes: int = 0
    unread: int = 0

    @property
    def answered(self) -> bool:
        """Whether all that was sent has arrived, and something came since, which the client has read."""
        through = self.queued == 0 and self.unacknowledged == 0 and self.unread == 0
        return through and self.received_ms <= self.sent_ms

    @property
    def idle_ms(self) -> int:
        """For how long all that was sent has arrived and been answered; 0 while a request is under way.

        The age of the last ACK counts too: a large request on a slow link is acknowledged piece by piece.
        """
        return min(self.received_ms, self.acknowledged_ms) if self.answered else 0

    @property
    def worked_ms(self) -> int:
        """How long the server took from the last request to the last piece of its reply."""
        return max(self.sent_ms - self.received_ms, 0)

    @property
    def rested_ms(self) -> int:
        """How long the client rested between the last reply and its next request; 0 before that is sent."""
        return max(self.received_ms - self.sent_ms, 0)


class DestroyUnsupported(RuntimeError):
    """The kernel cannot close other programs' sockets (CONFIG_INET_DIAG_DESTROY)."""


class Sockets:
    """The TCP sockets of one network namespace.

    Args:
        netlink: a socket for socket diagnosis, opened in that namespace.
    """

    def __init__(self, netlink: Netlink) -> None:
        self._netlink = netlink

    def close(self) -> None:
        """Close the netlink socket."""
        self._netlink.close()

    def to(self, peers: Collection[Endpoint]) -> list[Connection]:
        """The connections to some endpoints.

        Raises:
            NetlinkError: the kernel does not tell.
        """
        found = []
        for family in (socket.AF_INET, socket.AF_INET6):
            request = _REQUEST.pack(family, socket.IPPROTO_TCP, 1 << (_TCP_INFO - 1), _STATES) + b"\0" * _ID_BYTES
            for answer in self._netlink.dump(_BY_FAMILY, request):
                connection = _read(answer)
                if connection is not None and connection.peer in peers:
                    found.append(connection)
        return found

    def now(self, connection: Connection) -> Connection | None:
        """A connection as it is now, which costs less than a list; None when it is there no more.

        Raises:
            NetlinkError: the kernel does not tell.
        """
        request = _REQUEST.pack(connection.family, socket.IPPROTO_TCP, 1 << (_TCP_INFO - 1), _STATES)
        sequence = self._netlink.sequence()
        self._netlink.send(message(_BY_FAMILY, 0, sequence, request + connection.identity))
        while True:
            for kind, number, body in self._netlink.receive():
                if number != sequence:
                    continue
                if kind != NLMSG_ERROR:
                    found = _read(body)
                    return found if found is not None and body[1] in _OPEN else None
                if (refused := -struct.unpack_from("=i", body)[0]) != errno.ENOENT:
                    raise NetlinkError(refused, f"sockets: a connection is not told of: {os.strerror(refused)}")
                return None

    def destroy(self, connection: Connection) -> None:
        """Close a connection: its program sees "connection aborted" and connects again.

        Raises:
            DestroyUnsupported: this kernel cannot.
            NetlinkError: the kernel refused.
        """
        request = _REQUEST.pack(connection.family, socket.IPPROTO_TCP, 0, _STATES) + connection.identity
        sequence = self._netlink.sequence()
        self._netlink.send(message(_DESTROY, NLM_F_ACK, sequence, request))
        try:
            self._netlink.acknowledged({sequence}, ignore=frozenset({errno.ENOENT}))
        except NetlinkError as error:
            if error.errno == errno.EOPNOTSUPP:
                raise DestroyUnsupported(
                    "sockets: this kernel cannot close sockets (CONFIG_INET_DIAG_DESTROY)"
                ) from error
            raise


def _read(answer: bytes) -> Connection | None:
    """A connection from the kernel's answer; None for one that is not IPv4."""
    family, identity = answer[0], answer[_ANSWER_HEAD : _ANSWER_HEAD + _ID_BYTES]
    _port, port, _source, peer = _ID.unpack_from(identity)
    if family == socket.AF_INET6:
        if not peer.startswith(_MAPPED):
            return None
        peer = peer[len(_MAPPED) :]
    _expires, unread, queued = _QUEUES.unpack_from(answer, _ANSWER_HEAD + _ID_BYTES)
    rest = answer[_ANSWER_HEAD + _ID_BYTES + _QUEUES.size + 8 :]
    info = next((value for kind, value in attributes(rest) if kind == _TCP_INFO), b"").ljust(_INFO.size, b"\0")
    unacknowledged, sent_ms, _, received_ms, acknowledged_ms, sent_bytes, received_bytes = _INFO.unpack_from(info)
    return Connection(
        identity,
        family,
        Endpoint(IPv4Address(peer[:4]), port),
        queued,
        unacknowledged,
        sent_ms,
        received_ms,
        acknowledged_ms,
        received_bytes,
        sent_bytes,
        unread,
    )
