"""Sockets in another network namespace, such as that of an embedded cluster's node."""

from __future__ import annotations

import ctypes
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

from fractus_sim.experiment.errors import ExperimentError

_CLONE_NEWNET = 0x40000000
_TIMEOUT_S = 10.0


def connect_in(namespace: Path, port: int, timeout_s: float) -> socket.socket:
    """Connect to a port of a namespace's loopback device.

    Raises:
        ExperimentError: the namespace cannot be entered, or no process listens.
    """
    return _inside(namespace, lambda: socket.create_connection(("127.0.0.1", port), timeout_s))


def listen_in(namespace: Path, port: int) -> socket.socket:
    """Listen on a port of a namespace's loopback device.

    Raises:
        ExperimentError: the namespace cannot be entered, or the port is taken.
    """
    return _inside(namespace, lambda: socket.create_server(("127.0.0.1", port)))


def _inside(namespace: Path, make: Callable[[], socket.socket]) -> socket.socket:
    """Make a socket in a thread that enters the namespace: the socket stays there, and we stay here."""
    made: list[socket.socket] = []
    failed: list[OSError] = []

    def enter() -> None:
        try:
            with namespace.open("rb") as handle:
                if ctypes.CDLL(None, use_errno=True).setns(handle.fileno(), _CLONE_NEWNET):
                    code = ctypes.get_errno()
                    raise OSError(code, os.strerror(code))
            made.append(make())
        except OSError as error:
            failed.append(error)

    thread = threading.Thread(target=enter, name="netns")
    thread.start()
    thread.join(_TIMEOUT_S)
    if not made:
        reason = failed[0].strerror or str(failed[0]) if failed else f"no answer within {_TIMEOUT_S:g} s"
        raise ExperimentError(f"network namespace {namespace.name}: {reason}")
    return made[0]
