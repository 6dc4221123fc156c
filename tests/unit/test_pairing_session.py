"""Pairing sessions: silence and delayed scheduling."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from fractus_agent.links import connector as connector_module
from fractus_agent.links.beacons import decode
from fractus_agent.links.connector import Connector
from fractus_agent.links.pairing import MAX_LINE_BYTES, LinkLost, Session
from fractus_core.linking import LinkPhase, LinkState


async def session(end: socket.socket) -> Session:
    reader, writer = await asyncio.open_connection(sock=end)
    return Session(reader, writer, "edge-1")


async def test_message_that_arrives_while_the_process_is_suspended_is_received() -> None:
    near, far = socket.socketpair()
    paired = await session(near)
    late = threading.Timer(0.1, far.sendall, [b'{"beat": 1}\n'])
    asyncio.get_running_loop().call_later(0.05, time.sleep, 0.5)
    late.start()
    try:
        assert await paired.receive(0.3) == {"beat": 1}
    finally:
        late.join()
        far.close()
        await paired.close()


async def test_silent_peer_is_lost() -> None:
    near, far = socket.socketpair()
    paired = await session(near)
    try:
        with pytest.raises(LinkLost, match=r"edge-1 has been silent for 0\.05 s"):
            await paired.receive(0.05)
    finally:
        far.close()
        await paired.close()


@pytest.mark.parametrize(
    "line",
    [
        b"[" * 60_000 + b"\n",
        b'{"a":' * 10_000 + b"1" + b"}" * 10_000 + b"\n",
        b'{"a":' * 150 + b"1" + b"}" * 150 + b"\n",
        b"x" * (MAX_LINE_BYTES + 1),
        b"[]\n",
        b"\xff\n",
        b"1" * 5_000 + b"\n",
        b"",
    ],
    ids=["deep-list", "deep-object", "object-of-150", "long", "list", "not-utf8", "huge-number", "end"],
)
async def test_message_that_cannot_be_decoded_ends_the_session(line: bytes) -> None:
    near, far = socket.socketpair()
    reader, writer = await asyncio.open_connection(sock=near, limit=MAX_LINE_BYTES)
    paired = Session(reader, writer, "edge-1")
    try:
        far.setblocking(True)
        sending = threading.Thread(target=lambda: (far.sendall(line), far.shutdown(socket.SHUT_WR)))
        sending.start()
        with pytest.raises(LinkLost, match="edge-1"):
            await paired.receive(5.0)
        sending.join()
    finally:
        far.close()
        await paired.close()


@pytest.mark.parametrize(
    "sent",
    [b"1" + b"0" * 400, b"1e400", b"NaN", b"-1e308", b"1e308", b"true", b"-1e9"],
    ids=["huge-integer", "infinite", "nan", "lowest", "highest", "boolean", "old"],
)
async def test_session_survives_implausible_heartbeats(sent: bytes) -> None:
    near, far = socket.socketpair()
    paired = await session(near)
    received: list[Any] = []
    paired.on_message = received.append
    running = asyncio.create_task(paired.run())
    try:
        far.sendall(b'{"echo": %s}\n{"beat": %s}\n{"routes": {}}\n' % (sent, sent))
        async with asyncio.timeout(5.0):
            while not received and not running.done():  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        assert received == [{"routes": {}}]
        assert paired.latency_ms is None
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        far.close()
        await paired.close()


@pytest.mark.parametrize("error", [RecursionError("too deep"), UnicodeError("label too long"), ValueError("no number")])
async def test_connector_reports_any_failure_of_pairing_so_that_it_is_retried(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception
) -> None:
    async def fail(*_: object) -> None:
        raise error

    changes: list[LinkState] = []
    monkeypatch.setattr(connector_module, "pair", fail)
    connector = Connector("drone-1", tmp_path, lambda _session: fail(), lambda link, _reason: changes.append(link))
    await connector.set_peer("edge-1")
    async with asyncio.timeout(5.0):
        while connector.link.phase is not LinkPhase.NONE:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
    assert [link.phase for link in changes] == [LinkPhase.CONNECTING, LinkPhase.NONE]
    await connector.close()


@pytest.mark.parametrize(
    "data",
    [b"[" * 512, b'{"a":' * 100 + b"1" + b"}" * 100, b"\xff", b"1" * 512, b"NaN"],
    ids=["list", "object", "not-utf8", "number", "nan"],
)
def test_beacon_that_cannot_be_decoded_is_ignored(data: bytes) -> None:
    assert decode(data) is None
