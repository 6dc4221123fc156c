"""Direct links of agents on real devices, netfilter and sockets: what traffic does, and what is left afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from connected_world import Agent, World, connected_world, link_address, until

pytestmark = [pytest.mark.root, pytest.mark.timeout(300)]


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with connected_world(tmp_path) as found:
        yield found


def flying(world: World, *edges: Agent) -> Agent:
    """A drone that has a link to each edge node, with everything running."""
    drone = world.drone()
    links = [world.link(drone, edge) for edge in edges]
    world.serve()
    for edge, link in zip(edges, links, strict=True):
        edge.plan(link)
        edge.start()
    drone.plan(*links)
    drone.start()
    return drone


def test_traffic_takes_the_link_and_comes_back_before_it_ends(world: World) -> None:
    edge = world.edge("e1", 20.0)
    drone = flying(world, edge)
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.by == "e1", "an answer over the link", world)
    name = "app-d1-e1"
    until(lambda: drone.status(name).get("traffic") == "direct", "the status", world)
    status = drone.status(name)
    assert (status["phase"], status["observedGeneration"], status["switches"]) == ("Up", 1, 1)
    assert status["bandwidth"] > 1.0
    assert drone.condition(name, "TrafficDirect")["status"] == "True"
    until(lambda: edge.condition(name, "PeerReady").get("status") == "True", "the peer's word", world)
    # The drone flies away: traffic is led back while the link still works, so that no call is lost.
    drone.fly(70.0, velocity=(3.0, 0.0, 0.0))
    drone.fly(-57.0, velocity=(-3.0, 0.0, 0.0))
    until(lambda: client.by == "cloud", "an answer of the cloud", world)
    assert not client.failed
    until(lambda: drone.status(name).get("traffic") == "cloud", "the status", world)


def test_nothing_is_left_when_links_are_planned_no_more(world: World) -> None:
    edge = world.edge("e1", 20.0)
    before = edge.routes()
    drone = flying(world, edge)
    client = world.client(drone, 100_000, 0.1)
    until(lambda: client.by == "e1", "an answer over the link", world)
    assert drone.addresses() == [f"{link_address('d1')}/16"]
    assert len(edge.redirects()) == 1
    drone.plan()
    until(lambda: client.by == "cloud", "an answer of the cloud", world)
    until(lambda: not drone.tables() and not drone.addresses(), "a clean drone", world)
    until(lambda: not edge.redirects(), "no redirect on the edge", world)
    edge.plan()
    until(lambda: not edge.tables() and not edge.addresses(), "a clean edge node", world)
    assert edge.routes() == before
    assert world.conntrack(drone) == world.conntrack(edge) == 0
    assert not client.failed
