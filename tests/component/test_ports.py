"""Ports for programs that are told where to listen: no one else gets them, not even between two starts."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from fractus_cluster import ports

ALL_OF_TEN = """
from fractus_cluster import ports
ports._FIRST, ports._LAST = {first}, {last}
while True:
    try:
        print(ports.free_port())
    except OSError:
        break
"""


@pytest.fixture
def ten(monkeypatch: pytest.MonkeyPatch) -> Iterator[range]:
    """The only ten ports there are: no one has one, and no other run of these tests has them meanwhile."""
    own: deque[socket.socket] = deque()
    with ExitStack() as claims:
        first = next(first for first in range(19_000, 20_000, 10) if claimed(claims, first))
        monkeypatch.setattr(ports, "_FIRST", first)
        monkeypatch.setattr(ports, "_LAST", first + 9)
        monkeypatch.setattr(ports, "_reservations", own)
        yield range(first, first + 10)
        for reservation in own:
            reservation.close()


def claimed(claims: ExitStack, first: int) -> bool:
    claim = claims.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
    try:
        claim.bind(f"\0fractus/test/{first}")
    except OSError:
        return False
    return all(ports._is_free(port) for port in range(first, first + 10))


def given_to_another_process(among: range) -> set[int]:
    script = ALL_OF_TEN.format(first=among[0], last=among[-1])
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    return {int(line) for line in done.stdout.split()}


def test_no_other_process_gets_our_ports_and_theirs_are_free_when_they_end(ten: range) -> None:
    ours = {ports.free_port() for _ in range(3)}
    assert len(ours) == 3
    theirs = given_to_another_process(ten)
    assert theirs
    assert not theirs & ours
    assert given_to_another_process(ten) == theirs


def test_a_port_where_another_listens_is_not_given(ten: range) -> None:
    free = given_to_another_process(ten)
    with socket.socket() as taken, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        taken.bind(("0.0.0.0", min(free)))
        taken.listen()
        bound.bind(("127.0.0.1", max(free)))
        assert given_to_another_process(ten) == free - {min(free), max(free)}


def test_without_a_free_port_it_says_which_were_tried(ten: range) -> None:
    assert {ports.free_port() for _ in ten} == set(ten)
    with pytest.raises(OSError, match=f"no free port from {ten[0]} to {ten[-1]} .*; end programs"):
        ports.free_port()


def test_the_oldest_reservations_end_first(ten: range, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_KEPT", 2)
    given = [ports.free_port() for _ in range(4)]
    assert given_to_another_process(ten) == set(ten) - set(given[-2:])


def test_ports_lie_below_what_linux_and_kubernetes_give_to_anyone_and_above_what_is_usual_for_mavlink() -> None:
    assert all(18_570 < ports.free_port() < 30_000 for _ in range(50))
