"""UDP and serial links to an autopilot: accepted addresses, and broken lines."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest
from fractus_runtime.mavlink_codec import Endpoint
from fractus_services.mobility.mavlink import transport
from fractus_services.mobility.mavlink.transport import BadUrl, open_link
from pymavlink.dialects.v20 import ardupilotmega as mavlink

AUTOPILOT = ("127.0.0.1", 14550)
STRANGER = ("127.0.0.1", 40000)


def heartbeat(autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA) -> bytes:
    values = {"type": mavlink.MAV_TYPE_QUADROTOR, "autopilot": autopilot, "system_status": mavlink.MAV_STATE_STANDBY}
    return Endpoint(1, 1).encode("HEARTBEAT", values)


class Socket:
    """Fake UDP transport of an event loop."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, Any]] = []

    def sendto(self, data: bytes, to: Any = None) -> None:
        self.sent.append((data, to))


def link(connected: bool) -> tuple[Any, Socket, list[bytes]]:
    received: list[bytes] = []
    datagrams = transport._Datagrams(received.append, lambda _error: None, connected)
    socket = Socket()
    datagrams.connection_made(socket)  # type: ignore[arg-type]
    return datagrams, socket, received


def test_udpout_sends_before_it_receives() -> None:
    datagrams, socket, _ = link(connected=True)
    datagrams.write(b"hello")
    assert socket.sent == [(b"hello", None)]


def test_udpin_accepts_only_the_first_autopilot(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(transport.time, "monotonic", lambda: now[0])
    datagrams, socket, received = link(connected=False)
    datagrams.datagram_received(b"x", STRANGER)
    datagrams.datagram_received(heartbeat(mavlink.MAV_AUTOPILOT_INVALID), STRANGER)
    datagrams.write(b"lost")
    assert not received
    assert not socket.sent
    datagrams.datagram_received(heartbeat(), AUTOPILOT)
    datagrams.datagram_received(heartbeat(), STRANGER)
    datagrams.write(b"command")
    assert len(received) == 1
    assert socket.sent == [(b"command", AUTOPILOT)]
    now[0] += transport.PEER_SILENCE_S + 0.1
    datagrams.datagram_received(heartbeat(), STRANGER)
    datagrams.write(b"again")
    assert socket.sent[-1] == (b"again", STRANGER)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "drone.example"])
def test_udpin_refuses_addresses_other_than_loopback(host: str) -> None:
    with pytest.raises(BadUrl, match=r"use udpin:127\.0\.0\.1"):
        asyncio.run(open_link(f"udpin:{host}:14550", lambda _data: None, lambda _error: None))


class Line:
    """Pseudoterminal with the autopilot of the test at its other end."""

    def __init__(self) -> None:
        self.far, near = os.openpty()
        self.name = os.ttyname(near)
        os.close(near)
        self.received: list[bytes] = []
        self.closed: list[Exception | None] = []
        self.news = asyncio.Event()

    async def open(self, speed: int = 115200) -> Any:
        return await open_link(f"serial:{self.name}:{speed}", self._receive, self._close)

    def _receive(self, data: bytes) -> None:
        self.received.append(data)
        self.news.set()

    def _close(self, error: Exception | None) -> None:
        self.closed.append(error)
        self.news.set()

    async def until(self, condition: Any) -> None:
        async with asyncio.timeout(20):
            while not condition():
                self.news.clear()
                await self.news.wait()


async def test_serial_line_transfers_bytes_in_both_directions() -> None:
    line = Line()
    link = await line.open()
    sent = bytes(range(256))  # includes control characters, because a terminal in the wrong mode would change them
    os.write(line.far, sent)
    await line.until(lambda: b"".join(line.received) == sent)
    link.write(sent)
    assert os.read(line.far, 1000) == sent
    link.close()
    link.close()
    os.close(line.far)
    assert not line.closed


async def test_unplugged_serial_line_is_closed_once() -> None:
    line = Line()
    link = await line.open()
    os.close(line.far)
    await line.until(lambda: line.closed)
    link.write(b"too late")
    assert len(line.closed) == 1


async def test_full_serial_line_does_not_block() -> None:
    line = Line()
    link = await line.open()
    for _ in range(100):
        link.write(b"x" * 4096)
    assert not line.closed
    link.close()
    os.close(line.far)


async def test_invalid_serial_line_raises(tmp_path: Path) -> None:
    plain = tmp_path / "file"
    plain.touch()
    for device in (plain, tmp_path / "gone"):
        with pytest.raises(OSError, match=r".+"):
            await open_link(f"serial:{device}:115200", lambda _data: None, lambda _error: None)
    with pytest.raises(BadUrl, match="serial speed 12345"):
        await Line().open(12345)
