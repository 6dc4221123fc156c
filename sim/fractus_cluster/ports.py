"""Free ports of the loopback device, for programs that are told where to listen."""

from __future__ import annotations

import atexit
import errno
import random
import socket
from collections import deque

# Below the ports that Linux usually gives to connections and to listeners on port 0 (32768 and up), below Kubernetes'
# NodePorts (30000 and up), above its components' (10248 to 10259) and those usual for MAVLink (14540 to 18570).
_FIRST, _LAST = 20_000, 29_999
_KEPT = 512

_chance = random.SystemRandom()
_reservations: deque[socket.socket] = deque()


def free_port() -> int:
    """Reserve a port, TCP and UDP, on which no process listens at 127.0.0.1 and which is given to no other caller.

    The port stays reserved, also among processes, until this process ends or has asked for 512 more: a program that
    listens there may end and start again. Elsewhere than on Linux, ports are only looked for and not reserved.

    Raises:
        OSError: no port is free.
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
    message = f"none of the ports {_FIRST} to {_LAST} of 127.0.0.1 is free; end programs that listen there"
    raise OSError(message)


def _reserve(port: int) -> socket.socket | None:
    """Take the port's name among Unix sockets: like ports, one network namespace has it once, and it needs no file."""
    reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        reservation.bind(f"\0fractus/port/{port}")
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            reservation.close()
            return None
        # Only Linux has such names.
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
def _give_back() -> None:
    while _reservations:
        _reservations.pop().close()
