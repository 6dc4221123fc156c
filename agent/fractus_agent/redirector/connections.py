"""Established connections: TCP sockets of pods (socket diagnosis) and connection tracking entries (conntrack).

The TCP socket of a client in its pod still has the virtual address as its peer, because the address translation happens
outside of the pod. Established connections keep the translation of their first packet, even if the nftables map
changes later. So after a switch the old sockets are closed, and the old conntrack entries are deleted.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path

from fractus_agent.redirector.netlink import (
    NETLINK_SOCK_DIAG,
    NLM_F_ACK,
    NLMSG_ERROR,
    Netlink,
    NetlinkError,
    attribute,
    attributes,
    encode_message,
    in_namespace,
)
from fractus_agent.redirector.nft_maps import MARK_BASE, MARK_MASK, Endpoint

log = logging.getLogger(__name__)

_BY_FAMILY = 20
_DESTROY = 21
_TCP_INFO = 2
_REQUEST = struct.Struct("=BBBxI")
_ID = struct.Struct(">HH16s16s")
_ID_BYTES = 48
_RESPONSE_HEAD_BYTES = 4
_QUEUES = struct.Struct("=III")
_INFO = struct.Struct("=24xI16x4I")
"""tcp_info: unacknowledged segments, and ages in ms of the last data sent, ACK sent (always 0), data received and ACK
received."""

_MAPPED = b"\0" * 10 + b"\xff\xff"
TCP_ESTABLISHED = 1
TCP_SYN_SENT = 2
TCP_CLOSE_WAIT = 8
_OPEN = frozenset({TCP_ESTABLISHED, TCP_SYN_SENT, TCP_CLOSE_WAIT})
_STATES = sum(1 << state for state in _OPEN)

JIFFY_MS = 4
"""Resolution of the ages that the kernel reports, in milliseconds."""
QUIET_MS = 2 * JIFFY_MS
"""Time without data in either direction after which a connection counts as quiet, in milliseconds."""

_CONNTRACK_DELETE = 1 << 8 | 2
_CONNTRACK_MARK = 8
_CONNTRACK_MARK_MASK = 21
ALL_BITS = 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class TcpConnection:
    """TCP connection of a client.

    Attributes:
        identity: Identity of the socket, as the kernel encodes it.
        family: AF_INET or AF_INET6. gRPC often uses AF_INET6 sockets with mapped addresses.
        peer: Endpoint that the client connected to.
        queued: Bytes not yet sent.
        unacknowledged: Segments sent and not acknowledged.
        sent_ms: Age of the last data sent, in milliseconds.
        received_ms: Age of the last data received, in milliseconds.
        acknowledged_ms: Age of the last ACK received, in milliseconds.
        unread: Bytes received that the client has not read yet. Closing the connection would lose them.
    """

    identity: bytes
    family: int
    peer: Endpoint
    queued: int = 0
    unacknowledged: int = 0
    sent_ms: int = 0
    received_ms: int = 0
    acknowledged_ms: int = 0
    unread: int = 0

    @property
    def is_quiet(self) -> bool:
        """True if the connection is between two calls.

        This requires that all data has arrived and was read, that the server was the last to send, and that neither
        data nor an ACK was received for QUIET_MS. The ACK is included, because a large request on a slow link is
        acknowledged piece by piece.
        """
        delivered = self.queued == 0 and self.unacknowledged == 0 and self.unread == 0
        idle_ms = min(self.received_ms, self.acknowledged_ms)
        return delivered and self.received_ms <= self.sent_ms and idle_ms >= QUIET_MS


class DestroyUnsupported(RuntimeError):
    """The kernel cannot close sockets of other programs (CONFIG_INET_DIAG_DESTROY)."""


class TcpSockets:
    """TCP sockets of one network namespace.

    Args:
        netlink: Socket for socket diagnosis, opened in that namespace.
    """

    def __init__(self, netlink: Netlink) -> None:
        self._netlink = netlink

    def close(self) -> None:
        """Close the netlink socket."""
        self._netlink.close()

    def list_connections(self, peers: Collection[Endpoint]) -> list[TcpConnection]:
        """Return the connections to some endpoints.

        Raises:
            NetlinkError: The kernel refused the request, or did not respond.
        """
        connections = []
        for family in (socket.AF_INET, socket.AF_INET6):
            request = _REQUEST.pack(family, socket.IPPROTO_TCP, 1 << (_TCP_INFO - 1), _STATES) + b"\0" * _ID_BYTES
            for response in self._netlink.dump(_BY_FAMILY, request):
                connection = _decode(response)
                if connection is not None and connection.peer in peers:
                    connections.append(connection)
        return connections

    def refresh(self, connection: TcpConnection) -> TcpConnection | None:
        """Return the current state of a connection, None if it no longer exists.

        This costs less than listing all connections.

        Raises:
            NetlinkError: The kernel refused the request, or did not respond.
        """
        request = _REQUEST.pack(connection.family, socket.IPPROTO_TCP, 1 << (_TCP_INFO - 1), _STATES)
        sequence = self._netlink.sequence()
        self._netlink.send(encode_message(_BY_FAMILY, 0, sequence, request + connection.identity))
        while True:
            for kind, number, body in self._netlink.receive():
                if number != sequence:
                    continue
                if kind != NLMSG_ERROR:
                    current = _decode(body)
                    return current if current is not None and body[1] in _OPEN else None
                code = -struct.unpack_from("=i", body)[0]
                if code != errno.ENOENT:
                    raise NetlinkError(code, f"sockets: cannot read a connection: {os.strerror(code)}")
                return None

    def destroy(self, connection: TcpConnection) -> None:
        """Close a connection. Its program gets "connection aborted" and connects again.

        Raises:
            DestroyUnsupported: This kernel cannot close sockets of other programs.
            NetlinkError: The kernel refused the request, or did not respond.
        """
        request = _REQUEST.pack(connection.family, socket.IPPROTO_TCP, 0, _STATES) + connection.identity
        sequence = self._netlink.sequence()
        self._netlink.send(encode_message(_DESTROY, NLM_F_ACK, sequence, request))
        try:
            self._netlink.acknowledged({sequence}, ignore=frozenset({errno.ENOENT}))
        except NetlinkError as error:
            if error.errno == errno.EOPNOTSUPP:
                raise DestroyUnsupported(
                    "sockets: this kernel cannot close sockets (CONFIG_INET_DIAG_DESTROY)"
                ) from error
            raise


def _decode(response: bytes) -> TcpConnection | None:
    """Decode a connection from the kernel's response, None if it is not IPv4."""
    family = response[0]
    identity = response[_RESPONSE_HEAD_BYTES : _RESPONSE_HEAD_BYTES + _ID_BYTES]
    _source_port, port, _source, peer = _ID.unpack_from(identity)
    if family == socket.AF_INET6:
        if not peer.startswith(_MAPPED):
            return None
        peer = peer[len(_MAPPED) :]
    _expires, unread, queued = _QUEUES.unpack_from(response, _RESPONSE_HEAD_BYTES + _ID_BYTES)
    rest = response[_RESPONSE_HEAD_BYTES + _ID_BYTES + _QUEUES.size + 8 :]
    info = next((value for kind, value in attributes(rest) if kind == _TCP_INFO), b"").ljust(_INFO.size, b"\0")
    unacknowledged, sent_ms, _, received_ms, acknowledged_ms = _INFO.unpack_from(info)
    return TcpConnection(
        identity=identity,
        family=family,
        peer=Endpoint(IPv4Address(peer[:4]), port),
        queued=queued,
        unacknowledged=unacknowledged,
        sent_ms=sent_ms,
        received_ms=received_ms,
        acknowledged_ms=acknowledged_ms,
        unread=unread,
    )


class PodNamespaces:
    """TCP sockets of all pods on this node, one `TcpSockets` for each network namespace of the container runtime.

    Args:
        directory: Directory of the namespaces, /run/netns. None if this node has no clients.
        node_namespace: The node's own namespace, for clients in the host network.
    """

    def __init__(self, directory: Path | None, *, node_namespace: Path = Path("/proc/self/ns/net")) -> None:
        self._directory = directory
        self._node_namespace = node_namespace
        self._open: dict[Path, TcpSockets] = {}

    def refresh(self) -> Collection[TcpSockets]:
        """Open new namespaces, close removed ones, and return the sockets of all."""
        if self._directory is None:
            return ()
        paths = {self._node_namespace}
        try:
            paths.update(self._directory.iterdir())
        except OSError as error:  # the runtime has created no namespace yet
            log.debug("redirector: no network namespaces of pods (error=%s)", error)
        for path in set(self._open) - paths:
            self._open.pop(path).close()
        for path in paths - set(self._open):
            try:
                self._open[path] = TcpSockets(in_namespace(path, lambda: Netlink(NETLINK_SOCK_DIAG)))
            except (OSError, RuntimeError) as error:  # the pod is ending
                log.debug("redirector: network namespace skipped (path=%s error=%s)", path, error)
        return self._open.values()

    def list_connections(self, services: Collection[Endpoint]) -> Iterator[tuple[TcpSockets, TcpConnection]]:
        """Yield the connections to some services. Unreadable namespaces are skipped, such as namespaces of ending pods."""
        for sockets in self.refresh():
            try:
                connections = sockets.list_connections(services)
            except NetlinkError as error:
                log.warning("redirector: connections not listed (error=%s)", error)
                continue
            for connection in connections:
                yield sockets, connection

    def cut(self, services: Collection[Endpoint], identities: Collection[bytes]) -> int:
        """Close connections to some services, even in the middle of a call.

        Args:
            services: Endpoints that the connections go to.
            identities: Identities of the connections to close.

        Returns:
            Number of closed connections.

        Raises:
            NetlinkError: The kernel refused a request, or did not respond.
        """
        cut = 0
        for sockets in self.refresh():
            for connection in sockets.list_connections(services):
                if connection.identity in identities:
                    if not destroy_connection(sockets, connection):
                        return cut
                    cut += 1
        return cut

    def close(self) -> None:
        """Close all sockets."""
        for sockets in self._open.values():
            sockets.close()
        self._open.clear()


def destroy_connection(sockets: TcpSockets, connection: TcpConnection) -> bool:
    """Close a connection.

    Returns:
        False if the kernel cannot close sockets. The connection then ends when its conntrack entry is deleted.
    """
    try:
        sockets.destroy(connection)
    except DestroyUnsupported as error:
        log.warning("redirector: connections not closed (error=%s)", error)
        return False
    except NetlinkError as error:
        log.warning("redirector: connection not closed (error=%s)", error)
    return True


class Conntrack:
    """Deletes conntrack entries of redirected connections.

    One message deletes all entries with a mark in the kernel. To find and delete them one by one would take seconds among
    thousands of other entries.

    Args:
        netlink: Netfilter socket in the node's network namespace.
    """

    def __init__(self, netlink: Netlink) -> None:
        self._netlink = netlink

    def delete(self, service_number: int) -> None:
        """Delete the entries with a service number. The next packet of such a connection follows the current map.

        Raises:
            NetlinkError: The kernel refused the request, or did not respond.
        """
        self._delete(MARK_BASE | service_number, ALL_BITS)

    def delete_all(self) -> None:
        """Delete the entries of all redirected connections.

        Raises:
            NetlinkError: The kernel refused the request, or did not respond.
        """
        self._delete(MARK_BASE, MARK_MASK)

    def _delete(self, mark: int, mask: int) -> None:
        sequence = self._netlink.sequence()
        body = struct.pack(">BBH", socket.AF_INET, 0, 0)
        body += attribute(_CONNTRACK_MARK, struct.pack(">I", mark))
        body += attribute(_CONNTRACK_MARK_MASK, struct.pack(">I", mask))
        self._netlink.send(encode_message(_CONNTRACK_DELETE, NLM_F_ACK, sequence, body))
        self._netlink.acknowledged({sequence}, ignore=frozenset({errno.ENOENT}))
