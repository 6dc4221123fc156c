"""Reservation of ports for programs that get their port as an argument. No other process gets a reserved port."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from fractus_cluster import ports

RESERVE_ALL = """
from fractus_cluster import ports
ports._FIRST, ports._LAST = {first}, {last}
while True:
    try:
        print(ports.free_port())
    except OSError:
        break
"""


@pytest.fixture
def port_range(monkeypatch: pytest.MonkeyPatch) -> Iterator[range]:
    """Restrict reservations to ten free ports. Concurrent runs of these tests use different ports."""
    reservations: deque[socket.socket] = deque()
    with ExitStack() as claims:
        first = next(first for first in range(19_000, 20_000, 10) if claim_ports(claims, first))
        monkeypatch.setattr(ports, "_FIRST", first)
        monkeypatch.setattr(ports, "_LAST", first + 9)
        monkeypatch.setattr(ports, "_reservations", reservations)
        yield range(first, first + 10)
        for reservation in reservations:
            reservation.close()


def claim_ports(claims: ExitStack, first: int) -> bool:
    claim = claims.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
    try:
        claim.bind(f"\0fractus/test/{first}")
    except OSError:
        return False
    return all(ports._is_free(port) for port in range(first, first + 10))


def ports_of_another_process(port_range: range) -> set[int]:
    script = RESERVE_ALL.format(first=port_range[0], last=port_range[-1])
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    return {int(line) for line in result.stdout.split()}


def test_reserved_ports_are_exclusive_until_their_process_ends(port_range: range) -> None:
    own_ports = {ports.free_port() for _ in range(3)}
    assert len(own_ports) == 3
    other_ports = ports_of_another_process(port_range)
    assert other_ports
    assert not other_ports & own_ports
    assert ports_of_another_process(port_range) == other_ports


def test_port_in_use_is_not_reserved(port_range: range) -> None:
    free = ports_of_another_process(port_range)
    with socket.socket() as taken, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        taken.bind(("0.0.0.0", min(free)))
        taken.listen()
        bound.bind(("127.0.0.1", max(free)))
        assert ports_of_another_process(port_range) == free - {min(free), max(free)}


def test_error_without_free_port_names_the_range(port_range: range) -> None:
    assert {ports.free_port() for _ in port_range} == set(port_range)
    with pytest.raises(OSError, match=f"no free port from {port_range[0]} to {port_range[-1]} .*; end programs"):
        ports.free_port()


def test_oldest_reservations_are_released_first(port_range: range, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_KEPT", 2)
    reserved = [ports.free_port() for _ in range(4)]
    assert ports_of_another_process(port_range) == set(port_range) - set(reserved[-2:])


def test_reserved_ports_lie_between_mavlink_and_ephemeral_ports() -> None:
    assert all(18_570 < ports.free_port() < 30_000 for _ in range(50))
