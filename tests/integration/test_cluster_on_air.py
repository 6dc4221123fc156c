"""Nodes of the embedded cluster on the simulated radio: real namespaces, devices, vehicle and radio, without Kubernetes."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from control_plane import wait_for
from fractus_agent.redirector.netlink import in_namespace
from fractus_cluster import network
from fractus_cluster.addressing import Addressing, choose_block
from fractus_cluster.cgroups import cluster_branch
from fractus_cluster.cluster import Cluster
from fractus_cluster.errors import ClusterError
from fractus_cluster.network import Wiring, networks_in_use
from fractus_cluster.node import Node
from fractus_cluster.processes import read_record
from fractus_cluster.radio import Radio
from fractus_cluster.spec import ClusterSpec, parse_spec
from fractus_cluster.state import ClusterRecord, state_of
from fractus_runtime.mavlink_codec import Endpoint

pytestmark = [pytest.mark.root, pytest.mark.skipif(os.geteuid() != 0, reason="needs root")]

PORT = 7777
NAME = f"cr{os.getpid()}"
WIFI = {"technology": "WiFi", "device": "wlan0", "range": 120}


def spec_of(edge_lat: float) -> ClusterSpec:
    return parse_spec(
        {
            "name": NAME,
            "nodes": [
                {
                    "name": "drone-1",
                    "class": "drone",
                    "hardware": {
                        "vehicle": {"home": {"lat": 50.0, "lon": 4.0, "alt": 25}},
                        "wifi": {"range": 120},
                        "uplink": {"rate": 8, "delay": 60},
                    },
                },
                {
                    "name": "edge-1",
                    "class": "edge",
                    "hardware": {"wifi": {}},
                    "description": {"location": {"lat": edge_lat, "lon": 4.0, "alt": 25}, "interfaces": [WIFI]},
                },
            ],
        },
        source="test",
    )


def _udp() -> socket.socket:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.settimeout(1.0)
    return udp


class Site:
    """A drone and an edge node with network namespaces and a simulated radio."""

    def __init__(self, edge_lat: float) -> None:
        self.spec = spec_of(edge_lat)
        self.state = state_of(NAME)
        self.branch = cluster_branch(NAME)
        self.wiring = Wiring(NAME, Addressing(choose_block(networks_in_use())), self.state.marks)
        self.radio = Radio(NAME, self.state)
        network.wire_control_plane(self.wiring)
        self.wire()
        self._closed = threading.Event()
        self._echoes = list[threading.Thread]()
        for node in (None, "edge-1"):
            self.echo(node)

    def wire(self) -> None:
        self.nodes = [Node(s, i, self.wiring, self.state, self.branch) for i, s in enumerate(self.spec.nodes)]
        for node in self.nodes:
            network.wire_node(self.wiring, node.name, node.index, mobile=node.spec.hardware.uplink is not None)
        self.radio.start(self.nodes, self.spec.air)

    def run(self, node: str, *words: str) -> str:
        command = ["nsenter", f"--net={self.wiring.namespace_path(node)}", *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout

    def address_wifi(self) -> None:
        for number, node in enumerate(("drone-1", "edge-1"), 1):
            self.run(node, "ip", "address", "replace", f"169.254.9.{number}/16", "dev", "wlan0")
            self.run(node, "ip", "link", "set", "wlan0", "up")

    def ping(self, node: str, address: str, count: int = 1) -> list[float]:
        """Return the round-trip times of echoed datagrams, in ms. Lost datagrams are omitted."""
        round_trips_ms = []
        with in_namespace(self.wiring.namespace_path(node), _udp) as client:
            for number in range(count):
                begun = time.monotonic()
                with contextlib.suppress(OSError):
                    client.sendto(b"%d" % number, (address, PORT))
                    while client.recv(100) != b"%d" % number:
                        pass
                    round_trips_ms.append((time.monotonic() - begun) * 1e3)
        return round_trips_ms

    def echo(self, node: str | None) -> None:
        """Echo datagrams in the namespace of a node (None: of the control plane) until the site is closed."""
        server = in_namespace(self.wiring.namespace_path(node), _udp)
        server.bind(("", PORT))

        def serve() -> None:
            with server:
                while not self._closed.is_set():
                    with contextlib.suppress(OSError):
                        data, sender = server.recvfrom(100)
                        server.sendto(data, sender)

        self._echoes.append(threading.Thread(target=serve))
        self._echoes[-1].start()

    def wait_until_reachable(self, node: str, address: str, *, reachable: bool, timeout_s: float = 30.0) -> None:
        """Wait until an address responds to a node, or until it no longer responds."""
        deadline = time.monotonic() + timeout_s
        while bool(self.ping(node, address)) != reachable:
            state = "does not respond" if reachable else "still responds"
            assert time.monotonic() < deadline, f"{address} {state} to {node}"

    def close(self) -> None:
        self._closed.set()
        for thread in self._echoes:
            thread.join()
        self.branch.kill_all()
        self.branch.remove()
        network.unwire(NAME)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Site]:
    monkeypatch.setenv("FRACTUS_STATE", str(tmp_path))
    site = Site(getattr(request, "param", 50.0005))
    yield site
    site.close()


def test_cluster_radio_delays_and_cuts_mobile_uplink(site: Site) -> None:
    hub = str(site.wiring.addressing.control_plane)
    assert min(site.ping("drone-1", hub, 4)) >= 120.0
    assert min(site.ping("edge-1", hub, 8)) < 120.0
    site.nodes[0].cut_link()
    assert network.links_cut(site.wiring) == {0}
    site.wait_until_reachable("drone-1", hub, reachable=False)
    site.wire()
    assert network.links_cut(site.wiring) == set()
    site.wait_until_reachable("drone-1", hub, reachable=True)
    site.radio.command(uplink="drone-1", off=True)
    site.wait_until_reachable("drone-1", hub, reachable=False)
    site.radio.command(uplink="drone-1", off=False)
    site.wait_until_reachable("drone-1", hub, reachable=True)


def test_cluster_radio_connects_nodes_in_range_until_fault(site: Site) -> None:
    site.address_wifi()
    site.wait_until_reachable("drone-1", "169.254.9.2", reachable=True)
    for fault, repair in (({"silent": True}, {"silent": False}), ({"loss_db": 90}, {"loss_db": 0})):
        site.radio.command(station="edge-1", **fault)
        site.wait_until_reachable("drone-1", "169.254.9.2", reachable=False)
        site.radio.command(station="edge-1", **repair)
        site.wait_until_reachable("drone-1", "169.254.9.2", reachable=True)


@pytest.mark.parametrize("site", [50.002], indirect=True)
def test_cluster_radio_uses_position_of_vehicle(site: Site) -> None:
    """The edge node is 222 m from home, out of range. Then the vehicle starts at another home, next to the edge node."""
    site.address_wifi()
    assert not site.ping("drone-1", "169.254.9.2", 2)
    moved = site.spec.model_dump(by_alias=True)
    moved["nodes"][0]["hardware"]["vehicle"]["home"] = {"lat": 50.0019, "lon": 4.0, "alt": 25}
    moved_spec = parse_spec(moved, source="test")
    Node(moved_spec.nodes[0], 0, site.wiring, site.state, site.branch).start_hardware()
    site.wait_until_reachable("drone-1", "169.254.9.2", reachable=True, timeout_s=60.0)


def test_cluster_radio_is_replaced_after_its_process_was_killed(site: Site) -> None:
    hub = str(site.wiring.addressing.control_plane)
    record = read_record(site.state.process("radio"))
    assert record is not None
    site.wire()
    assert read_record(site.state.process("radio")) == record
    os.kill(record.pid, signal.SIGKILL)
    deadline = time.monotonic() + 20
    while site.radio.running:
        assert time.monotonic() < deadline
        threading.Event().wait(0.05)
    assert not site.ping("drone-1", hub)
    with pytest.raises(ClusterError, match="radio is not running"):
        site.radio.command(uplink="drone-1", off=True)
    site.wire()
    site.wait_until_reachable("drone-1", hub, reachable=True)
    assert "default via" in site.run("drone-1", "ip", "route")


def _with_arguments(spec: ClusterSpec, *arguments: str) -> ClusterSpec:
    content = spec.model_dump(by_alias=True)
    content["nodes"][0]["hardware"]["vehicle"]["arguments"] = ["--ready-after", "2", *arguments]
    return parse_spec(content, source="test")


def _arm(node: Node) -> None:
    """Arm the vehicle of a node without its arming checks."""
    path = node.wiring.namespace_path(node.name)
    link = Endpoint(255, 190)
    with in_namespace(path, lambda: socket.create_connection(("127.0.0.1", 5760), 10.0)) as connection:
        arm = {"target_system": 1, "target_component": 1, "command": 400, "param1": 1.0, "param2": 21196.0}
        armed = False
        while not armed:  # a vehicle that is still starting refuses
            connection.sendall(link.encode("COMMAND_LONG", arm))
            messages = link.decode(connection.recv(9999))
            armed = any(m.name == "HEARTBEAT" and m.integer("base_mode") & 128 for m in messages)


def test_cluster_charges_a_disarmed_vehicle_and_restarts_it_only_when_its_arguments_changed(site: Site) -> None:
    site.spec = _with_arguments(site.spec)
    site.state.write_spec(site.spec)
    site.state.write_record(ClusterRecord(site.wiring.addressing.block, {"drone-1": 0, "edge-1": 1}))
    cluster = Cluster(site.spec)
    drone = cluster.node("drone-1")
    drone.start_hardware()
    wait_for(lambda: _charged(cluster), "a charged battery", timeout_s=20.0)
    assert drone.changed_hardware() == {}
    changed = Cluster(_with_arguments(site.spec, "--wind", "5,270"))
    assert changed.node("drone-1").changed_hardware()["vehicle"].endswith("--ready-after 2 --wind 5,270")
    assert changed.check_vehicles() == {"drone-1", "edge-1"}
    _arm(drone)
    with pytest.raises(ClusterError, match=r"drone-1.* changed in the cluster file, and it is armed; wait until"):
        changed.check_vehicles()
    with pytest.raises(ClusterError, match="drone-1 is armed; wait until it has landed"):
        cluster.charge("drone-1")
    with pytest.raises(ClusterError, match="edge-1 has no simulated vehicle"):
        cluster.charge("edge-1")


def _charged(cluster: Cluster) -> bool:
    """Charge the drone, and return False while its vehicle does not accept connections yet."""
    try:
        cluster.charge("drone-1")
    except ClusterError:
        return False
    return True
