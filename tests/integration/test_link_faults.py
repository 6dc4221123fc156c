"""Direct links after a power loss, with faulty peers, and with an impostor at the address of the peer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from linked_world import (
    FOREIGN,
    STREAM,
    VIP,
    Client,
    World,
    check_restored,
    link_address,
    linked_world,
    start_drone,
    until,
)
from redirect_rig import SERVER

pytestmark = [pytest.mark.root, pytest.mark.timeout(300)]


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with linked_world(tmp_path) as world:
        yield world


# A node whose operating system has restored half of the state needs more than a node without state.
@pytest.mark.parametrize("restored", [pytest.param("nothing", marks=pytest.mark.slow), "half"])
def test_nodes_recover_after_power_loss_during_a_link(world: World, restored: str) -> None:
    edge = world.edge("e1", 20.0)
    drone = world.drone()
    before = world.states()
    start_drone(world, edge)
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.last_server == "e1", "a response over the link", world)
    for agent in (drone, edge):
        rules = agent.run("nft", "list", "ruleset")
        agent.lose_power()
        # The agent restarts while the API server is unreachable, so it has only its stored files.
        (agent.folder / "links.json").unlink()
        if restored == "nothing":
            agent.run("nft", "-f", "-", text=FOREIGN)
            continue
        # Some operating systems restore saved nftables rules, and bring the device up with another address.
        agent.run("nft", "-f", "-", text=rules)
        agent.run("ip", "address", "add", "169.254.9.9/16", "dev", "wlan0")
        agent.run("ip", "link", "set", "wlan0", "up")
        (agent.pods / "ended").symlink_to("/run/netns/no-such-pod")
    world.serve_at(edge)
    client = world.client(drone, 100_000, 0.1)
    for agent in (edge, drone):
        agent.start()
    until(lambda: client.last_server == "e1", "a response over the link again", world)
    if restored == "nothing":
        assert not client.failed
    assert "restored from disk" in drone.log()
    assert len(drone.redirects()) == len(edge.redirects()) == 1
    for agent in (drone, edge):
        assert agent.addresses() == [f"{link_address(agent.name)}/16"]
    if restored == "half":  # a device that was up before the agent stays up, without addresses
        for agent in (drone, edge):
            agent.plan()
            until(lambda agent=agent: not agent.tables(), "the tables of the agent to be removed", world)
            agent.run("ip", "link", "set", "wlan0", "down")
    check_restored(world, before)


BAD_PEER = """
import asyncio, sys
from ipaddress import IPv4Address
from pathlib import Path
from fractus_agent.links import pairing
from fractus_agent.links.acceptor import Acceptor
from fractus_agent.links.beacons import Beacons
node, address, files, fault = sys.argv[1:]
async def nothing(*_):
    await asyncio.Event().wait()
if fault == "silent":
    pairing.Session.run = nothing
async def linked(session):
    print("paired", flush=True)
    if fault == "no probes":
        session.send = lambda message, send=session.send: nothing() if "arrived" in message else send(message)
        await session.send({"routes": {"10.96.0.5:8080/TCP": 30000}})
    await nothing()
async def main():
    print("ready", flush=True)
    acceptor = Acceptor(Path(files), lambda _: "", linked)
    await asyncio.gather(acceptor.run(IPv4Address(address)), Beacons(node, lambda _: None).run("wlan0"))
asyncio.run(main())
"""


@pytest.mark.parametrize(
    "fault",
    # The component tests contain the other faults (test_link_controllers.py).
    ["no probes", *(pytest.param(fault, marks=pytest.mark.slow) for fault in ("silent", "no routes"))],
)
def test_drone_leaves_peer_that_stops_after_pairing(world: World, fault: str) -> None:
    bad = world.edge("e1", 5.0)
    other = world.edge("e2", 30.0)
    drone = world.drone()
    before = {name: state for name, state in world.states().items() if name != "e1"}
    # The faulty edge node declares more bandwidth, so the drone tries it first.
    links = [world.link(drone, bad, bandwidth=13.0), world.link(drone, other)]
    world.serve()
    client = world.client(drone, 100_000, 0.1)
    bad.join(str(link_address("e1")))
    bad.run("ip", "route", "add", "255.255.255.255", "dev", "wlan0")
    peer = Client(world.python("e1", BAD_PEER, "e1", link_address("e1"), bad.folder / "tls", fault))
    drone.plan(*links)
    drone.start()
    until(lambda: ["paired"] in peer.responses, "the faulty edge node to pair", world)
    other.plan(links[1])
    other.start()
    until(lambda: client.last_server == "e2", "a response over the link to the working node", world)
    assert "e1" not in {response[1] for response in client.responses}
    assert not client.failed
    check_restored(world, before)


STRANGER = """
import socket, struct, sys, time
device, address, hardware = sys.argv[1:]
raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
raw.bind((device, 0))
own, ip = bytes.fromhex(hardware), socket.inet_aton(address)
frame = b"\\xff" * 6 + own + struct.pack(">HHHBBH", 0x0806, 1, 0x0800, 6, 4, 2) + own + ip + b"\\xff" * 6 + ip
print("ready", flush=True)
while True:  # announce the address of the peer by ARP
    raw.send(frame)
    time.sleep(0.05)
"""


def test_node_with_the_address_of_the_peer_gets_no_traffic(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = world.drone()
    stranger = world.edge("e9", 5.0)
    before = {name: state for name, state in world.states().items() if name != "e9"}
    start_drone(world, edge)
    client = world.client(drone, 100_000, 0.05)
    until(lambda: client.last_server == "e1", "a response over the link", world)
    address = str(link_address("e1"))
    port = int(next(iter(edge.redirects())).split(" . ")[2])
    # The stranger serves calls on the address and port of the edge node, and pairs with its own certificate.
    stranger.join(address)
    stranger.plan(world.link(drone, edge))
    world.python("e9", SERVER, "stranger", f"{address}:{port}", 0.005)
    paired = Client(world.python("e9", BAD_PEER, "e1", address, stranger.folder / "tls", "no routes"))
    world.python("e9", STRANGER, "wlan0", address, stranger.hardware.hex())
    until(lambda: drone.log().count("does not have its certificate") > 3, "refused certificates in the log", world)
    until(lambda: client.last_server == "cloud", "a response from the cloud", world)
    led = len(client.responses)
    until(lambda: len(client.responses) > led + 60, "60 more responses", world)
    assert "stranger" not in {response[1] for response in client.responses[led:]}
    assert not paired.responses
    # When the stranger is gone, traffic returns to the edge node, although the drone's ARP table names the stranger.
    world.end("e9")
    stranger.run("ip", "link", "set", "wlan0", "down")
    took_s = until(lambda: client.last_server == "e1", "a response over the link", world, timeout_s=20.0)
    print("time from the end of the stranger to the first response over the link:", took_s)
    check_restored(world, before)


# `make test` shows planned switches with test_call_is_cut_only_if_it_takes_longer_than_the_drain.
@pytest.mark.parametrize("loss", [pytest.param("planned", marks=pytest.mark.slow), "abrupt"])
def test_long_stream_is_reopened_without_lost_or_repeated_replies(world: World, loss: str) -> None:
    edge = world.edge("e1", 20.0)
    drone = world.drone()
    before = world.states()
    start_drone(world, edge)
    stream = Client(world.python("d1p", STREAM, f"{VIP.address}:{VIP.port}"))
    until(lambda: stream.last_server == "e1", "a response over the link", world)
    for _ in range(2):
        if loss == "planned":
            drone.fly(-57.0, velocity=(-3.0, 0.0, 0.0))
        else:
            world.command(station="d1", off=True)
        until(lambda: stream.last_server == "cloud", "a response from the cloud", world)
        drone.fly(0.0)
        world.command(station="d1", off=False)
        until(lambda: stream.last_server == "e1", "a response over the link again", world)
    numbers = [int(response[0]) for response in stream.responses if response[1] in {"cloud", "e1"}]
    assert numbers == list(range(len(numbers)))
    ends = [response[2] for response in stream.responses if response[1] == "REOPENED"]
    assert ends
    assert set(ends) <= {"UNAVAILABLE"}, "streams ended with a status after which gRPC clients do not retry"
    check_restored(world, before)
