"""Netlink as far as the agent needs it: raw messages, so that a switch takes a millisecond and no library.

A netlink socket belongs to the network namespace in which it was opened, for as long as it lives.
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

NETLINK_ROUTE, NETLINK_SOCK_DIAG, NETLINK_NETFILTER = 0, 4, 12
NLM_F_REQUEST, NLM_F_ACK, NLM_F_REPLACE, NLM_F_DUMP, NLM_F_CREATE = 0x1, 0x4, 0x100, 0x300, 0x400
NLMSG_ERROR, NLMSG_DONE = 2, 3
NLA_F_NESTED = 0x8000

TIMEOUT_S = 2.0
"""The kernel answers in microseconds; a socket that stays silent is broken."""

RECEIVE_BYTES = 1 << 16
CLONE_NEWNET = 0x40000000

_HEADER = struct.Struct("=IHHII")
_ATTRIBUTE = struct.Struct("=HH")

Result = TypeVar("Result")


class NetlinkError(OSError):
    """The kernel refused a message, or did not answer."""


def attribute(kind: int, value: bytes) -> bytes:
    """One attribute, padded to four bytes."""
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value + b"\0" * (-len(value) % 4)


def nested(kind: int, *attributes: bytes) -> bytes:
    """An attribute that holds attributes."""
    return attribute(kind | NLA_F_NESTED, b"".join(attributes))


def attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The attributes in a message: kind without its flags, and value."""
    while len(data) >= _ATTRIBUTE.size:
        length, kind = _ATTRIBUTE.unpack_from(data)
        if not _ATTRIBUTE.size <= length <= len(data):
            return
        yield kind & 0x3FFF, data[_ATTRIBUTE.size : length]
        data = data[(length + 3) & ~3 :]


def message(kind: int, flags: int, sequence: int, payload: bytes) -> bytes:
    """One message with its header."""
    return _HEADER.pack(_HEADER.size + len(payload), kind, flags | NLM_F_REQUEST, sequence, 0) + payload


class Netlink:
    """A netlink socket.

    Args:
        protocol: NETLINK_NETFILTER, NETLINK_SOCK_DIAG or NETLINK_ROUTE.

    Raises:
        NetlinkError: the kernel has no such protocol.
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
        """A number for the next message."""
        self._sequence = self._sequence % 0x7FFFFFFF + 1
        return self._sequence

    def send(self, data: bytes) -> None:
        """Send messages in one datagram, which the kernel handles before this returns.

        Raises:
            NetlinkError: the socket does not take them.
        """
        try:
            self._socket.send(data)
        except OSError as error:
            raise NetlinkError(error.errno, f"netlink: {error.strerror or error}") from error

    def receive(self) -> Iterator[tuple[int, int, bytes]]:
        """Kind, sequence and payload of the messages of one datagram.

        Raises:
            NetlinkError: none came in time.
        """
        try:
            data = self._socket.recv(RECEIVE_BYTES)
        except OSError as error:
            raise NetlinkError(error.errno, f"netlink: no answer ({error})") from error
        while len(data) >= _HEADER.size:
            length, kind, _flags, sequence, _port = _HEADER.unpack_from(data)
            if not _HEADER.size <= length <= len(data):
                return
            yield kind, sequence, data[_HEADER.size : length]
            data = data[(length + 3) & ~3 :]

    def acknowledged(
        self, sequences: set[int], *, refusals: frozenset[int] = frozenset(), ignore: frozenset[int] = frozenset()
    ) -> None:
        """Wait until messages that asked for it are acknowledged.

        Args:
            sequences: of these messages.
            refusals: of messages that are answered only when the kernel refuses them, and all that follow.
            ignore: errno values that are no errors here, such as ENOENT of a deletion.

        Raises:
            NetlinkError: the kernel refused one, or did not answer in time.
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
        """The payloads of all answers to one request.

        Raises:
            NetlinkError: the kernel refused it, or stopped answering.
        """
        sequence = self.sequence()
        self.send(message(kind, NLM_F_DUMP, sequence, payload))
        while True:
            for found, number, body in self.receive():
                if number != sequence:
                    continue
                if found == NLMSG_DONE:
                    return
                if found == NLMSG_ERROR:
                    failed = -struct.unpack_from("=i", body)[0]
                    raise NetlinkError(failed, f"netlink: the kernel refused a list: {os.strerror(failed)}")
                yield body


def in_namespace(path: Path, make: Callable[[], Result]) -> Result:
    """Call a function in another network namespace, such as a pod's, on a thread of its own.

    Args:
        path: the namespace, /proc/PID/ns/net or /run/netns/NAME.
        make: opens sockets, which stay in that namespace.

    Raises:
        OSError: there is no such namespace, or it may not be entered.
    """
    done: Future[Result] = Future()

    def enter() -> None:
        try:
            with path.open("rb") as namespace:
                libc = ctypes.CDLL(None, use_errno=True)
                if libc.setns(namespace.fileno(), CLONE_NEWNET) != 0:
                    number = ctypes.get_errno()
                    raise OSError(number, f"cannot enter the network namespace: {os.strerror(number)}", str(path))
            done.set_result(make())
        except BaseException as error:  # handed to the caller, whatever it is
            done.set_exception(error)

    # The thread ends here, and the namespace that it entered with it: no thread of a pool is left in a wrong one.
    thread = Thread(target=enter, name="in_namespace", daemon=True)
    thread.start()
    thread.join()
    return done.result()
