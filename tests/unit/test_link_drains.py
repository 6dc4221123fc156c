"""Planned switches in the background: what holds the link, what is cut, and what is told to whom began them."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from ipaddress import IPv4Address
from typing import Any, cast

import pytest
from fractus_agent.links.drains import Drains
from fractus_agent.redirector.conntrack import Conntrack
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft import Endpoint, Maps
from fractus_agent.redirector.redirector import Namespaces, Redirector, Switched

LOADER, ASKER, DIRECT = (Endpoint(IPv4Address(address), 80) for address in ("10.96.0.5", "10.96.0.6", "169.254.1.1"))


class Switches:
    """A redirector whose old connections are busy until they are told."""

    def __init__(self) -> None:
        self.redirects: dict[Endpoint, Endpoint] = {}
        self.idle, self.cut = asyncio.Event(), 0
        self.refuses: str = ""

    async def switch(self, targets: Mapping[Endpoint, Endpoint | None], *, planned: bool) -> Switched:
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
        return Switched()


async def test_a_link_is_in_use_until_its_old_connections_are_idle() -> None:
    switches, ended = Switches(), asyncio.Event()
    drains = Drains(cast(Redirector, switches), ended.set)
    await drains.begin({LOADER: DIRECT})
    assert switches.redirects == {LOADER: DIRECT}, "new connections take the link at once"
    assert not drains.on_link, "what drains is on the cloud path"
    await drains.begin({LOADER: None})
    assert drains.on_link
    switches.idle.set()
    async with asyncio.timeout(10):
        await ended.wait()
    await asyncio.sleep(0)
    assert not drains.on_link


async def test_what_drains_on_a_path_that_is_gone_is_cut_and_no_more() -> None:
    switches = Switches()
    drains = Drains(cast(Redirector, switches), lambda: None)
    switches.redirects = {LOADER: DIRECT}
    await drains.begin({LOADER: None, ASKER: DIRECT})
    assert drains.on_link
    await drains.cut(on_link=True)
    assert (switches.cut, drains.on_link) == (1, False)
    await drains.cut(on_link=False)
    assert switches.cut == 2


@pytest.mark.parametrize("refuses", ["at once", "in the end"])
async def test_a_switch_that_the_kernel_refuses(refuses: str, caplog: pytest.LogCaptureFixture) -> None:
    switches, ended = Switches(), asyncio.Event()
    switches.refuses = refuses
    drains = Drains(cast(Redirector, switches), ended.set)
    if refuses == "at once":
        with pytest.raises(NetlinkError):
            await drains.begin({LOADER: DIRECT})
        return
    await drains.begin({LOADER: DIRECT})
    switches.idle.set()
    async with asyncio.timeout(10):
        await ended.wait()
    assert "not drained" in caplog.text


class Kernel:
    """In place of maps, connection tracking and sockets; it keeps which numbers are forgotten."""

    def __init__(self) -> None:
        self.forgotten: list[int] = []

    def write(self, *_: object) -> None:
        return

    def forget(self, number: int) -> None:
        self.forgotten.append(number)

    def to(self, _services: object) -> list[Any]:
        return []

    def cut(self, *_: object) -> int:
        return 0


def test_connections_on_the_cloud_path_outlive_the_plan_for_their_service() -> None:
    kernel = Kernel()
    redirector = Redirector(cast(Maps, kernel), cast(Conntrack, kernel), cast(Namespaces, kernel))
    redirector.serve([LOADER, ASKER])
    redirector.lead({ASKER: DIRECT})
    left = list(kernel.forgotten)
    redirector.serve([])
    assert len(kernel.forgotten) == len(left) + 1, "what was led over the link, and nothing else"
    assert redirector.redirects == {}
