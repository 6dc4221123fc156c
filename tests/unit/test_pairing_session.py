"""Pairing sessions: silence and delayed scheduling."""

from __future__ import annotations

import asyncio
import socket
import threading
import time

import pytest
from fractus_agent.links.pairing import LinkLost, Session


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
