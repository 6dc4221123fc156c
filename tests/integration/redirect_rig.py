"""Network namespaces of two nodes with a pod each, a cloud and a direct link, with servers and clients."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import IPv4Address
from pathlib import Path

from fractus_agent.redirector.netlink import NETLINK_NETFILTER, Netlink, in_namespace
from fractus_agent.redirector.nft_maps import Callers, Endpoint, NftMaps, Redirect
from fractus_agent.redirector.ruleset import Ports, create

VIP = Endpoint(IPv4Address("10.96.0.5"), 8080)
DIRECT = Endpoint(IPv4Address("10.77.0.2"), 9000)
DRONE = IPv4Address("10.77.0.1")
PORTS = Ports(udp=46810, tcp=46811)
POD = Endpoint(IPv4Address("10.88.0.2"), 8080)

SERVER = """
import sys, time
from concurrent.futures import ThreadPoolExecutor
import grpc
name, address, work_s = sys.argv[1], sys.argv[2], float(sys.argv[3])
def respond(request, context):
    time.sleep(work_s)
    return name.encode() + b" " + request[:32]
def send(request, context):  # the requested number of bytes, in messages of 200 kB
    remaining = int(request)
    while remaining:
        size = min(remaining, 200_000)
        yield bytes(size)
        remaining -= size
def stream(requests, context):
    for request in requests:
        yield name.encode() + b" " + request
class Handler(grpc.GenericRpcHandler):
    def service(self, details):
        if details.method == "/test/Stream":
            return grpc.stream_stream_rpc_method_handler(stream)
        if details.method == "/test/Send":
            return grpc.unary_stream_rpc_method_handler(send)
        return grpc.unary_unary_rpc_method_handler(respond)
server = grpc.server(ThreadPoolExecutor(8))
server.add_generic_rpc_handlers((Handler(),))
server.add_insecure_port(address)
server.start()
print("ready", flush=True)
server.wait_for_termination()
"""

CLIENT = """
import sys, time
import grpc
address, calls, pause_s, size = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
channel = grpc.insecure_channel(address)
call = channel.unary_unary("/test/Ask")
print("ready", flush=True)
for number in range(calls):
    begun = time.monotonic()
    try:
        server, _ = call(f"{number:08d}".encode() + b"x" * size, timeout=5).decode().split()
        print(number, server, f"{time.monotonic():.3f}", flush=True)
    except grpc.RpcError as error:
        print(number, "FAILED", error.code().name, error.details().replace(" ", "_"), flush=True)
    time.sleep(max(pause_s - (time.monotonic() - begun), 0))
"""


def run(*words: str) -> None:
    """Run a command. An error fails the test."""
    subprocess.run(words, check=True, capture_output=True, timeout=30)


class Rig:
    """Network namespaces of a drone with a pod, an edge node with a pod, and a cloud, and processes in them."""

    def __init__(self) -> None:
        self.tag = f"fx{os.getpid() % 100000}"
        self.processes: list[subprocess.Popen[str]] = []
        self.sockets: list[Netlink] = []
        self.pods: list[str] = []

    def name(self, node: str) -> str:
        """Return the name of the namespace of a node or pod."""
        return f"{self.tag}{node}"

    def path(self, node: str) -> Path:
        """Return the file of the network namespace of a node or pod."""
        return Path("/run/netns", self.name(node))

    def inside(self, node: str) -> list[str]:
        """Return the command prefix that runs a command in the namespace."""
        return ["nsenter", f"--net={self.path(node)}"]

    def build(self) -> None:
        """Create all namespaces and devices. The direct link is `fxl0` on both ends."""
        for node in ("drone", "dpod", "edge", "epod", "cloud"):
            run("ip", "netns", "add", self.name(node))
            run(*self.inside(node), "ip", "link", "set", "lo", "up")
            run(*self.inside(node), "sysctl", "-qw", "net.ipv4.ip_forward=1")
        self._link("drone", "pod0", "10.87.0.1/24", "dpod", "eth0", "10.87.0.2/24")
        self._link("edge", "pod0", "10.88.0.1/24", "epod", "eth0", "10.88.0.2/24")
        self._link("drone", "lte0", "10.90.0.1/24", "cloud", "eth0", "10.90.0.2/24")
        self._link("drone", "fxl0", "10.77.0.1/30", "edge", "fxl0", "10.77.0.2/30")
        run(*self.inside("dpod"), "ip", "route", "add", "default", "via", "10.87.0.1")
        run(*self.inside("epod"), "ip", "route", "add", "default", "via", "10.88.0.1")
        run(*self.inside("drone"), "ip", "route", "add", "10.96.0.0/16", "via", "10.90.0.2")
        run(*self.inside("cloud"), "ip", "addr", "add", f"{VIP.address}/32", "dev", "lo")
        run(*self.inside("cloud"), "ip", "route", "add", "default", "via", "10.90.0.1")
        for node in ("drone", "edge"):
            create("fxl*", PORTS, self.inside(node), clients=node == "drone")
        self.maps("edge").write([Redirect(DIRECT, POD)], [(DIRECT, 1)], 600.0, [DRONE])

    def _link(self, node: str, device: str, address: str, peer: str, peer_device: str, peer_address: str) -> None:
        """Connect two namespaces by a pair of devices with addresses."""
        run(
            *self.inside(node), "ip", "link", "add", device, "type", "veth",
            "peer", "name", peer_device, "netns", self.name(peer),
        )  # fmt: skip
        for end, link, ip in ((node, device, address), (peer, peer_device, peer_address)):
            run(*self.inside(end), "ip", "addr", "add", ip, "dev", link)
            run(*self.inside(end), "ip", "link", "set", link, "up")

    def pod(self, name: str, net: str, at: str = "drone") -> str:
        """Add a pod on a node, in a network such as `10.86.0`."""
        run("ip", "netns", "add", self.name(name))
        self.pods.append(name)
        self._link(at, name, f"{net}.1/24", name, "eth0", f"{net}.2/24")
        run(*self.inside(name), "ip", "route", "add", "default", "via", f"{net}.1")
        return name

    def reaches(self, node: str, address: str, port: int) -> bool:
        """Return True if a TCP connection can be opened from a node or pod."""
        program = f"import socket; socket.create_connection(({address!r}, {port}), 1).close()"
        result = subprocess.run(
            [*self.inside(node), sys.executable, "-c", program], capture_output=True, timeout=30, check=False
        )
        return result.returncode == 0

    def maps(self, node: str) -> NftMaps:
        """Return the nftables maps of a node. They create their table again if it is missing."""

        def make_table(callers: Callers) -> None:
            create("fxl*", PORTS, self.inside(node), clients=node == "drone", callers=callers)

        return NftMaps(self.netlink(node), make_table)

    def netlink(self, node: str, protocol: int = NETLINK_NETFILTER) -> Netlink:
        """Open a netlink socket in a namespace."""
        self.sockets.append(in_namespace(self.path(node), lambda: Netlink(protocol)))
        return self.sockets[-1]

    def python(self, node: str, program: str, *arguments: object) -> subprocess.Popen[str]:
        """Start a Python program in a namespace, and wait until it is ready."""
        process = subprocess.Popen(
            [*self.inside(node), sys.executable, "-c", program, *map(str, arguments)], stdout=subprocess.PIPE, text=True
        )
        self.processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    def servers(self, work_s: float = 0.005) -> None:
        """Start the base instance in the cloud and the instance on the edge node."""
        self.python("cloud", SERVER, "cloud", f"{VIP.address}:{VIP.port}", work_s)
        self.python("epod", SERVER, "edge", f"{POD.address}:{POD.port}", work_s)

    def client(self, calls: int, pause_s: float = 0.02, size: int = 10, node: str = "dpod") -> subprocess.Popen[str]:
        """Start a client that calls the virtual address."""
        return self.python(node, CLIENT, f"{VIP.address}:{VIP.port}", calls, pause_s, size)

    def clear(self) -> None:
        """End all processes and remove all namespaces."""
        for process in self.processes:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        for socket in self.sockets:
            socket.close()
        for node in ("drone", "dpod", "edge", "epod", "cloud", *self.pods):
            subprocess.run(["ip", "netns", "del", self.name(node)], capture_output=True, check=False)


@contextmanager
def rig() -> Iterator[Rig]:
    """Create a rig, and remove it at the end."""
    created = Rig()
    try:
        created.build()
        yield created
    finally:
        created.clear()
