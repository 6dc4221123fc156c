"""Redirector with real namespaces, netfilter and sockets, and with gRPC clients that do not repeat calls."""

from __future__ import annotations

import asyncio
import itertools
import subprocess
import sys
import time
from collections.abc import Iterator
from ipaddress import IPv4Address
from pathlib import Path

import pytest
from control_plane import wait_for
from fractus_agent.links.device_addresses import DeviceAddresses
from fractus_agent.redirector import redirector as module
from fractus_agent.redirector.connections import Conntrack, PodNamespaces
from fractus_agent.redirector.netlink import in_namespace
from fractus_agent.redirector.redirector import Redirector
from redirect_rig import DIRECT, DRONE, POD, VIP, Rig, rig, run

pytestmark = pytest.mark.root

TO_EDGE = {VIP: DIRECT}
TO_CLOUD = {VIP: None}


@pytest.fixture
def world() -> Iterator[Rig]:
    with rig() as world:
        yield world


@pytest.fixture
def redirector(world: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Redirector]:
    """The redirector of the drone, with access to the namespaces of the drone and its pod."""
    monkeypatch.setattr(module, "LEASE_S", 60.0)  # longer than the start of a client on a busy machine
    conntrack = Conntrack(world.netlink("drone"))
    (tmp_path / "pod").symlink_to(world.path("dpod"))
    redirector = Redirector(world.maps("drone"), conntrack, PodNamespaces(tmp_path, node_namespace=world.path("drone")))
    redirector.set_services([VIP])
    yield redirector
    redirector.close()


def responses(client: subprocess.Popen[str], count: int | None = None) -> list[list[str]]:
    """Return the words of the next `count` responses to a client, or of all remaining responses if `count` is None."""
    assert client.stdout is not None
    return [line.split() for line in itertools.islice(client.stdout, count)]


def call_once(world: Rig, node: str = "dpod") -> str:
    """Return the name of the server that answers one call of a new client."""
    return responses(world.client(1, node=node))[0][1]


@pytest.mark.parametrize("node", ["dpod", "drone"], ids=["pod", "host network"])
async def test_new_connections_follow_the_map(world: Rig, redirector: Redirector, node: str) -> None:
    world.servers()
    assert call_once(world, node) == "cloud"
    await redirector.switch(TO_EDGE, planned=True)
    assert call_once(world, node) == "edge"
    await redirector.switch(TO_CLOUD, planned=True)
    assert call_once(world, node) == "cloud"


@pytest.mark.parametrize(("size", "work_s"), [(10, 0.03), (200_000, 0.0)])
async def test_planned_switches_lose_no_call_of_a_client_that_pauses_between_calls(
    world: Rig, redirector: Redirector, size: int, work_s: float
) -> None:
    world.servers(work_s)
    refresh = asyncio.create_task(redirector.run())
    client = world.client(100_000, 0.2, size)
    redirector._drain_s = 0.5
    drained = 0
    cut = 0
    for number in range(8):
        await asyncio.sleep(0.5)
        result = await redirector.switch(TO_CLOUD if number % 2 else TO_EDGE, planned=True)
        drained += result.drained
        cut += result.cut
    await asyncio.sleep(1.0)
    client.terminate()
    received = [response for response in await asyncio.to_thread(responses, client) if len(response) >= 3]
    refresh.cancel()
    assert [int(response[0]) for response in received] == list(range(len(received)))
    assert not [response for response in received if response[1] == "FAILED"]
    switches = sum(a[1] != b[1] for a, b in itertools.pairwise(received))
    assert switches >= 6
    assert drained >= 6
    assert cut == 0


LOADER = """
import sys, time
import grpc
channel = grpc.insecure_channel(sys.argv[1])
ask, load = channel.unary_unary("/test/Ask"), channel.unary_stream("/test/Send")
for number in range(5):  # short replies
    ask(f"{number:08d}".encode(), timeout=5)
print("ready", flush=True)
received = 0
try:
    for message in load(sys.argv[2].encode(), timeout=240):
        received += len(message)
    print("received", received, flush=True)
except grpc.RpcError as error:
    print("FAILED", received, error.code().name, error.details().replace(" ", "_"), flush=True)
server = ""
while server != "edge":  # until the end of the drain
    time.sleep(1)
    server = ask(b"0", timeout=5).decode().split()[0]
print("then", server, flush=True)
"""


async def test_long_reply_on_a_slow_path_finishes_within_the_drain(world: Rig, redirector: Redirector) -> None:
    redirector._drain_s = 10.0
    world.servers()
    # 12 MB at 24 Mbit/s, with a queue so short that segments are lost and retransmitted.
    slow = ("rate", "24mbit", "burst", "6kb", "limit", "30kb")
    run(*world.inside("cloud"), "tc", "qdisc", "add", "dev", "eth0", "root", "tbf", *slow)
    refresh = asyncio.create_task(redirector.run())
    loader = world.python("dpod", LOADER, f"{VIP.address}:{VIP.port}", 12_000_000)
    await asyncio.sleep(1.0)
    result = await redirector.switch(TO_EDGE, planned=True)
    assert await asyncio.to_thread(responses, loader) == [["received", "12000000"], ["then", "edge"]]
    refresh.cancel()
    assert (result.drained, result.cut) == (1, 0)


async def test_abrupt_switch_moves_traffic_to_the_cloud_path_at_once(world: Rig, redirector: Redirector) -> None:
    world.servers()
    await redirector.switch(TO_EDGE, planned=True)
    client = world.client(200)
    await asyncio.to_thread(responses, client, 20)
    run(*world.inside("edge"), "ip", "link", "set", "fxl0", "down")
    lost_at = time.monotonic()
    await asyncio.sleep(0.4)  # until the loss of the link is detected
    result = await redirector.switch(TO_CLOUD, planned=False)
    assert result.cut == 1
    received = await asyncio.to_thread(responses, client)
    cloud_at = next(float(response[2]) for response in received if response[1] == "cloud")
    assert cloud_at - lost_at < 1.0
    assert sum(response[1] == "FAILED" for response in received) <= 1
    assert received[-1][1] == "cloud"


@pytest.mark.parametrize(("drain_s", "reply"), [(3.0, "cloud"), (0.5, "FAILED")])
# `make test` has clients that completed calls before a switch in
# test_planned_switches_lose_no_call_of_a_client_that_pauses_between_calls.
@pytest.mark.parametrize("before", [0, pytest.param(1, marks=pytest.mark.slow)])
async def test_call_is_cut_only_if_it_takes_longer_than_the_drain(
    world: Rig, redirector: Redirector, drain_s: float, reply: str, before: int
) -> None:
    redirector._drain_s = drain_s
    world.servers(work_s=3.0)
    refresh = asyncio.create_task(redirector.run())
    client = world.client(before + 2, pause_s=5.0)
    received = await asyncio.to_thread(responses, client, before)
    await asyncio.sleep(3.0 if before else 1.0)  # the next call is in progress, for about one second
    result = await redirector.switch(TO_EDGE, planned=True)
    received += await asyncio.to_thread(responses, client)
    refresh.cancel()
    assert [response[1] for response in received] == ["cloud"] * before + [reply, "edge"]
    assert result.drained + result.cut == 1


async def test_redirects_end_without_an_agent(
    world: Rig, redirector: Redirector, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LEASE_S", 1.0)
    monkeypatch.setattr(module, "REFRESH_S", 0.3)
    world.servers()
    await redirector.switch(TO_EDGE, planned=True)
    refresh = asyncio.create_task(redirector.run())
    await asyncio.sleep(2.0)
    assert await asyncio.to_thread(call_once, world) == "edge"
    refresh.cancel()
    await asyncio.gather(refresh, return_exceptions=True)
    assert await asyncio.to_thread(call_once, world) == "cloud"
    # A killed agent leaves map elements, which expire.
    await redirector.switch(TO_EDGE, planned=True)
    await asyncio.sleep(1.5)
    assert await asyncio.to_thread(call_once, world) == "cloud"


async def test_a_hundred_switches_end_in_the_last_state(world: Rig, redirector: Redirector) -> None:
    world.servers()
    client = world.client(100)
    for number in range(100):
        await redirector.switch(TO_CLOUD if number % 2 else TO_EDGE, planned=bool(number % 3))
    assert redirector.redirects == {}
    await asyncio.to_thread(responses, client)  # the client may have ended before the last switch
    assert await asyncio.to_thread(call_once, world) == "cloud"


async def test_redirect_ends_when_its_service_is_removed(world: Rig, redirector: Redirector) -> None:
    await redirector.switch(TO_EDGE, planned=True)
    redirector.set_services([VIP, DIRECT])
    assert redirector.redirects == TO_EDGE
    redirector.set_services([DIRECT])
    assert redirector.redirects == {}


async def test_connection_opened_during_a_drain_survives_it(world: Rig, redirector: Redirector) -> None:
    redirector._drain_s = 5.0
    world.servers(work_s=3.0)
    busy = world.client(20, pause_s=0.01)
    await asyncio.to_thread(responses, busy, 1)
    switch = asyncio.create_task(redirector.switch(TO_EDGE, planned=True))
    await asyncio.sleep(0.2)
    fresh = world.client(1)  # its call is in progress when the old path is cleaned up
    result = await switch
    busy.kill()
    assert result.drained + result.cut >= 1
    assert [response[1] for response in await asyncio.to_thread(responses, fresh)] == ["edge"]


async def test_cancelled_drain_cuts_the_connections_on_the_old_path(world: Rig, redirector: Redirector) -> None:
    world.servers(work_s=2.0)
    client = world.client(2, pause_s=0.01)
    await asyncio.sleep(1.5)  # the call of the client is in progress
    switch = asyncio.create_task(redirector.switch(TO_EDGE, planned=True))
    await asyncio.sleep(0.1)
    switch.cancel()
    await asyncio.gather(switch, return_exceptions=True)
    assert redirector.redirects == TO_EDGE
    assert (await asyncio.to_thread(responses, client))[-1][1] == "edge"


async def test_abrupt_switch_does_not_wait_for_a_drain_or_cut_the_other_path(
    world: Rig, redirector: Redirector
) -> None:
    redirector._drain_s = 10.0
    world.servers(work_s=3.0)
    client = world.client(1)
    await asyncio.sleep(1.5)
    drain = asyncio.create_task(redirector.switch(TO_EDGE, planned=True))
    await asyncio.sleep(0.05)
    begun = time.monotonic()
    lost = await redirector.switch(TO_CLOUD, planned=False)
    assert time.monotonic() - begun < 5.0, "the abrupt switch waited for the drain"
    assert redirector.redirects == {}
    assert lost.cut == 0, "a connection on the working cloud path was closed"
    assert [response[1] for response in await asyncio.to_thread(responses, client)] == ["cloud"]
    await drain


async def test_flushed_table_is_created_again(world: Rig, redirector: Redirector) -> None:
    world.servers()
    await redirector.switch(TO_EDGE, planned=True)
    run(*world.inside("drone"), "nft", "flush", "ruleset")
    assert await asyncio.to_thread(call_once, world) == "cloud"
    refresh = asyncio.create_task(redirector.run())
    await asyncio.sleep(2 * module.REFRESH_S)
    assert await asyncio.to_thread(call_once, world) == "edge"
    run(*world.inside("drone"), "nft", "flush", "ruleset")
    await redirector.switch(TO_CLOUD, planned=True)
    assert await asyncio.to_thread(call_once, world) == "cloud"
    refresh.cancel()


def test_transaction_without_permission_is_refused() -> None:
    program = """
from fractus_agent.redirector.netlink import NETLINK_NETFILTER, Netlink
from fractus_agent.redirector.nft_maps import NftMaps
NftMaps(Netlink(NETLINK_NETFILTER), lambda _: None).write([], None, 5.0)
"""
    result = subprocess.run(
        ["setpriv", "--inh-caps=-net_admin", "--bounding-set=-net_admin", sys.executable, "-c", program],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert "refused a batch: Operation not permitted" in result.stderr


def test_only_allowed_callers_are_redirected(world: Rig, redirector: Redirector) -> None:
    world.servers()
    other = world.pod("other", "10.86.0")
    redirector.set_services([VIP], {VIP: frozenset({IPv4Address("10.87.0.2")})})
    redirector.set_targets(TO_EDGE)
    assert call_once(world) == "edge"
    assert call_once(world, other) == "cloud"
    assert call_once(world, "drone") == "cloud"
    # Allow the other pod, and clients in the node's host network: they use the node's address on the uplink.
    redirector.set_services([VIP], {VIP: frozenset(map(IPv4Address, ("10.86.0.2", "10.90.0.1")))})
    assert call_once(world, other) == "edge"
    assert call_once(world, "drone") == "edge"
    assert call_once(world) == "cloud"
    # When the removed table is created again, it contains the allowed callers from the beginning.
    run(*world.inside("drone"), "nft", "flush", "ruleset")
    redirector.set_peers([])  # writes the whole table except the callers
    assert call_once(world) == "cloud"
    assert call_once(world, other) == "edge"


def test_new_table_contains_its_guards_from_the_beginning(world: Rig) -> None:
    """Close the netlink socket, so that nothing can be written after the table is created."""
    maps = world.maps("edge")
    maps.write([], None, 5.0, callers={POD: frozenset({DRONE})})
    world.sockets[-1].close()
    maps.recreate_table()
    for name, element in (("guarded", "10.88.0.2 . tcp . 8080"), ("callers", "10.77.0.1 . 10.88.0.2 . tcp . 8080")):
        words = [*world.inside("edge"), "nft", "list", "set", "ip", "fractus", name]
        assert element in subprocess.run(words, capture_output=True, text=True, check=True).stdout


KUBE_PROXY = {
    "nftables": [["nft", "table ip kube-proxy { chain pre { type nat hook prerouting priority -100; "
                  "ip daddr 10.96.0.9 tcp dport 8080 dnat to 10.88.0.2:8080; }; }"]],
    "iptables": [["iptables", "-t", "nat", "-A", "PREROUTING", "-d", "10.96.0.9", "-p", "tcp", "--dport", "8080",
                  "-j", "DNAT", "--to-destination", "10.88.0.2:8080"]],
}  # fmt: skip


@pytest.mark.parametrize("mode", KUBE_PROXY)
def test_guarded_pod_accepts_only_calls_over_links(world: Rig, redirector: Redirector, mode: str) -> None:
    world.servers()
    for words in KUBE_PROXY[mode]:
        run(*world.inside("edge"), *words)
    other_pod = world.pod("other", "10.86.0", at="edge")

    def reached(address: str, node: str = other_pod) -> bool:
        return world.reaches(node, address, POD.port)

    # The first packets wait until the link of the new pod is up.
    wait_for(lambda: reached(str(POD.address)), "the pod to be reachable")
    assert reached("10.96.0.9")
    edge = Redirector(world.maps("edge"), Conntrack(world.netlink("edge")), PodNamespaces(None))
    edge.set_services([], {POD: frozenset()})
    assert not reached(str(POD.address))
    assert not reached("10.96.0.9")
    assert reached(str(POD.address), "edge"), "the node cannot reach the pod, as kubelet does for probes"
    # While a drone is linked, only its calls are redirected to the pod.
    edge.set_services([DIRECT], {POD: frozenset()})
    edge.set_peers([DRONE])
    edge.set_targets({DIRECT: POD})
    redirector.set_targets(TO_EDGE)
    assert call_once(world) == "edge"
    assert not reached(str(POD.address))
    # After the drone has left, no call reaches the pod.
    edge.set_services([], {POD: frozenset()})
    redirector.set_services([])
    assert call_once(world) == "cloud"
    assert not reached(str(POD.address))


@pytest.mark.parametrize("owner_alias", ["", "to the north", "x" * 255])
def test_next_agent_takes_down_device_that_a_killed_agent_brought_up(world: Rig, owner_alias: str) -> None:
    def link_state() -> str:
        result = subprocess.run(
            [*world.inside("drone"), "ip", "link", "show", "dev", "fxl0"], capture_output=True, text=True, check=True
        )
        return result.stdout

    address = IPv4Address("169.254.7.7")
    run(*world.inside("drone"), "ip", "link", "set", "fxl0", "alias", owner_alias)
    for was_up in (False, True):
        run(*world.inside("drone"), "ip", "link", "set", "fxl0", "up" if was_up else "down")
        for agent in range(2):  # the first agent is killed
            in_namespace(world.path("drone"), lambda: asyncio.run(DeviceAddresses("fxl0").set(address)))
            assert "UP" in link_state(), agent
            assert owner_alias in link_state()
        in_namespace(world.path("drone"), lambda: asyncio.run(DeviceAddresses("fxl0").clear()))
        # The agent adds a suffix to the alias of devices that it brought up. Without room for it, they stay up.
        assert ("state UP" in link_state()) is (was_up or len(owner_alias) == 255)
        alias = link_state().partition("alias ")[2].strip()
        assert alias == owner_alias


async def test_bytes_of_a_service_on_the_link_are_counted(world: Rig, redirector: Redirector) -> None:
    world.servers()
    assert call_once(world) == "cloud"
    assert redirector.byte_counts() == {}
    await redirector.switch(TO_EDGE, planned=True)
    client = world.client(3, size=100_000)
    await asyncio.to_thread(responses, client)
    sent, received = redirector.byte_counts()[VIP]
    assert 300_000 < sent < 400_000
    assert 100 < received < 100_000
    run(*world.inside("drone"), "nft", "flush", "ruleset")
    assert redirector.byte_counts() == {}
