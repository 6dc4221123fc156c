"""Acceptor of pairings on the loopback address: many peers, stalled peers, repeated pairing and renewed certificates."""

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
from fractus_agent.links.pairing import PairingFailed, Session, pair
from fractus_cluster.ports import free_port
from fractus_core.identity.authority import Authority

LOOPBACK = IPv4Address("127.0.0.1")


class Site:
    """An edge node that accepts sessions, with certificates for its peers."""

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

    async def on_session(self, session: Session) -> None:
        self.active.append(session.peer)
        self.most[session.peer] = max(self.most.get(session.peer, 0), self.active.count(session.peer))
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.05)  # stands for the time in which the agent moves traffic back
            self.active.remove(session.peer)

    def refusal_of(self, _peer: str) -> str:
        if isinstance(self.refusal, Exception):
            raise self.refusal
        return self.refusal

    @asynccontextmanager
    async def open(self, *, max_peers: int = 4) -> AsyncIterator[Acceptor]:
        acceptor = Acceptor(self.directory / "e1", self.refusal_of, self.on_session, max_peers=max_peers)
        running = asyncio.create_task(acceptor.run(LOOPBACK))
        await asyncio.sleep(0.1)
        try:
            yield acceptor
        finally:
            running.cancel()
            async with asyncio.timeout(10):
                await asyncio.gather(running, return_exceptions=True)

    async def pair(self, node: str) -> Session:
        return await pair(node, "e1", LOOPBACK, self.certify(node), {})


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    port = free_port()
    monkeypatch.setattr(pairing, "PAIRING_PORT", port)
    monkeypatch.setattr(acceptor_module, "PAIRING_PORT", port)
    return Site(tmp_path)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not condition():  # noqa: ASYNC110 - the conditions have no event
            await asyncio.sleep(0.01)


async def silent_peer() -> socket.socket:
    return await asyncio.to_thread(socket.create_connection, (str(LOOPBACK), pairing.PAIRING_PORT), 10.0)


async def test_peer_that_pairs_repeatedly_has_one_session(site: Site) -> None:
    async with site.open(max_peers=1) as acceptor:
        results = await asyncio.gather(*(site.pair("d1") for _ in range(6)), return_exceptions=True)
        await until(lambda: site.active == ["d1"])
        assert acceptor.peers == {"d1"}
        assert site.most == {"d1": 1}
        assert any(isinstance(session, Session) for session in results)
    assert site.active == []


async def test_acceptor_limits_the_number_of_peers(site: Site) -> None:
    async with site.open(max_peers=2) as acceptor:
        results = await asyncio.gather(*(site.pair(f"d{n}") for n in range(6)), return_exceptions=True)
        assert sum(isinstance(session, Session) for session in results) == 2
        assert len(acceptor.peers) == 2


async def test_stalled_handshakes_do_not_block_other_peers(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acceptor_module, "HANDSHAKE_TIMEOUT_S", 0.5)
    async with site.open() as acceptor:
        silent = [await silent_peer() for _ in range(3 * MAX_PENDING)]
        await until(lambda: acceptor._pending == 0)
        session = await site.pair("d1")
        await until(lambda: site.active == ["d1"])
        await session.close()
        for each in silent:
            each.close()


async def test_shutdown_does_not_wait_for_handshakes(site: Site) -> None:
    async with site.open():
        silent = await silent_peer()
        await asyncio.sleep(0.1)
    silent.close()
    assert site.active == []


async def test_renewed_certificate_is_used_without_restart(site: Site) -> None:
    site.certify("e1", at=datetime.now(UTC) - timedelta(days=90))
    async with site.open():
        with pytest.raises(PairingFailed, match="does not have its certificate"):
            await site.pair("d1")
        site.certify("e1")
        await (await site.pair("d1")).close()


async def test_pairing_is_refused_if_the_permission_check_fails(site: Site) -> None:
    site.refusal = RuntimeError("no DirectLinks yet")
    async with site.open() as acceptor:
        with pytest.raises(PairingFailed, match="internal error in the permission check"):
            await site.pair("d1")
        assert acceptor.peers == frozenset()
        site.refusal = ""
        await (await site.pair("d1")).close()
