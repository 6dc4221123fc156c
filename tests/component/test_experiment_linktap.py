"""The link tap of experiments with a server that is temporarily unavailable."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.link_tap import LinkTap

TIMEOUT_S = 10.0


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(TIMEOUT_S)
        yield listening


@pytest.mark.parametrize(
    "problem",
    [ConnectionRefusedError("refused"), ExperimentError("network namespace drone-1: no such file or directory")],
)
def test_link_tap_disconnects_client_of_unavailable_server_and_serves_the_next_client(
    tmp_path: Path, server: socket.socket, problem: Exception
) -> None:
    problems = [problem]

    def connect() -> socket.socket:
        if problems:
            raise problems.pop()
        return socket.create_connection(server.getsockname(), TIMEOUT_S)

    listener = socket.create_server(("127.0.0.1", 0))
    address = listener.getsockname()
    tap = LinkTap(listener, connect, tmp_path / "link.tlog")
    try:
        with socket.create_connection(address, TIMEOUT_S) as client:
            assert client.recv(1) == b""
        with socket.create_connection(address, TIMEOUT_S) as client:
            client.sendall(b"up")
            served, _ = server.accept()
            with served:
                served.settimeout(TIMEOUT_S)
                assert served.recv(2) == b"up"
                served.sendall(b"down")
                assert client.recv(4) == b"down"
    finally:
        tap.close()
