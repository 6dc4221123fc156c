"""Link manager with real devices, netfilter and sockets: traffic, faults and cleanup."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from linked_world import STREAM, VIP, World, check_restored, link_address, linked_world, start_drone, until

pytestmark = [pytest.mark.root, pytest.mark.timeout(300)]


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with linked_world(tmp_path) as world:
        yield world


def test_traffic_moves_to_the_link_and_back_before_the_link_ends(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = start_drone(world, edge)
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    name = "app-d1-e1"
    until(lambda: drone.status(name).get("traffic") == "direct", "direct traffic in the status", world)
    status = drone.status(name)
    assert (status["phase"], status["observedGeneration"], status["switches"]) == ("Up", 1, 1)
    assert status["bandwidth"] > 1.0
    assert drone.condition(name, "TrafficDirect")["status"] == "True"
    until(lambda: edge.condition(name, "PeerReady").get("status") == "True", "the condition of the edge node", world)
    metrics = drone.metrics()
    assert metrics['fractus_link_up{path="e1"}'] == 1
    assert metrics["fractus_switches_total"] == metrics["fractus_traffic_direct"] == 1
    assert metrics['fractus_path_bandwidth_mbps{path="e1"}'] > metrics['fractus_path_bandwidth_mbps{path="cloud"}'] == 1
    assert metrics['fractus_path_quality{path="e1"}'] > 0
    until(
        lambda: drone.metrics().get('fractus_service_sent_mbps{service="10.96.0.5:8080/TCP"}'),
        "the traffic rate",
        world,
    )
    # The drone flies away. Traffic returns to the cloud while the link still works, so that no call is lost.
    drone.fly(70.0, velocity=(3.0, 0.0, 0.0))
    drone.fly(-57.0, velocity=(-3.0, 0.0, 0.0))
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
    assert not client.failed
    until(lambda: drone.status(name).get("traffic") == "cloud", "cloud traffic in the status", world)


def test_link_manager_cleans_up_when_links_are_no_longer_planned(world: World) -> None:
    edge = world.edge("e1", 20.0)
    before = edge.routes()
    drone = start_drone(world, edge)
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    assert drone.addresses() == [f"{link_address('d1')}/16"]
    assert len(edge.redirects()) == 1
    drone.plan()
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
    until(
        lambda: not drone.tables() and not drone.addresses(),
        "the drone to have no tables and addresses of the agent",
        world,
    )
    until(lambda: not edge.redirects(), "the redirects of the edge node to be removed", world)
    edge.plan()
    until(
        lambda: not edge.tables() and not edge.addresses(),
        "the edge node to have no tables and addresses of the agent",
        world,
    )
    assert edge.routes() == before
    assert world.conntrack(drone) == world.conntrack(edge) == 0
    assert not client.failed
    choice, led, back = (
        next(entry for entry in drone.audit(kind) if entry[field] == value)
        for kind, field, value in (("choice", "peer", "e1"), ("traffic", "path", "e1"), ("link", "phase", "none"))
    )
    assert (choice["code"], led["application"], back["peer"]) == ("Connect", "default/app", "e1")
    assert [entry["linked"] for entry in edge.audit("drone")] == [True, False]
    assert [list(entry["services"].values()) for entry in edge.audit("routes")] == [[f"{edge.pod}:{VIP.port}"]]


def test_traffic_returns_to_the_cloud_within_a_second_after_link_loss(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = start_drone(world, edge)
    client = world.client(drone, 100_000, 0.02)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    assert not client.failed, f"the planned switch to the link lost a call: {client.failed}"
    switched = []
    gaps = []
    # The loss is detected after 0.6 s, and the switch takes a millisecond. Measure several losses on a busy machine.
    while len(gaps) < 5 and not (gaps and min(switched) < 1.0 and min(gaps) < 1.0):
        begun = len(client.responses) - 1
        lost_at = time.time()
        world.command(station="d1", off=True)
        until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
        assert not drone.redirects()
        received = client.responses[begun:]
        led = next(number for number, response in enumerate(received) if response[1] == "cloud")
        gaps.append(float(received[led][2]) - max(float(a[2]) for a in received[:led] if a[1] == "e1"))
        # The client does not repeat calls, so the call that was cut fails.
        assert sum(response[1] == "FAILED" for response in received) <= 1
        switched.append(next(at for at in drone.cut_at() if at > lost_at) - lost_at)
        until(lambda: drone.status("app-d1-e1").get("traffic") == "cloud", "cloud traffic in the status", world)
        # Traffic returns to the link when the radio works again.
        world.command(station="d1", off=False)
        until(lambda: client.last_server == "e1", "a reply over the link again", world)
    print("times in seconds from the loss to the switch, and between the last and first reply:", switched, gaps)
    assert min(switched) < 1.0, switched
    assert min(gaps) < 1.0, gaps


def test_killed_agent_leaves_the_cloud_path_and_restarts_cleanly(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = start_drone(world, edge)
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    drone.kill()
    until(lambda: client.last_server == "cloud", "a reply from the cloud without an agent", world)
    until(lambda: not drone.redirects() and not edge.redirects(), "the redirects to expire", world)
    # The new agent restores its links from disk, because the API server may be unreachable.
    (drone.folder / "links.json").unlink()
    drone.start()
    until(lambda: client.last_server == "e1", "a reply over the link again", world)
    assert "restored from disk" in drone.log()
    assert len(drone.redirects()) == 1
    assert drone.addresses() == [f"{link_address('d1')}/16"]


def test_state_of_killed_agents_is_removed_without_planned_links(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = start_drone(world, edge)
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    for agent in (drone, edge):  # the mission ends while no agent is running
        agent.kill()
        agent.plan()
        for stored in (agent.folder / "links").glob("*.json"):
            stored.unlink()
        assert agent.tables()
        agent.start()
    until(lambda: not drone.tables() and not edge.tables(), "both agents to remove their tables", world)
    until(lambda: not drone.addresses() and not edge.addresses(), "both agents to remove their addresses", world)
    assert world.conntrack(drone) == world.conntrack(edge) == 0
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)


def test_instances_are_isolated_without_a_radio(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = world.drone()
    service = world.link(drone, edge)["spec"]["services"][0] | {
        "callers": [{"instance": "client", "address": drone.pod}]
    }
    link = world.link(drone, edge, services=[service])
    world.serve()
    assert drone.reaches(edge.pod, VIP.port), "the drone cannot reach the pod over the cloud path"
    edge.lose_radio()
    edge.plan(link)
    edge.start()
    until(lambda: not drone.reaches(edge.pod, VIP.port), "the agent to block the node's access to the pod", world)
    until(lambda: edge.condition("app-d1-e1", "PeerReady").get("reason") == "DeviceMissing", "DeviceMissing", world)
    edge.regain_radio()
    drone.plan(link)
    drone.start()
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    assert not drone.reaches(edge.pod, VIP.port)


def test_link_is_restored_after_the_edge_agent_is_killed(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = start_drone(world, edge)
    client = world.client(drone, 100_000, 0.05)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    edge.kill()
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
    edge.start()
    until(lambda: client.last_server == "e1", "a reply over the link again", world)


def test_second_drone_waits_for_a_busy_edge_node(world: World) -> None:
    edge = world.edge("e1", 20.0)
    first = world.drone("d1")
    second = world.drone("d2")
    before = world.states()
    links = [world.link(first, edge), world.link(second, edge)]
    world.serve()
    edge.plan(*links)
    edge.start()
    first.plan(links[0])
    first.start()
    clients = [world.client(drone, 100_000, 0.1) for drone in (first, second)]
    until(lambda: clients[0].last_server == "e1", "the first drone's response over the link", world)
    second.plan(links[1])
    second.start()
    until(lambda: second.status("app-d2-e1").get("reason") == "PairingFailed", "the reason PairingFailed", world)
    assert clients[1].last_server == "cloud"
    assert clients[0].last_server == "e1"
    until(lambda: edge.condition("app-d2-e1", "PeerReady").get("reason") == "Busy", "the reason Busy", world)
    first.plan()
    until(lambda: clients[1].last_server == "e1", "the second drone's response over the link", world)
    until(lambda: clients[0].last_server == "cloud", "the first drone's response from the cloud", world)
    assert not [client.failed for client in clients if client.failed]
    check_restored(world, before)


@pytest.mark.parametrize("fault", ["silent", "impostor"])
def test_calls_continue_while_a_peer_does_not_pair(world: World, fault: str) -> None:
    edge = world.edge("e1", 5.0)
    other = world.edge("e2", 30.0)
    if fault == "impostor":
        edge.certify("e2")
    drone = world.drone()
    links = [world.link(drone, edge, bandwidth=13.0), world.link(drone, other)]
    world.serve()
    # The edge node has no ready pod, so no traffic moves to its link before it becomes silent.
    edge.plan(world.link(drone, edge, bandwidth=13.0, services=[]))
    other.plan(links[1])
    edge.start()
    other.start()
    drone.plan(*links)
    drone.start()
    client = world.client(drone, 100_000, 0.1)
    if fault == "silent":  # the edge node stops responding after the drone has received its beacons
        until(lambda: "pairing" in drone.log(), "an attempt to pair", world)
        world.command(station="e1", silent=True)
    until(lambda: client.last_server == "e2", "a response over the link to the working node", world)
    assert "e1" not in {response[1] for response in client.responses}
    assert len(client.failed) <= 1  # the client does not repeat the call that the planned switch may cut


def test_missing_device_is_reported_and_used_when_it_appears(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = world.drone()
    link = world.link(drone, edge)
    world.serve()
    edge.plan(link)
    edge.start()
    drone.plan(link)
    drone.lose_radio()
    drone.start()
    client = world.client(drone, 100_000, 0.1)
    until(
        lambda: drone.condition("app-d1-e1", "Linked").get("reason") == "DeviceMissing",
        "the reason DeviceMissing",
        world,
    )
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
    drone.regain_radio()
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    drone.lose_radio()
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
    drone.regain_radio()
    until(lambda: client.last_server == "e1", "a reply over the link again", world)


def test_unpaired_node_reaches_nothing_over_the_link(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = start_drone(world, edge)
    stranger = world.drone("d9")
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    stranger.join(str(link_address("d9")))
    (route,) = edge.redirects()
    port = int(route.split(" . ")[2])
    assert not stranger.reaches(str(link_address("e1")), port)
    world.python("e1", LISTENER, 10250)
    assert not stranger.reaches(str(link_address("e1")), 10250)
    assert drone.reaches(f"10.90.{edge.number}.1", 10250)  # agents do not block the path over the cloud
    assert client.last_server == "e1"


LISTENER = """
import socket, sys
server = socket.create_server(("0.0.0.0", int(sys.argv[1])))
print("ready", flush=True)
while True:
    server.accept()[0].close()
"""


@pytest.mark.parametrize("changes", [15, pytest.param(100, marks=pytest.mark.slow)])
def test_quick_changes_of_the_radio_end_in_the_last_state(world: World, changes: int) -> None:
    edge = world.edge("e1", 20.0)
    drone = world.drone()
    before = world.states()
    start_drone(world, edge)
    client = world.client(drone, 100_000, 0.05)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    for number in range(changes):
        world.command(station="d1", off=number % 2 == 0)
        time.sleep(0.2 if number % 7 else 1.5)
    world.command(station="d1", off=False)
    until(lambda: client.last_server == "e1", "a reply over the link", world, timeout_s=120)
    assert len(drone.redirects()) == 1
    assert len(edge.redirects()) == 1
    assert drone.addresses() == [f"{link_address('d1')}/16"]
    check_restored(world, before)
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)


@pytest.mark.slow  # the next test also loses the uplink during direct traffic
def test_uplink_loss_does_not_affect_direct_traffic(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = start_drone(world, edge)
    client = world.client(drone, 100_000, 0.05)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    until(lambda: drone.status("app-d1-e1").get("traffic") == "direct", "direct traffic in the status", world)
    drone.uplink(up=False)
    for agent in (drone, edge):
        agent.api(up=False)
    before = len(client.responses)
    until(lambda: len(client.responses) > before + 200, "200 more responses", world)
    assert {response[1] for response in client.responses[before + 1 :]} == {"e1"}
    assert drone.addresses() == [f"{link_address('d1')}/16"]
    drone.uplink(up=True)
    for agent in (drone, edge):
        agent.api(up=True)
    drone.fly(-57.0, velocity=(-3.0, 0.0, 0.0))
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
    until(lambda: drone.status("app-d1-e1").get("traffic") == "cloud", "cloud traffic in the status", world)
    assert not client.failed


def test_traffic_leaves_unreachable_cloud_path_even_if_it_was_better(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = start_drone(world, edge)
    client = world.client(drone, 100_000, 0.05)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    drone.describe(uplink_mbps=900)
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
    drone.uplink(up=False)
    for agent in (drone, edge):
        agent.api(up=False)
    until(
        lambda: client.last_server == "e1",
        "a response over the link, although the cloud path declares more bandwidth",
        world,
    )
    cut = len(client.responses)
    until(lambda: len(client.responses) > cut + 40, "40 more responses", world)
    assert {response[1] for response in client.responses[cut:]} == {"e1"}
    assert drone.addresses() == [f"{link_address('d1')}/16"]
    drone.uplink(up=True)
    for agent in (drone, edge):
        agent.api(up=True)
    until(lambda: client.last_server == "cloud", "a response from the cloud, which has the better path again", world)
    assert "FAILED" not in {response[1] for response in client.responses[cut:]}
    until(lambda: drone.status("app-d1-e1").get("traffic") == "cloud", "cloud traffic in the status", world)


def test_agent_killed_during_a_switch_recovers(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = world.drone()
    before = world.states()
    start_drone(world, edge)
    world.python(
        "d1p", STREAM, f"{VIP.address}:{VIP.port}"
    )  # the stream is never idle, so that a switch takes its maximum time
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.last_server == "e1", "a reply over the link", world)
    drone.fly(-57.0, velocity=(-3.0, 0.0, 0.0))
    until(lambda: not drone.redirects(), "the redirects to be removed", world)
    drone.kill()  # the agent still drains old connections
    drone.fly(0.0)
    drone.start()
    until(lambda: client.last_server == "e1", "a reply over the link again", world)
    assert len(drone.redirects()) == 1
    check_restored(world, before)
    until(lambda: client.last_server == "cloud", "a reply from the cloud", world)
