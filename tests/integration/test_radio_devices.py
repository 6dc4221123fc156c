"""Devices of the simulated radio: real IP traffic between network namespaces, with range, faults and uplink."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_agent.redirector.netlink import in_namespace
from fractus_radio.medium import Medium, Station
from fractus_radio.propagation import Propagation
from fractus_radio.radio import BadCommand, Radio
from fractus_radio.taps import Tap
from fractus_radio.uplink import Uplink

pytestmark = pytest.mark.root


PORT = 7777


def _udp() -> socket.socket:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.settimeout(1.0)
    return udp


class Air:
    """Two nodes with a shared radio channel and an uplink, and the simulated radio in a thread."""

    def __init__(self, directory: Path) -> None:
        self.names = [f"fxair{os.getpid() % 100000}{end}" for end in "ab"]
        self.control = directory / "radio.sock"
        self.radio = Radio(Medium(Propagation.reaching(80.0), 1), self.control)
        self._over = threading.Event()
        ends = []
        for number, name in enumerate(self.names, 1):
            subprocess.run(["ip", "netns", "add", name], check=True)
            path = Path("/run/netns", name)
            address = bytes([2, 0, 0, 0, 0, number])
            wifi = Tap(path, "wlan0", address)
            self.radio.add_station(name[-1], wifi, Station((0.0, 0.0, 0.0), address, "net"))
            ends.append(Tap(path, "lte0", bytes([2, 0, 0, 0, 1, number])))
            for device, network in (("wlan0", "10.77.0"), ("lte0", "10.78.0")):
                self.run(name, "ip", "addr", "add", f"{network}.{number}/24", "dev", device)
                self.run(name, "ip", "link", "set", device, "up")
        self.radio.add_uplink("a", (ends[0], ends[1]), (Uplink(), Uplink()))
        self._asking, self._answering = (in_namespace(Path("/run/netns", name), _udp) for name in self.names)
        self._answering.bind(("", PORT))
        self._threads = [threading.Thread(target=target) for target in (self._carry, self._echo)]
        for thread in self._threads:
            thread.start()

    def _carry(self) -> None:
        while not self._over.is_set():
            self.radio.step(0.05)

    def run(self, name: str, *words: str) -> None:
        subprocess.run(["nsenter", f"--net=/run/netns/{name}", *words], capture_output=True, timeout=30, check=True)

    def command(self, **command: object) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.sendto(json.dumps(command).encode(), str(self.control))

    def ping(self, network: str, count: int = 3) -> list[float]:
        """Send datagrams to an echo server, and return the round-trip times of the returned ones, in ms."""
        round_trips_ms = []
        for number in range(count):
            begun = time.monotonic()
            self._asking.sendto(b"%d" % number, (f"{network}.2", PORT))
            try:
                while self._asking.recv(100) != b"%d" % number:
                    pass
            except TimeoutError:
                continue
            round_trips_ms.append((time.monotonic() - begun) * 1e3)
        return round_trips_ms

    def _echo(self) -> None:
        while not self._over.is_set():
            try:
                data, sender = self._answering.recvfrom(100)
                self._answering.sendto(data, sender)
            except OSError:
                continue

    def close(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        self._asking.close()
        self._answering.close()
        self.radio.close()
        for name in self.names:
            subprocess.run(["ip", "netns", "del", name], check=True)


@pytest.fixture
def air(tmp_path: Path) -> Iterator[Air]:
    air = Air(tmp_path)
    yield air
    air.close()


def test_simulated_radio_connects_nodes_within_range(air: Air) -> None:
    assert len(air.ping("10.77.0")) == 3
    air.command(station="b", position=[81.0, 0.0, 0.0])
    assert not air.ping("10.77.0", 1)
    air.command(station="b", position=[79.0, 0.0, 0.0])
    assert air.ping("10.77.0", 2)
    air.command(station="b", reach=0.9)
    assert not air.ping("10.77.0", 1)


@pytest.mark.parametrize("fault", [{"off": True}, {"silent": True}, {"loss_db": 90}, {"network": "other"}])
def test_simulated_radio_faults_start_and_end(air: Air, fault: dict[str, object]) -> None:
    air.command(station="b", **fault)
    assert not air.ping("10.77.0", 1)
    air.command(station="b", off=False, silent=False, loss_db=0, network="net")
    assert air.ping("10.77.0", 2)


def test_simulated_uplink_has_delay(air: Air) -> None:
    round_trips_ms = air.ping("10.78.0", 5)
    assert min(round_trips_ms) >= 120.0
    air.command(uplink="a", off=True)
    assert not air.ping("10.78.0", 1)


def test_simulated_radio_refuses_bad_command_without_effect(air: Air) -> None:
    for command, message in (
        ({"station": "c"}, "unknown station c"),
        ({"station": "a", "speed": 3}, "unknown attribute speed"),
        ({"station": "a", "off": 1}, "wrong type"),
        ({"station": "a", "position": [1.0, float("nan"), 0.0]}, "position: nan is not a finite number"),
        ({"station": "a", "position": [10**400, 0, 0]}, "is not a finite number"),
        ({"station": "a", "position": [1.0, 2.0]}, "three numbers"),
        ({"station": ["a"]}, "unknown station"),
        ({"uplink": "a", "rate_bps": 0}, "rate_bps and reach must be positive"),
        ({"uplink": "a", "rate_bps": float("inf")}, "finite"),
        ({}, "must name a station"),
    ):
        with pytest.raises(BadCommand, match=message):
            air.radio.command(command)
    assert air.ping("10.77.0", 1)
