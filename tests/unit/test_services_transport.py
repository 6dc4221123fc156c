"""UDP links to an autopilot: who is heard, and who is spoken to."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fractus_services.mobility import transport
from fractus_services.mobility.dialect import Codec, message
from fractus_services.mobility.transport import BadUrl, open_link

AUTOPILOT, STRANGER = ("127.0.0.1", 14550), ("127.0.0.1", 40000)


def heartbeat(autopilot: int = 3) -> bytes:
    return Codec(1, 1).encode(message("HEARTBEAT", type=2, autopilot=autopilot, system_status=3, mavlink_version=3))


class Socket:
    """Stands for the event loop's UDP transport."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, Any]] = []

    def sendto(self, data: bytes, to: Any = None) -> None:
        self.sent.append((data, to))


def link(connected: bool) -> tuple[Any, Socket, list[bytes]]:
    heard: list[bytes] = []
    made, socket = transport._Datagrams(heard.append, lambda _error: None, connected), Socket()
    made.connection_made(socket)  # type: ignore[arg-type]
    return made, socket, heard


def test_a_connected_link_speaks_first() -> None:
    made, socket, _ = link(connected=True)
    made.write(b"hello")
    assert socket.sent == [(b"hello", None)]


def test_a_listening_link_belongs_to_the_first_autopilot(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(transport.time, "monotonic", lambda: now[0])
    made, socket, heard = link(connected=False)
    made.datagram_received(b"x", STRANGER)
    made.datagram_received(heartbeat(autopilot=8), STRANGER)
    made.write(b"nobody")
    assert not heard
    assert not socket.sent
    made.datagram_received(heartbeat(), AUTOPILOT)
    made.datagram_received(heartbeat(), STRANGER)
    made.write(b"command")
    assert len(heard) == 1
    assert socket.sent == [(b"command", AUTOPILOT)]
    now[0] += transport.PEER_SILENCE_S + 0.1
    made.datagram_received(heartbeat(), STRANGER)
    made.write(b"again")
    assert socket.sent[-1] == (b"again", STRANGER)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "drone.example"])
def test_listening_to_other_hosts_is_refused(host: str) -> None:
    with pytest.raises(BadUrl, match=r"use udpin:127\.0\.0\.1"):
        asyncio.run(open_link(f"udpin:{host}:14550", lambda _data: None, lambda _error: None))
