"""Allocation of free loopback ports."""

from __future__ import annotations

import atexit
import errno
import random
import socket
from collections import deque

# The range lies above the ports of Kubernetes components (10248 to 10259) and the usual MAVLink ports (14540 to 18570).
# It lies below the Kubernetes NodePorts (30000 and up) and the ports that Linux assigns itself (32768 and up).
_FIRST = 20_000
_LAST = 29_999
_KEPT = 512

_chance = random.SystemRandom()
_reservations: deque[socket.socket] = deque()


def free_port() -> int:
    """Reserve a port (TCP and UDP) of 127.0.0.1 that is free and not reserved by another caller.

    Calls in all processes skip the port until this process ends or has reserved 512 more ports. The port therefore
    stays available for a program that listens on it and is restarted. On systems other than Linux, ports are not
    reserved.

    Raises:
        OSError: No port is free.
    """
    count = _LAST - _FIRST + 1
    start = _chance.randrange(count)
    for step in range(count):
        port = _FIRST + (start + step) % count
        reservation = _reserve(port)
        if reservation is None:
            continue
        if _is_free(port):
            _keep(reservation)
            return port
        reservation.close()
    message = f"no free port from {_FIRST} to {_LAST} on 127.0.0.1; end programs that listen there"
    raise OSError(message)


def _reserve(port: int) -> socket.socket | None:
    """Reserve a port by an abstract Unix socket with its number. Return None if the port is already reserved.

    The name of such a socket is unique in its network namespace. It needs no file.
    """
    reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        reservation.bind(f"\0fractus/port/{port}")
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            reservation.close()
            return None
        # Only Linux supports abstract Unix sockets.
    return reservation


def _is_free(port: int) -> bool:
    for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                return False
    return True


def _keep(reservation: socket.socket) -> None:
    _reservations.append(reservation)
    while len(_reservations) > _KEPT:
        _reservations.popleft().close()


@atexit.register
def _release() -> None:
    while _reservations:
        _reservations.pop().close()
