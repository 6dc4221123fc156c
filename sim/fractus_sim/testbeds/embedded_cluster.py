"""Sockets in another network namespace, such as the namespace of a node of the embedded cluster."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

from fractus_agent.redirector.netlink import in_namespace

from fractus_sim.errors import ExperimentError


def connect_in(namespace: Path, port: int, timeout_s: float) -> socket.socket:
    """Connect to a loopback port inside a network namespace.

    Raises:
        ExperimentError: The namespace cannot be entered, or the connection was refused.
    """
    return _inside(namespace, lambda: socket.create_connection(("127.0.0.1", port), timeout_s))


def listen_in(namespace: Path, port: int) -> socket.socket:
    """Listen on a loopback port inside a network namespace.

    Raises:
        ExperimentError: The namespace cannot be entered, or the port is in use.
    """
    return _inside(namespace, lambda: socket.create_server(("127.0.0.1", port)))


def _inside(namespace: Path, make: Callable[[], socket.socket]) -> socket.socket:
    try:
        return in_namespace(namespace, make)
    except OSError as error:
        raise ExperimentError(f"network namespace {namespace.name}: {error.strerror or error}") from None
