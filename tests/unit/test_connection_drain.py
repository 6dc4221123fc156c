"""Draining of connections before traffic changes its path: use of the link, closed connections, and errors."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from ipaddress import IPv4Address
from typing import Any, cast

import pytest
from fractus_agent.links.connection_drain import ConnectionDrain
from fractus_agent.redirector.connections import Conntrack, PodNamespaces
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft_maps import Endpoint, NftMaps
from fractus_agent.redirector.redirector import Redirector, SwitchResult

LOADER, ASKER, DIRECT = (Endpoint(IPv4Address(address), 80) for address in ("10.96.0.5", "10.96.0.6", "169.254.1.1"))


class FakeRedirector:
    """Fake redirector. Its old connections carry traffic until `idle` is set."""

    def __init__(self) -> None:
        self.redirects: dict[Endpoint, Endpoint] = {}
        self.idle = asyncio.Event()
        self.cut = 0
        self.refuses: str = ""

    async def switch(self, targets: Mapping[Endpoint, Endpoint | None], *, planned: bool) -> SwitchResult:
        assert planned
        if self.refuses == "at once":
            raise NetlinkError(1, "no")
        self.redirects = {v: t for v, t in (self.redirects | dict(targets)).items() if t is not None}
        try:
            await self.idle.wait()
        except asyncio.CancelledError:
            self.cut += 1
            raise
        if self.refuses:
            raise NetlinkError(1, "no")
        return SwitchResult()


async def test_link_is_in_use_until_its_connections_are_drained() -> None:
    redirector = FakeRedirector()
    ended = asyncio.Event()
    drain = ConnectionDrain(cast(Redirector, redirector), ended.set)
    await drain.begin({LOADER: DIRECT})
    assert redirector.redirects == {LOADER: DIRECT}, "new connections use the link immediately"
    assert not drain.on_link, "the connections that are drained still use the cloud path"
    await drain.begin({LOADER: None})
    assert drain.on_link
    redirector.idle.set()
    async with asyncio.timeout(10):
        await ended.wait()
    await asyncio.sleep(0)
    assert not drain.on_link


async def test_connections_on_a_lost_path_are_cut() -> None:
    redirector = FakeRedirector()
    drain = ConnectionDrain(cast(Redirector, redirector), lambda: None)
    redirector.redirects = {LOADER: DIRECT}
    await drain.begin({LOADER: None, ASKER: DIRECT})
    assert drain.on_link
    await drain.cut(on_link=True)
    assert (redirector.cut, drain.on_link) == (1, False)
    await drain.cut(on_link=False)
    assert redirector.cut == 2


@pytest.mark.parametrize("refuses", ["at once", "in the end"])
async def test_switch_refused_by_the_kernel_is_reported(refuses: str, caplog: pytest.LogCaptureFixture) -> None:
    redirector = FakeRedirector()
    ended = asyncio.Event()
    redirector.refuses = refuses
    drain = ConnectionDrain(cast(Redirector, redirector), ended.set)
    if refuses == "at once":
        with pytest.raises(NetlinkError):
            await drain.begin({LOADER: DIRECT})
        return
    await drain.begin({LOADER: DIRECT})
    redirector.idle.set()
    async with asyncio.timeout(10):
        await ended.wait()
    assert "not drained" in caplog.text


class FakeKernel:
    """Fake kernel interface with BPF maps, conntrack and sockets. It records the deleted service numbers."""

    def __init__(self) -> None:
        self.deleted: list[int] = []

    def write(self, *_: object) -> None:
        return

    def delete(self, number: int) -> None:
        self.deleted.append(number)

    def list_connections(self, _services: object) -> list[Any]:
        return []

    def cut(self, *_: object) -> int:
        return 0


def test_connections_on_the_cloud_path_survive_removal_of_their_service() -> None:
    kernel = FakeKernel()
    redirector = Redirector(cast(NftMaps, kernel), cast(Conntrack, kernel), cast(PodNamespaces, kernel))
    redirector.set_services([LOADER, ASKER])
    redirector.set_targets({ASKER: DIRECT})
    deleted_before = list(kernel.deleted)
    redirector.set_services([])
    assert len(kernel.deleted) == len(deleted_before) + 1, "only the connections on the link are deleted"
    assert redirector.redirects == {}
