"""Sockets in another network namespace, such as that of an embedded cluster's node."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

from fractus_agent.redirector.netlink import in_namespace

from fractus_sim.experiment.errors import ExperimentError


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
    try:
        return in_namespace(namespace, make)
    except OSError as error:
        raise ExperimentError(f"network namespace {namespace.name}: {error.strerror or error}") from None
