"""Raw netlink messages for the redirector, because its map swap must take less than a millisecond.

Addresses, neighbours and link state use pyroute2 instead (docs/decisions/0025). A netlink socket stays in the network
namespace in which it was opened.
"""

from __future__ import annotations

import ctypes
import os
import socket
import struct
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from threading import Thread
from typing import TypeVar

NETLINK_SOCK_DIAG = 4
NETLINK_NETFILTER = 12
NLM_F_REQUEST = 0x1
NLM_F_ACK = 0x4
NLM_F_DUMP = 0x300
NLM_F_CREATE = 0x400
NLMSG_ERROR = 2
NLMSG_DONE = 3
NLA_F_NESTED = 0x8000

TIMEOUT_S = 2.0
"""Time to wait for a response, in seconds. The kernel responds in microseconds, so a silent socket is broken."""

RECEIVE_BYTES = 1 << 16
CLONE_NEWNET = 0x40000000

_HEADER = struct.Struct("=IHHII")
_ATTRIBUTE = struct.Struct("=HH")

Result = TypeVar("Result")


class NetlinkError(OSError):
    """The kernel refused a message, or did not respond."""


def attribute(kind: int, value: bytes) -> bytes:
    """Encode an attribute, padded to four bytes."""
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value + b"\0" * (-len(value) % 4)


def nested(kind: int, *attributes: bytes) -> bytes:
    """Encode an attribute that contains other attributes."""
    return attribute(kind | NLA_F_NESTED, b"".join(attributes))


def attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Decode the attributes of a message to kind (without flags) and value."""
    while len(data) >= _ATTRIBUTE.size:
        length, kind = _ATTRIBUTE.unpack_from(data)
        if not _ATTRIBUTE.size <= length <= len(data):
            return
        yield kind & 0x3FFF, data[_ATTRIBUTE.size : length]
        data = data[(length + 3) & ~3 :]


def encode_message(kind: int, flags: int, sequence: int, payload: bytes) -> bytes:
    """Encode a message with its header."""
    return _HEADER.pack(_HEADER.size + len(payload), kind, flags | NLM_F_REQUEST, sequence, 0) + payload


class Netlink:
    """A netlink socket.

    Args:
        protocol: NETLINK_NETFILTER or NETLINK_SOCK_DIAG.

    Raises:
        NetlinkError: The kernel does not support the protocol.
    """

    def __init__(self, protocol: int) -> None:
        try:
            self._socket = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, protocol)
            self._socket.bind((0, 0))
        except OSError as error:
            raise NetlinkError(error.errno, f"netlink: cannot open protocol {protocol}: {error.strerror}") from error
        self._socket.settimeout(TIMEOUT_S)
        self._sequence = 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def sequence(self) -> int:
        """Return the sequence number of the next message."""
        self._sequence = self._sequence % 0x7FFFFFFF + 1
        return self._sequence

    def send(self, data: bytes) -> None:
        """Send messages in one datagram. The kernel handles them before this method returns.

        Raises:
            NetlinkError: The messages cannot be sent.
        """
        try:
            self._socket.send(data)
        except OSError as error:
            raise NetlinkError(error.errno, f"netlink: {error.strerror or error}") from error

    def receive(self) -> Iterator[tuple[int, int, bytes]]:
        """Receive one datagram, and yield kind, sequence number and payload of its messages.

        Raises:
            NetlinkError: No datagram arrived in time.
        """
        try:
            data = self._socket.recv(RECEIVE_BYTES)
        except OSError as error:
            raise NetlinkError(error.errno, f"netlink: no response ({error})") from error
        while len(data) >= _HEADER.size:
            length, kind, _flags, sequence, _port = _HEADER.unpack_from(data)
            if not _HEADER.size <= length <= len(data):
                return
            yield kind, sequence, data[_HEADER.size : length]
            data = data[(length + 3) & ~3 :]

    def acknowledged(
        self, sequences: set[int], *, refusals: frozenset[int] = frozenset(), ignore: frozenset[int] = frozenset()
    ) -> None:
        """Wait until messages are acknowledged.

        Args:
            sequences: Sequence numbers of messages with NLM_F_ACK.
            refusals: Sequence numbers of messages to which the kernel responds only if it refuses the whole batch.
            ignore: errno values that do not count as errors, such as ENOENT of a deletion.

        Raises:
            NetlinkError: The kernel refused a message, or did not respond in time.
        """
        waiting = set(sequences)
        refused: int | None = None
        while waiting:
            for kind, sequence, payload in self.receive():
                if kind != NLMSG_ERROR or sequence not in waiting | refusals:
                    continue
                number = -struct.unpack_from("=i", payload)[0]
                if sequence in refusals and number:
                    raise NetlinkError(number, f"netlink: the kernel refused a batch: {os.strerror(number)}")
                waiting.discard(sequence)
                if number and number not in ignore:
                    refused = refused or number
        if refused:
            raise NetlinkError(refused, f"netlink: the kernel refused a message: {os.strerror(refused)}")

    def dump(self, kind: int, payload: bytes) -> Iterator[bytes]:
        """Send a dump request, and yield the payloads of all responses.

        Raises:
            NetlinkError: The kernel refused the request, or stopped responding.
        """
        sequence = self.sequence()
        self.send(encode_message(kind, NLM_F_DUMP, sequence, payload))
        while True:
            for response_kind, number, body in self.receive():
                if number != sequence:
                    continue
                if response_kind == NLMSG_DONE:
                    return
                if response_kind == NLMSG_ERROR:
                    code = -struct.unpack_from("=i", body)[0]
                    raise NetlinkError(code, f"netlink: the kernel refused a dump: {os.strerror(code)}")
                yield body


def in_namespace(path: Path, function: Callable[[], Result]) -> Result:
    """Call a function in another network namespace, such as a pod's, on a separate thread.

    Args:
        path: Namespace file: /proc/PID/ns/net or /run/netns/NAME.
        function: Function to call. Sockets that it opens stay in that namespace.

    Raises:
        OSError: The namespace does not exist, or the process may not enter it.
    """
    done: Future[Result] = Future()

    def enter() -> None:
        try:
            with path.open("rb") as namespace:
                libc = ctypes.CDLL(None, use_errno=True)
                if libc.setns(namespace.fileno(), CLONE_NEWNET) != 0:
                    number = ctypes.get_errno()
                    raise OSError(number, f"cannot enter the network namespace: {os.strerror(number)}", str(path))
            done.set_result(function())
        except BaseException as error:  # re-raised in the caller
            done.set_exception(error)

    # A thread of a pool would stay in the namespace. This thread ends here.
    thread = Thread(target=enter, name="in_namespace", daemon=True)
    thread.start()
    thread.join()
    return done.result()
