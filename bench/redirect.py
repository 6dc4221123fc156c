"""Duration of switching N services to other targets on two nodes, against the method of the thesis (ch. 8.9.1).

The thesis sets one rule per service and node, which takes 55 ms on a Raspberry Pi. The comparator does the same with
the iptables command. Fractus replaces the elements of a map in one netlink transaction per node. Both methods are
measured in network namespaces of this program, first alone and then with the rules that kube-proxy creates for 2,000
other services.

Needs root, nftables and iptables.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from ipaddress import IPv4Address
from pathlib import Path

from fractus_agent.redirector.netlink import NETLINK_NETFILTER, Netlink, in_namespace
from fractus_agent.redirector.nft_maps import Endpoint, NftMaps, Redirect
from fractus_agent.redirector.ruleset import Ports, create
from harness import Report, parser, quantile

SIZES = (1, 4, 16, 64)
FOREIGN_SERVICES = 2000
SWITCHES = 1000
LEASE_S = 60.0
PORTS = Ports(udp=46810, tcp=46811)
CLAIMS = {64: "largest", 16: "thesis"}


class Side:
    """A node: a network namespace with the redirector's table."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.inside = ["nsenter", f"--net=/run/netns/{name}"]
        subprocess.run(["ip", "netns", "add", name], check=True)
        create("fxl*", PORTS, self.inside, clients=True)
        self.netlink = in_namespace(Path("/run/netns", name), lambda: Netlink(NETLINK_NETFILTER))
        self.maps = NftMaps(self.netlink, lambda _: create("fxl*", PORTS, self.inside, clients=True))

    def run(self, *words: str) -> None:
        """Run a command in the namespace."""
        subprocess.run([*self.inside, *words], check=True, capture_output=True)

    def add_foreign_services(self) -> None:
        """Add the rules of kube-proxy in nftables mode: a verdict map, and one chain per service."""
        chains = "\n".join(
            f"chain s{i} {{ meta l4proto tcp dnat to 10.200.{i >> 8}.{i & 255}:8080; }}"
            for i in range(FOREIGN_SERVICES)
        )
        elements = ", ".join(f"10.97.{i >> 8}.{i & 255} . tcp . 80 : goto s{i}" for i in range(FOREIGN_SERVICES))
        text = f"""table ip kube-proxy {{
            {chains}
            map services {{ type ipv4_addr . inet_proto . inet_service : verdict; elements = {{ {elements} }} }}
            chain pre {{ type nat hook prerouting priority -100; ip daddr . meta l4proto . th dport vmap @services; }}
        }}"""
        subprocess.run([*self.inside, "nft", "-f", "-"], input=text, text=True, check=True)

    def close(self) -> None:
        """Remove the namespace."""
        self.netlink.close()
        subprocess.run(["ip", "netns", "del", self.name], check=True)


def redirects(count: int, target: str) -> list[Redirect]:
    """Return redirects of consecutive services to consecutive ports of a target."""
    base = IPv4Address("10.96.0.1")
    return [Redirect(Endpoint(base + i, 8080), Endpoint(IPv4Address(target), 9000 + i)) for i in range(count)]


def fractus_ms(sides: list[Side], count: int) -> list[float]:
    """Return the durations of switches with Fractus, one map transaction per node, in milliseconds."""
    targets = [redirects(count, "10.77.0.2"), redirects(count, "10.77.0.6")]
    taken = []
    for number in range(SWITCHES):
        begun_s = time.perf_counter()
        for side in sides:
            # The redirector also gives each moved service a new mark.
            marks = [(r.virtual, 1 + place + count * (number % 2)) for place, r in enumerate(targets[0])]
            side.maps.write(targets[number % 2], marks, LEASE_S)
        taken.append((time.perf_counter() - begun_s) * 1e3)
    return taken


def set_rule(side: Side, verb: list[str], redirect: Redirect) -> None:
    """Run the iptables command that adds or replaces the rule of one service."""
    target = f"{redirect.target.address}:{redirect.target.port}"
    match = ["-d", str(redirect.virtual.address), "-p", "tcp", "--dport", str(redirect.virtual.port)]
    side.run("iptables", "-t", "nat", *verb, *match, "-j", "DNAT", "--to-destination", target)


def thesis_ms(sides: list[Side], count: int, switches: int) -> list[float]:
    """Return the durations of switches with one iptables command per service and node, in milliseconds."""
    for side in sides:
        for redirect in redirects(count, "10.77.0.2"):
            set_rule(side, ["-A", "PREROUTING"], redirect)
    taken = []
    for number in range(switches):
        begun_s = time.perf_counter()
        for side in sides:
            for place, redirect in enumerate(redirects(count, "10.77.0.2" if number % 2 else "10.77.0.6"), 1):
                set_rule(side, ["-R", "PREROUTING", str(place)], redirect)
        taken.append((time.perf_counter() - begun_s) * 1e3)
    for side in sides:
        side.run("iptables", "-t", "nat", "-F", "PREROUTING")
    return taken


def tail_ms(values: list[float], batches: int = 5) -> float:
    """Return the median of the 99th percentiles of several batches.

    A single pause of the machine affects only one batch.
    """
    size = len(values) // batches
    return statistics.median(quantile(values[i * size : (i + 1) * size], 0.99) for i in range(batches))


def main() -> int:
    options = parser(__doc__, quick="fewer switches of the comparator").parse_args()
    report = Report("redirect", options)
    sides = [Side(f"fxbench{os.getpid()}{end}") for end in ("c", "s")]
    try:
        for beside in ("", f", beside {FOREIGN_SERVICES} services"):
            if beside:
                for side in sides:
                    side.add_foreign_services()
            for count in SIZES:
                measured_ms = fractus_ms(sides, count)
                few = 2 if options.quick else 5
                reference_ms = thesis_ms(sides, count, few if count <= 16 else 1)
                middle_ms = statistics.median(measured_ms)
                claim = CLAIMS.get(count, "median")
                report.add(claim, middle_ms, statistics.median(reference_ms), count=count, beside=beside)
                report.add("tail", tail_ms(measured_ms), max(reference_ms), count=count, beside=beside)
    finally:
        for side in sides:
            side.close()
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
