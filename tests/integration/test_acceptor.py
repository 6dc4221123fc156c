"""The end of a direct link that is asked, on the loopback: peers that crowd, stall, come again, and certificates that change."""

from __future__ import annotations

import asyncio
import base64
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address
from pathlib import Path

import pytest
from fractus_agent.links import acceptor as acceptor_module
from fractus_agent.links import pairing
from fractus_agent.links.acceptor import MAX_PENDING, Acceptor
from fractus_agent.links.pairing import PairingFailed, Session, ask
from fractus_cluster.ports import free_port
from fractus_core.identity.authority import Authority

HERE = IPv4Address("127.0.0.1")


class Site:
    """An edge node that takes sessions, and the certificates of those that ask."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.authority = Authority.generate(datetime.now(UTC))
        self.certify("e1")
        self.active: list[str] = []
        self.most: dict[str, int] = {}
        self.refusal: str | Exception = ""

    def certify(self, node: str, *, at: datetime | None = None) -> Path:
        folder = self.directory / node
        folder.mkdir(exist_ok=True)
        for name, content in self.authority.issue_node(node, at or datetime.now(UTC)).items():
            (folder / name).write_bytes(base64.b64decode(content))
        return folder

    async def linked(self, session: Session) -> None:
        self.active.append(session.peer)
        self.most[session.peer] = max(self.most.get(session.peer, 0), self.active.count(session.peer))
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.05)  # traffic is moved back
            self.active.remove(session.peer)

    def permits(self, _peer: str) -> str:
        if isinstance(self.refusal, Exception):
            raise self.refusal
        return self.refusal

    @asynccontextmanager
    async def open(self, *, max_peers: int = 4) -> AsyncIterator[Acceptor]:
        acceptor = Acceptor(self.directory / "e1", self.permits, self.linked, max_peers=max_peers)
        running = asyncio.create_task(acceptor.run(HERE))
        await asyncio.sleep(0.1)
        try:
            yield acceptor
        finally:
            running.cancel()
            async with asyncio.timeout(10):
                await asyncio.gather(running, return_exceptions=True)

    async def ask(self, node: str) -> Session:
        return await ask(node, "e1", HERE, self.certify(node), {})


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    port = free_port()
    monkeypatch.setattr(pairing, "PORT", port)
    monkeypatch.setattr(acceptor_module, "PORT", port)
    return Site(tmp_path)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not condition():  # noqa: ASYNC110 - sockets tell no one
            await asyncio.sleep(0.01)


async def silent_peer() -> socket.socket:
    return await asyncio.to_thread(socket.create_connection, (str(HERE), pairing.PORT), 10.0)


async def test_a_peer_that_asks_often_has_one_session(site: Site) -> None:
    async with site.open(max_peers=1) as acceptor:
        asked = await asyncio.gather(*(site.ask("d1") for _ in range(6)), return_exceptions=True)
        await until(lambda: site.active == ["d1"])
        assert acceptor.peers == {"d1"}
        assert site.most == {"d1": 1}
        assert any(isinstance(session, Session) for session in asked)
    assert site.active == []


async def test_places_are_not_given_twice(site: Site) -> None:
    async with site.open(max_peers=2) as acceptor:
        asked = await asyncio.gather(*(site.ask(f"d{n}") for n in range(6)), return_exceptions=True)
        assert sum(isinstance(session, Session) for session in asked) == 2
        assert len(acceptor.peers) == 2


async def test_peers_that_stall_do_not_stand_in_the_way(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acceptor_module, "HANDSHAKE_TIMEOUT_S", 0.5)
    async with site.open() as acceptor:
        silent = [await silent_peer() for _ in range(3 * MAX_PENDING)]
        await until(lambda: acceptor._pending == 0)
        session = await site.ask("d1")
        await until(lambda: site.active == ["d1"])
        await session.close()
        for each in silent:
            each.close()


async def test_shutdown_waits_for_no_handshake(site: Site) -> None:
    async with site.open():
        silent = await silent_peer()
        await asyncio.sleep(0.1)
    silent.close()
    assert site.active == []


async def test_a_renewed_certificate_is_used_without_a_restart(site: Site) -> None:
    site.certify("e1", at=datetime.now(UTC) - timedelta(days=90))
    async with site.open():
        with pytest.raises(PairingFailed, match="does not have its certificate"):
            await site.ask("d1")
        site.certify("e1")
        await (await site.ask("d1")).close()


async def test_a_permit_that_fails_permits_nothing(site: Site) -> None:
    site.refusal = RuntimeError("no DirectLinks yet")
    async with site.open() as acceptor:
        with pytest.raises(PairingFailed, match="not known whether"):
            await site.ask("d1")
        assert acceptor.peers == frozenset()
        site.refusal = ""
        await (await site.ask("d1")).close()
