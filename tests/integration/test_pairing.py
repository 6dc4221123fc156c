"""Pairing over the simulated radio with TLS on real devices. Faults: impostors, silent peers, second drones, losses."""

from __future__ import annotations

import base64
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from fractus_agent.links.beacons import decode, encode
from fractus_agent.links.device_addresses import link_address
from fractus_core.identity.authority import Authority
from fractus_radio.medium import Medium, Station
from fractus_radio.propagation import Propagation
from fractus_radio.radio import Radio
from fractus_radio.taps import Tap

pytestmark = pytest.mark.root

TIMEOUT_S = 30.0
PROGRAM = Path(__file__).with_name("link_node.py")


class Node:
    """A node in a network namespace with a radio."""

    def __init__(
        self, air: Air, name: str, *, certified_as: str = "", max_peers: int = 4, files: Path | None = None
    ) -> None:
        self.name = name
        self.namespace = f"{air.tag}{name}"
        subprocess.run(["ip", "netns", "add", self.namespace], check=True)
        path = Path("/run/netns", self.namespace)
        address = bytes([2, 0, 0, 0, 0, len(air.nodes) + 1])
        tap = Tap(path, "wlan0", address)
        air.radio.add_station(name, tap, Station((0.0, 0.0, 0.0), address, "net"))
        inside = ["nsenter", f"--net={path}"]
        for words in (
            ["addr", "add", f"{link_address(name)}/16", "dev", "wlan0"],
            ["link", "set", "wlan0", "up"],
            ["route", "add", "255.255.255.255", "dev", "wlan0"],
        ):
            subprocess.run([*inside, "ip", *words], check=True)
        files = files or air.files(certified_as or name)
        self._process = subprocess.Popen(
            [*inside, sys.executable, str(PROGRAM), name, str(files), str(max_peers)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._events: queue.Queue[str] = queue.Queue()
        self._reading = threading.Thread(target=self._read)
        self._reading.start()
        self.expect("ready")

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._events.put(line.strip())

    def expect(self, begins: str) -> str:
        """Wait for the next event that begins with a text, and return the event."""
        deadline = time.monotonic() + TIMEOUT_S
        lines = []
        while (remaining_s := deadline - time.monotonic()) > 0:
            try:
                lines.append(self._events.get(timeout=remaining_s))
            except queue.Empty:
                break
            if lines[-1].startswith(begins):
                return lines[-1]
        raise AssertionError(f"{self.name}: no event begins with {begins!r}: {lines}")

    def tell(self, command: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def clear(self) -> None:
        if self._process.poll() is None:
            self._process.communicate(timeout=TIMEOUT_S) if not self._reading.is_alive() else self._end()
        self._reading.join()
        subprocess.run(["ip", "netns", "del", self.namespace], check=True)

    def _end(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(TIMEOUT_S)


class Air:
    """The simulated radio in a thread, and an authority that issues node certificates."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.tag = f"fxl{os.getpid() % 100000}"
        self.authority = Authority.generate(datetime.now(UTC))
        self.radio = Radio(Medium(Propagation.reaching(80.0), 1), directory / "radio.sock")
        self.nodes: list[Node] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def _carry(self) -> None:
        while not self._over.is_set():
            self.radio.step(0.02)

    def files(self, node: str, authority: Authority | None = None, now: datetime | None = None) -> Path:
        """Write certificate, key and authority of a node to a folder, like its agent. Return the folder."""
        folder = self.directory / f"{node}-{len(list(self.directory.iterdir()))}"
        folder.mkdir()
        for name, content in (authority or self.authority).issue_node(node, now or datetime.now(UTC)).items():
            (folder / name).write_bytes(base64.b64decode(content))
        return folder

    def node(self, name: str, **options: object) -> Node:
        self.nodes.append(Node(self, name, **options))
        return self.nodes[-1]

    def command(self, **command: object) -> None:
        self.radio.command(command)

    def close(self) -> None:
        for node in self.nodes:
            node.clear()
        self._over.set()
        self._thread.join()
        self.radio.close()


@pytest.fixture
def air(tmp_path: Path) -> Iterator[Air]:
    air = Air(tmp_path)
    yield air
    air.close()


def test_two_nodes_discover_each_other_pair_and_disconnect(air: Air) -> None:
    edge = air.node("e1")
    drone = air.node("d1")
    edge.expect("heard d1")
    drone.expect("heard e1")
    drone.tell("want e1")
    drone.expect("link connecting e1")
    drone.expect("link up e1")
    edge.expect("accepted d1")
    drone.expect("latency")
    drone.tell("want ")
    drone.expect("link none -")
    edge.expect("ended d1")


def test_drone_changes_its_peer_and_has_one_link_at_a_time(air: Air) -> None:
    first = air.node("e1")
    second = air.node("e2")
    drone = air.node("d1")
    drone.tell("want e1")
    drone.expect("link up e1")
    drone.tell("want e2")
    drone.expect("link none -")
    drone.expect("link up e2")
    first.expect("ended d1")
    second.expect("accepted d1")


def test_both_ends_detect_the_loss_of_the_link(air: Air) -> None:
    edge = air.node("e1")
    drone = air.node("d1")
    drone.tell("want e1")
    drone.expect("link up e1")
    edge.expect("accepted d1")
    lost_at = time.monotonic()
    air.command(station="d1", position=[200.0, 0.0, 0.0])
    assert "silent" in drone.expect("link none -")
    edge.expect("ended d1")
    assert time.monotonic() - lost_at < 5.0
    air.command(station="d1", position=[0.0, 0.0, 0.0])
    drone.tell("want e1")
    drone.expect("link up e1")


def test_pairing_with_an_unresponsive_peer_times_out(air: Air) -> None:
    air.node("e1")
    drone = air.node("d1")
    air.command(station="e1", silent=True)
    drone.tell("want e1")
    assert "e1_does_not_respond:_timeout" in drone.expect("link none -")


@pytest.mark.parametrize("fault", ["other name", "other authority", "component", "expired"])
def test_impostor_of_the_peer_gets_no_link(air: Air, fault: str) -> None:
    if fault == "other name":
        files = air.files("e2")
    elif fault == "expired":
        files = air.files("e1", now=datetime.now(UTC) - timedelta(days=90))
    elif fault == "other authority":
        files = air.files("e1", Authority.generate(datetime.now(UTC)))
    else:
        files = air.files("e1")
        own = air.authority.issue_component(
            "spiffe://fractus.dev/ns/a/app/b/component/c/instance/e1", datetime.now(UTC)
        )
        for name, content in own.items():
            (files / name).write_bytes(base64.b64decode(content))
    air.node("e1", files=files)
    drone = air.node("d1")
    drone.tell("want e1")
    assert drone.expect("link none -")
    # A second attempt fails as well.
    drone.tell("want e1")
    drone.expect("link none -")


def test_edge_node_refuses_a_drone_without_direct_link(air: Air) -> None:
    edge = air.node("e1")
    drone = air.node("d1")
    edge.tell("refuse no DirectLink names d1")
    drone.tell("want e1")
    assert "no_DirectLink_names_d1" in drone.expect("link none -")


def test_second_drone_is_refused_while_the_first_is_linked(air: Air) -> None:
    edge = air.node("e1", max_peers=1)
    first = air.node("d1")
    second = air.node("d2")
    first.tell("want e1")
    first.expect("link up e1")
    edge.expect("accepted d1")
    second.tell("want e1")
    assert "linked_already" in second.expect("link none -")
    first.tell("want ")
    edge.expect("ended d1")
    second.tell("want e1")
    second.expect("link up e1")


def test_link_is_restored_after_the_peer_restarts(air: Air) -> None:
    edge = air.node("e1")
    drone = air.node("d1")
    drone.tell("want e1")
    drone.expect("link up e1")
    drone.kill()
    edge.expect("ended d1")


def test_beacons_contain_a_valid_node_name_only() -> None:
    assert decode(encode("e1")) == "e1"
    for data in (
        b"",
        b"{",
        b"[]",
        b'{"fractus": 2, "node": "e1"}',
        b'{"fractus": 1, "node": 3}',
        b'{"fractus": 1, "node": ""}',
        b'{"fractus": 1, "node": "e1\\nlinks: up"}',
        b'{"fractus": 1, "node": "\\ud800"}',
        b"[" * 512,
    ):
        assert decode(data) is None
    assert decode(encode("x" * 254)) is None


def test_link_addresses_are_derived_from_names_and_avoid_reserved_ranges() -> None:
    addresses = {link_address(f"node-{n}") for n in range(2000)}
    assert len(addresses) > 1900
    assert all(str(address).startswith("169.254.") for address in addresses)
    assert not [a for a in addresses if a.packed[2] in {0, 255}]
