"""Network namespaces of drones, edge nodes, their pods and a cloud, in which agents run direct links over a simulated radio."""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from fractus_agent.links.device_addresses import link_address
from fractus_agent.redirector.netlink import NETLINK_NETFILTER, NLM_F_ACK, Netlink, encode_message, in_namespace
from fractus_agent.redirector.nft_maps import Endpoint
from fractus_core.identity.authority import Authority
from fractus_core.local_frame import LocalFrame
from fractus_radio.medium import Medium, Station
from fractus_radio.propagation import Propagation
from fractus_radio.radio import Radio
from fractus_radio.taps import Tap
from fractus_runtime.audit_chain import verify
from fractus_runtime.audit_checkpoints import read_checkpoint
from redirect_rig import CLIENT, SERVER, run

VIP = Endpoint(IPv4Address("10.96.0.5"), 8080)
RANGE_M = 80.0
TIMEOUT_S = 40.0
PROGRAM = Path(__file__).with_name("linked_agent.py")
ORIGIN = (39.36, 22.94)
_FRAME = LocalFrame(*ORIGIN)


def place(east: float, north: float, up: float = 0.0) -> dict[str, Any]:
    """Return a position for a manifest, from an offset in metres."""
    lat, lon = _FRAME.latlon(east, north)
    return {"lat": lat, "lon": lon, "alt": up, "altitudeReference": "home"}


STREAM = """
import itertools, queue, sys, threading, time
import grpc
channel = grpc.insecure_channel(sys.argv[1])
call = channel.stream_stream("/test/Stream")
print("ready", flush=True)
number = 0
while True:
    requests = queue.Queue()
    replies = call(iter(requests.get, None))
    try:
        while True:  # one request at a time; a request without a reply is sent again on the next stream
            requests.put(f"{number:08d}".encode())
            print(number, next(replies).decode().split()[0], f"{time.monotonic():.3f}", flush=True)
            number += 1
            time.sleep(0.02)
    except grpc.RpcError as error:
        print(number, "REOPENED", error.code().name, flush=True)
"""
"""Program of a client with one endless stream that is rarely idle."""

FOREIGN = """table ip kube-proxy {
    chain pre { type nat hook prerouting priority -100; ip daddr 10.97.0.9 tcp dport 80 dnat to 10.88.0.2:8080; }
}"""
"""nftables rules of another program, which agents must not change."""


class Agent:
    """Node in a network namespace, with a radio, an uplink to the cloud, a pod, and a link manager."""

    def __init__(self, world: World, name: str, kind: str, at: tuple[float, float]) -> None:
        self.world = world
        self.name = name
        self.kind = kind
        self.at = at
        self.number = len(world.agents) + 1
        self.pod = f"10.88.{self.number}.2"
        self.folder = world.directory / name
        self.pods = self.folder / "pods"
        self.pods.mkdir(parents=True)
        world.namespace(name)
        self.add_pod()
        world.cable(name, "lte0", f"10.90.{self.number}.1/24", "cloud", f"to{self.number}", f"10.90.{self.number}.2/24")
        run(*world.inside(name), "ip", "route", "add", "default", "via", f"10.90.{self.number}.2")
        run(*world.inside("cloud"), "ip", "route", "add", f"10.88.{self.number}.0/24", "via", f"10.90.{self.number}.1")
        self.add_radio()
        self.run("nft", "-f", "-", text=FOREIGN)
        self.certify(name)
        # The uplink is so slow that the direct link is the better path even on a busy machine.
        self.describe(uplink_mbps=1)
        self._process: subprocess.Popen[str] | None = None
        self._reading: threading.Thread | None = None

        self.statuses: dict[str, dict[str, Any]] = {}

    def add_pod(self) -> None:
        """Create the network namespace of the node's pod, like a container runtime."""
        name = f"{self.name}p"
        net = f"10.88.{self.number}"
        self.world.namespace(name)
        (self.pods / "pod").unlink(missing_ok=True)
        (self.pods / "pod").symlink_to(self.world.path(name))
        self.world.cable(self.name, "pod0", f"{net}.1/24", name, "eth0", f"{self.pod}/24")
        run(*self.world.inside(name), "ip", "route", "add", "default", "via", f"{net}.1")

    def lose_power(self) -> None:
        """Simulate a power loss: kill the agent and the pod, and remove all state that is not on disk."""
        self.kill()
        self.world.end(f"{self.name}p")
        self.run("ip", "link", "del", "pod0")
        run("ip", "netns", "del", self.world.name(f"{self.name}p"))
        run(*self.world.inside(self.name), "nft", "flush", "ruleset")
        for words in (["addr", "flush", "dev", "wlan0"], ["link", "set", "wlan0", "down", "alias", ""]):
            run(*self.world.inside(self.name), "ip", *words)
        in_namespace(self.world.path(self.name), _forget_connections)
        self.add_pod()

    def describe(self, uplink_mbps: float) -> None:
        """Write the node description."""
        interfaces = [
            {"technology": "4G", "bandwidth": uplink_mbps},
            {
                "technology": "WiFi",
                "device": "wlan0",
                "range": RANGE_M,
                "pairing": {"mode": "adhoc", "networkId": "net"},
            },
        ]
        spec: dict[str, Any] = {"interfaces": interfaces}
        if self.kind == "EdgeNode":
            spec["location"] = {"lat": place(*self.at)["lat"], "lon": place(*self.at)["lon"]}
        self._write(
            "node.json",
            {"apiVersion": "fractus.dev/v1alpha1", "kind": self.kind, "metadata": {"name": self.name}, "spec": spec},
        )

    def add_radio(self) -> None:
        self.hardware = bytes([2, 0, 0, 0, 0, self.number])
        tap = Tap(self.world.path(self.name), "wlan0", self.hardware)
        with self.world.turn:
            self.world.radio.add_station(self.name, tap, Station((*self.at, 0.0), self.hardware, "net"))

    def uplink(self, *, up: bool) -> None:
        """Take the uplink to the cloud down, or bring it up."""
        run(*self.world.inside(self.name), "ip", "link", "set", "lte0", "up" if up else "down")
        if up:
            gateway = f"10.90.{self.number}.2"
            run(*self.world.inside(self.name), "ip", "route", "replace", "default", "via", gateway)

    def api(self, *, up: bool) -> None:
        """Make the API server reachable or unreachable for the agent."""
        self._write("api.json", up)

    def lose_radio(self) -> None:
        """Remove the device, as if it was unplugged."""
        self._rename("wlan0", "gone0")

    def regain_radio(self) -> None:
        """Add the device again, without its address."""
        self._rename("gone0", "wlan0")

    def _rename(self, before: str, after: str) -> None:
        for words in (["down"], ["name", after]):
            run(*self.world.inside(self.name), "ip", "link", "set", before, *words)

    def join(self, address: str) -> None:
        """Join the network of the direct links without an agent."""
        for words in (["addr", "add", f"{address}/16", "dev", "wlan0"], ["link", "set", "wlan0", "up"]):
            run(*self.world.inside(self.name), "ip", *words)

    def reaches(self, address: str, port: int) -> bool:
        """Return True if a TCP connection can be opened from the node."""
        program = f"import socket; socket.create_connection(({address!r}, {port}), 2).close()"
        result = subprocess.run(
            [*self.world.inside(self.name), sys.executable, "-c", program], capture_output=True, timeout=30, check=False
        )
        return result.returncode == 0

    def metrics(self) -> dict[str, float]:
        """Return the Prometheus metrics of the agent."""
        program = (
            "import urllib.request as r; print(r.urlopen('http://127.0.0.1:46812/metrics', timeout=10).read().decode())"
        )
        lines = self._show("env", "-u", "http_proxy", "-u", "HTTP_PROXY", sys.executable, "-c", program).splitlines()
        samples = (line.rsplit(" ", 1) for line in lines if line and not line.startswith("#"))
        return {name: float(value) for name, value in samples}

    def certify(self, name: str, authority: Authority | None = None) -> None:
        """Issue a node certificate."""
        tls = self.folder / "tls"
        tls.mkdir(exist_ok=True)
        for file, content in (authority or self.world.authority).issue_node(name, datetime.now(UTC)).items():
            (tls / file).write_bytes(base64.b64decode(content))

    def _write(self, name: str, content: Any) -> None:
        fresh = self.folder / f".{name}.new"
        fresh.write_text(json.dumps(content))
        fresh.replace(self.folder / name)

    def plan(self, *links: dict[str, Any]) -> None:
        """Set the DirectLinks that the operator planned."""
        self._write("links.json", list(links))

    def fly(self, east: float, north: float = 0.0, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Set the position of the drone's radio, and the telemetry to the same position."""
        self.set_telemetry(east, north, velocity)
        self.world.command(station=self.name, position=[east, north, 0.0])

    def set_telemetry(
        self, east: float, north: float = 0.0, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        """Set the telemetry of the drone, but not the position of its radio."""
        position = place(east, north)
        self._write("telemetry.json", {"lat": position["lat"], "lon": position["lon"], "up": 0.0, "velocity": velocity})

    def start(self) -> None:
        log = (self.folder / "agent.log").open("a")
        self._process = subprocess.Popen(
            # Other tests share the processors. If the agent waited for one between the check that a connection is quiet
            # and its end, the end would interrupt the client's next call. The agent of a node does not wait that long.
            ["nice", "-n", "-10", *self.world.inside(self.name), sys.executable, str(PROGRAM), str(self.folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True,
        )  # fmt: skip
        log.close()
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"
        self._reading = threading.Thread(target=self._read, args=(self._process.stdout,))
        self._reading.start()

    def _read(self, output: Any) -> None:
        for line in output:
            report = json.loads(line)
            self.statuses[report["link"]] = report["status"]
        output.close()

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        """Kill the agent."""
        assert self._process is not None
        self._process.kill()
        self._end()

    def request_stop(self) -> None:
        """Ask the agent to stop gracefully, like an upgrade."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def _end(self) -> None:
        assert self._process is not None
        self._process.wait(TIMEOUT_S)
        if self._process.stdin is not None and not self._process.stdin.closed:
            self._process.stdin.close()
        if self._reading is not None:
            self._reading.join()
        self._process = None

    def clear(self) -> None:
        """Stop the agent gracefully if it is running."""
        if self._process is not None:
            self.request_stop()
            self._end()

    def log(self) -> str:
        path = self.folder / "agent.log"
        return path.read_text() if path.exists() else ""

    def audit(self, kind: str) -> list[dict[str, Any]]:
        """Verify the audit log, and return its entries of a kind."""
        path = self.folder / "audit" / "links.jsonl"
        lines = path.read_bytes().splitlines(keepends=True)
        signed = read_checkpoint(path.with_suffix(".checkpoint").read_bytes())
        assert (signed.log, signed.node.rpartition("/")[2]) == ("links", self.name)
        assert not verify(lines, since=signed.entry).problem
        return [entry for entry in map(json.loads, lines) if entry["kind"] == kind]

    def status(self, link: str) -> dict[str, Any]:
        return self.statuses.get(link, {})

    def condition(self, link: str, kind: str) -> dict[str, Any]:
        return next((c for c in self.status(link).get("conditions", ()) if c["type"] == kind), {})

    def _show(self, *words: str) -> str:
        return subprocess.run(
            [*self.world.inside(self.name), *words], capture_output=True, text=True, timeout=30, check=False
        ).stdout

    def cut_at(self) -> list[float]:
        """Return the Unix times of the agent's abrupt switches, in seconds."""
        lines = (line.split(" ", 1) for line in self.log().splitlines() if "redirector: switched" in line)
        return [float(at) for at, text in lines if "planned=False" in text]

    def redirects(self) -> set[str]:
        """Return the keys of the redirection map, such as `10.96.0.5 . tcp . 8080`."""
        return set(
            re.findall(r"([\d.]+ \. \w+ \. \d+) timeout", self._show("nft", "list", "map", "ip", "fractus", "targets"))
        )

    def tables(self) -> set[str]:
        """Return the nftables tables of the agent."""
        return set(self._show("nft", "list", "tables").split("\n")) - {"", "table ip kube-proxy"}

    def addresses(self) -> list[str]:
        return re.findall(r"169\.254\.[\d.]+/\d+", self._show("ip", "addr", "show", "dev", "wlan0"))

    def routes(self) -> list[str]:
        return sorted(self._show("ip", "route").splitlines())

    def run(self, *words: str, text: str = "") -> str:
        """Run a command in the node's namespace with some input, and return its output."""
        inside = [*self.world.inside(self.name), *words]
        return subprocess.run(inside, input=text, capture_output=True, text=True, timeout=30, check=True).stdout

    def state(self) -> dict[str, Any]:
        """Return the state that direct links may change: packet filter, routes, addresses, device and connections."""
        addresses = re.sub(r"(?m)^\d+: | valid_lft.*", "", self._show("ip", "-o", "-4", "address"))
        return {
            "ruleset": self._show("nft", "list", "ruleset"),
            "rules": self._show("ip", "rule"),
            # Ignore the flag linkdown, because the carrier of a device comes up a moment after the device.
            "routes": sorted(
                self._show("ip", "-4", "route", "show", "table", "all").replace("linkdown ", "").splitlines()
            ),
            "addresses": sorted(addresses.splitlines()),
            # Ignore the queue. The first agent that brings the device up adds a queue, which stays.
            "device": re.sub(r" qdisc \w+", "", self._show("ip", "address", "show", "dev", "wlan0")),
            "connections": self.world.conntrack(self),
        }


class World:
    """All network namespaces, the simulated radio in a thread, and a certificate authority."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.tag = f"fxw{os.getpid() % 100000}"
        self.turn = threading.Lock()
        self.radio = Radio(Medium(Propagation.reaching(RANGE_M), 1), directory / "radio.sock")
        self.authority = Authority.generate(datetime.now(UTC))
        self.agents: dict[str, Agent] = {}
        self._namespaces: list[str] = []
        self._processes: list[tuple[str, subprocess.Popen[str]]] = []
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run_radio)
        self._thread.start()
        self.namespace("cloud")
        run(*self.inside("cloud"), "ip", "addr", "add", f"{VIP.address}/32", "dev", "lo")

    def _run_radio(self) -> None:
        while not self._closed.is_set():
            with self.turn:
                self.radio.step(0.01)
            time.sleep(0)

    def command(self, **command: object) -> None:
        with self.turn:
            self.radio.command(command)

    def name(self, node: str) -> str:
        return f"{self.tag}{node}"

    def path(self, node: str) -> Path:
        return Path("/run/netns", self.name(node))

    def inside(self, node: str) -> list[str]:
        return ["nsenter", f"--net={self.path(node)}"]

    def namespace(self, node: str) -> None:
        run("ip", "netns", "add", self.name(node))
        self._namespaces.append(self.name(node))
        run(*self.inside(node), "ip", "link", "set", "lo", "up")
        run(*self.inside(node), "sysctl", "-qw", "net.ipv4.ip_forward=1")

    def cable(self, node: str, device: str, address: str, peer: str, peer_device: str, peer_address: str) -> None:
        """Connect two namespaces by a pair of devices with addresses."""
        run(
            *self.inside(node), "ip", "link", "add", device, "type", "veth",
            "peer", "name", peer_device, "netns", self.name(peer),
        )  # fmt: skip
        for end, link, ip in ((node, device, address), (peer, peer_device, peer_address)):
            run(*self.inside(end), "ip", "addr", "add", ip, "dev", link)
            run(*self.inside(end), "ip", "link", "set", link, "up")

    def drone(self, name: str = "d1") -> Agent:
        drone = Agent(self, name, "Drone", (0.0, 0.0))
        self.agents[name] = drone
        drone.fly(0.0)
        return drone

    def edge(self, name: str, east: float, north: float = 0.0) -> Agent:
        self.agents[name] = Agent(self, name, "EdgeNode", (east, north))
        return self.agents[name]

    def link(self, drone: Agent, edge: Agent, **spec: Any) -> dict[str, Any]:
        """Return a DirectLink as the operator would create it."""
        service = {
            "component": "Server", "instance": f"server-{edge.name}",
            "virtual": {"address": str(VIP.address), "port": VIP.port},
            "target": {"address": edge.pod, "port": VIP.port},
        }  # fmt: skip
        base = {
            "drone": drone.name, "node": edge.name, "technology": "WiFi",
            "application": {"namespace": "default", "name": "app", "uid": "u"},
            "pairing": {"mode": "adhoc", "networkId": "net"}, "range": RANGE_M, "bandwidth": 12.0,
            "position": place(*edge.at), "heuristic": {"kind": "max", "metric": "ingress-bandwidth"},
            "services": [service],
        }  # fmt: skip
        return {
            "apiVersion": "fractus.dev/v1alpha1", "kind": "DirectLink",
            "metadata": {"name": f"app-{drone.name}-{edge.name}", "uid": "u", "generation": 1}, "spec": base | spec,
        }  # fmt: skip

    def states(self) -> dict[str, dict[str, Any]]:
        """Return the state that direct links may change, by node."""
        return {name: agent.state() for name, agent in self.agents.items()}

    def python(self, node: str, program: str, *arguments: object) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*self.inside(node), sys.executable, "-c", program, *map(str, arguments)], stdout=subprocess.PIPE, text=True
        )
        self._processes.append((node, process))
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    def end(self, node: str) -> None:
        """End the programs that run in the namespace of a node."""
        for name, process in self._processes:
            if name == node:
                process.kill()
                process.wait()

    def serve(self, work_s: float = 0.005) -> None:
        """Start the base instance in the cloud, and an instance on each edge node."""
        self.python("cloud", SERVER, "cloud", f"{VIP.address}:{VIP.port}", work_s)
        for agent in self.agents.values():
            if agent.kind == "EdgeNode":
                self.serve_at(agent, work_s)

    def serve_at(self, edge: Agent, work_s: float = 0.005) -> None:
        """Start the instance on an edge node."""
        self.python(f"{edge.name}p", SERVER, edge.name, f"{edge.pod}:{VIP.port}", work_s)

    def client(self, drone: Agent, calls: int, pause_s: float = 0.02, size: int = 10) -> Client:
        return Client(self.python(f"{drone.name}p", CLIENT, f"{VIP.address}:{VIP.port}", calls, pause_s, size))

    def conntrack(self, agent: Agent) -> int:
        """Return the number of connections of a node that have a mark of the redirector."""
        listed = in_namespace(self.path(agent.name), lambda: Path("/proc/thread-self/net/nf_conntrack"))
        text = in_namespace(self.path(agent.name), lambda: listed.read_text() if listed.exists() else "")
        marks = [int(mark) for mark in re.findall(r"mark=(\d+)", text)]
        return len([mark for mark in marks if mark & 0xFFF00000 == 0xF6A00000])

    def close(self) -> None:
        for _, process in self._processes:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        for agent in self.agents.values():
            agent.request_stop()  # all agents stop at the same time
        for agent in self.agents.values():
            agent.clear()
        self._closed.set()
        self._thread.join()
        self.radio.close()
        for name in self._namespaces:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


def _forget_connections() -> None:
    """Delete all conntrack entries of the current namespace."""
    netlink = Netlink(NETLINK_NETFILTER)
    try:
        sequence = netlink.sequence()
        netlink.send(encode_message(1 << 8 | 2, NLM_F_ACK, sequence, b"\x02\0\0\0"))
        netlink.acknowledged({sequence})
    finally:
        netlink.close()


class Client:
    """Client that calls the virtual address, and the responses that it received.

    A response consists of the words that the program CLIENT prints: number, server and time, or number, FAILED and error.
    """

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.responses: list[list[str]] = []
        self._process = process
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.responses.append(line.split())

    def all(self) -> list[list[str]]:
        """Wait for the end of the client, and return all responses."""
        self._thread.join(120)
        return self.responses

    @property
    def last_server(self) -> str:
        """Name of the server that sent the last response, or an empty string."""
        return self.responses[-1][1] if self.responses else ""

    @property
    def failed(self) -> list[list[str]]:
        return [response for response in self.responses if response[1] == "FAILED"]


def until(
    condition: Callable[[], object], description: str, world: World | None = None, timeout_s: float = TIMEOUT_S
) -> float:
    """Wait for a condition, and return the elapsed time in seconds."""
    begun = time.monotonic()
    while time.monotonic() - begun < timeout_s:
        if condition():
            return time.monotonic() - begun
        time.sleep(0.02)
    logs = "".join(f"\n--- {a.name}\n{a.log()[-3000:]}\n{a.statuses}" for a in world.agents.values()) if world else ""
    raise AssertionError(f"waited {timeout_s:g} s for {description}{logs}")


def start_drone(world: World, *edges: Agent) -> Agent:
    """Start a drone with a DirectLink to each edge node, and all agents and servers."""
    drone = world.agents.get("d1") or world.drone()
    links = [world.link(drone, edge) for edge in edges]
    world.serve()
    for edge, link in zip(edges, links, strict=True):
        edge.plan(link)
        edge.start()
    drone.plan(*links)
    drone.start()
    return drone


def check_restored(world: World, before: Mapping[str, Mapping[str, Any]]) -> None:
    """Delete all DirectLinks, and check that every node returns to its previous state."""

    def changes() -> list[tuple[str, str, Any, Any]]:
        now = world.states()
        return [
            (node, part, value, now[node][part])
            for node, state in before.items()
            for part, value in state.items()
            if now[node][part] != value
        ]

    for agent in world.agents.values():
        agent.plan()
    with suppress(AssertionError):
        until(lambda: not changes(), "the previous state of all nodes")
    differences = changes()
    assert not differences, differences


@contextmanager
def linked_world(directory: Path) -> Iterator[World]:
    """Create a world, and remove it at the end."""
    world = World(directory)
    try:
        yield world
    finally:
        world.close()


__all__ = [
    "FOREIGN",
    "STREAM",
    "Agent",
    "Client",
    "World",
    "check_restored",
    "link_address",
    "linked_world",
    "place",
    "start_drone",
    "until",
]
