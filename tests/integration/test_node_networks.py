"""Simulated networks of experiments: real IP traffic between namespaces, with range, loss, delay and rate."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fractus_agent.redirector.netlink import in_namespace
from fractus_sim.experiment import parse
from fractus_sim.testbeds.local_processes import Processes
from fractus_sim.testbeds.node_networks import NodeNetworks

pytestmark = pytest.mark.root

HOME = {"lat": 50.8637, "lon": 4.6785, "alt": 25}
PORT = 7000
ETH_P_ALL = 3
PACKET_OUTGOING = 4


class Rig:
    """Networks between a drone, an edge node 60 m north of it, an edge node 400 m north of it, and the cloud."""

    def __init__(self, folder: Path, networks: list[dict[str, Any]]) -> None:
        (folder / "logs").mkdir()
        self.processes = Processes(folder / "logs")
        experiment = parse(
            {
                "name": "rig", "mode": "standalone", "manifests": ["."], "networks": networks,
                "vehicles": [{"name": "drone-1", "home": HOME}],
                "nodes": [
                    {"name": "edge-1", "place": {**HOME, "lat": 50.86424}},
                    {"name": "edge-2", "place": {**HOME, "lat": 50.8673}},
                    {"name": "cloud"},
                ],
            }
        )  # fmt: skip
        self.networks = NodeNetworks(experiment, self.processes, folder)

    def start(self) -> None:
        self.networks.set_up()
        self.networks.start({})

    def namespace(self, node: str) -> Path:
        return Path(f"/proc/{self.processes.pid(f'{node}-namespace')}/ns/net")

    def udp(self, node: str) -> socket.socket:
        def create() -> socket.socket:
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.bind(("", PORT))
            sock.settimeout(2.0)
            return sock

        return in_namespace(self.namespace(node), create)

    def _resolve(self, sending: socket.socket, receiving: socket.socket, address: str) -> None:
        """Send datagrams until one arrives, so that the sender knows the MAC address, or for 3 s."""
        end_s = time.monotonic() + 3.0
        receiving.settimeout(0.3)
        while time.monotonic() < end_s:
            sending.sendto(b"first", (address, PORT))
            try:
                receiving.recv(100)
            except TimeoutError:
                continue
            break
        receiving.settimeout(1.0)

    def received(self, sender: str, receiver: str, count: int, size: int = 100, gap_s: float = 0.002) -> list[float]:
        """Send datagrams, and return the time of each arrival after the first datagram was sent."""
        address = self.networks.address(sender, receiver)
        assert address is not None
        with self.udp(sender) as sending, self.udp(receiver) as receiving:
            self._resolve(sending, receiving, address)
            arrivals: list[float] = []

            def receive() -> None:
                try:
                    while True:
                        if receiving.recv(2000) != b"first":
                            arrivals.append(time.monotonic())
                except TimeoutError:
                    return

            thread = threading.Thread(target=receive)
            thread.start()
            begun_s = time.monotonic()
            for _ in range(count):
                sending.sendto(b"x" * size, (address, PORT))
                time.sleep(gap_s)
            thread.join()
            return [arrival - begun_s for arrival in arrivals]


@pytest.fixture
def rig(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Rig]:
    rig = Rig(tmp_path, request.param)
    try:
        rig.start()
        yield rig
    finally:
        rig.processes.stop_all()


EVERYBODY = ["drone-1", "edge-1", "edge-2", "cloud"]


@pytest.mark.parametrize("rig", [[{"name": "wifi", "participants": EVERYBODY, "range": 100}]], indirect=True)
def test_network_reaches_nodes_within_its_range(rig: Rig) -> None:
    assert len(rig.received("drone-1", "edge-1", 5)) == 5
    assert rig.received("drone-1", "edge-2", 5) == []
    assert len(rig.received("edge-2", "cloud", 5)) == 5


@pytest.mark.parametrize(
    "rig",
    [[{"name": "lte", "participants": ["drone-1", "cloud"], "delay": 0.1, "loss": 0.2, "bandwidth": 0.8}]],
    indirect=True,
)
def test_network_has_delay_loss_and_rate(rig: Rig) -> None:
    arrivals = rig.received("drone-1", "cloud", 300, gap_s=0.005)
    assert 0.7 < len(arrivals) / 300 < 0.9
    assert 0.1 < arrivals[0] < 0.2
    # 40 datagrams of 1042 bytes take 0.42 s at 0.8 Mbit/s.
    burst = rig.received("drone-1", "cloud", 40, size=1000, gap_s=0.0)
    assert 0.45 < burst[-1] < 0.75


@pytest.mark.parametrize(
    "rig",
    [
        [
            {"name": "wifi", "participants": ["drone-1", "edge-1"]},
            {"name": "lte", "participants": ["drone-1", "cloud"], "delay": 0.1},
        ]
    ],
    indirect=True,
)
def test_nodes_without_common_network_have_no_address(rig: Rig) -> None:
    assert rig.networks.address("edge-1", "cloud") is None
    assert rig.networks.address("edge-1", "edge-2") is None
    assert rig.networks.address("edge-2", "edge-2") == "127.0.0.1"
    assert rig.received("drone-1", "edge-1", 3)[0] < 0.1 < rig.received("drone-1", "cloud", 3)[0]


@contextmanager
def captured(namespace: Path, *devices: str) -> Iterator[list[int]]:
    """Return the lengths of the frames that a namespace sends, captured as by tcpdump."""
    lengths: list[int] = []
    over = threading.Event()

    def capture(sock: socket.socket) -> None:
        while True:
            try:
                frame, (_, _, kind, _, _) = sock.recvfrom(70_000)
            except TimeoutError:
                if over.is_set():
                    return
                continue
            if kind == PACKET_OUTGOING:
                lengths.append(len(frame))

    def packet_socket(device: str) -> socket.socket:
        sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        sock.bind((device, 0))
        sock.settimeout(0.3)
        return sock

    sockets = [in_namespace(namespace, lambda device=device: packet_socket(device)) for device in devices]
    threads = [threading.Thread(target=capture, args=(sock,)) for sock in sockets]
    for thread in threads:
        thread.start()
    try:
        yield lengths
    finally:
        over.set()
        for thread in threads:
            thread.join()
        for sock in sockets:
            sock.close()


@pytest.mark.parametrize(
    "rig", [[{"name": "wifi", "participants": ["drone-1", "edge-1"], "loss": 0.01}]], indirect=True
)
def test_sent_bytes_equal_captured_frames(rig: Rig) -> None:
    host = rig.networks.service_host("drone-1")
    peer = rig.networks.address("drone-1", "edge-1")
    assert host is not None
    with socket.create_server((host, 0)) as service:
        edge = in_namespace(rig.namespace("edge-1"), lambda: socket.create_server(("", PORT)))
        before = rig.networks.measure()["drone-1"]
        with captured(rig.namespace("drone-1"), "svc0", "net0") as lengths:
            for server, address in ((service, service.getsockname()), (edge, (peer, PORT))):
                client = in_namespace(
                    rig.namespace("drone-1"), lambda address=address: socket.create_connection(address, 10.0)
                )
                accepted, _ = server.accept()
                threading.Thread(target=client.sendall, args=(b"x" * 1_000_000,)).start()
                received = 0
                while received < 1_000_000:
                    received += len(accepted.recv(65536))
                accepted.sendall(b"y" * 5000)
                accepted.close()
                client.close()
            time.sleep(0.5)
        edge.close()
    after = rig.networks.measure()["drone-1"]
    sent = after["app"] - before["app"]
    assert sum(lengths) > 2_000_000
    assert sent == pytest.approx(sum(lengths), rel=0.02)
    assert 5000 < after["runtime"] - before["runtime"] < 200_000


@pytest.mark.parametrize("rig", [[{"name": "wifi", "participants": ["drone-1", "edge-1"]}]], indirect=True)
def test_node_without_namespace_is_not_measured(rig: Rig) -> None:
    assert set(rig.networks.measure()) == {"drone-1", "edge-1"}
    rig.processes.stop("edge-1-namespace", kill=True)
    assert set(rig.networks.measure()) == {"drone-1"}
