"""Switching N services to another target, on both sides, against the method of the thesis (ch. 8.9.1).

The thesis sets one rule a service and side, 55 ms each on a Raspberry Pi; the stand-in does so with the iptables command.
Ours swaps the elements of a map by one netlink transaction a side. Both run in network namespaces of this program's own, in
one run; then again with the rules that kube-proxy makes for 2,000 services in the same kernel tables.

Needs root and nftables; iptables for the comparator.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import time
from ipaddress import IPv4Address
from pathlib import Path

from fractus_agent.redirector.netlink import NETLINK_NETFILTER, Netlink, in_namespace
from fractus_agent.redirector.nft_maps import Endpoint, NftMaps, Redirect
from fractus_agent.redirector.ruleset import Ports, create

SIZES = (1, 4, 16, 64)
FOREIGN = 2000
LEASE_S = 60.0
PORTS = Ports(udp=46810, tcp=46811)


class Side:
    """A node: a network namespace with our table in it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.inside = ["nsenter", f"--net=/run/netns/{name}"]
        subprocess.run(["ip", "netns", "add", name], check=True)
        create("fxl*", PORTS, self.inside, clients=True)
        self.netlink = in_namespace(Path("/run/netns", name), lambda: Netlink(NETLINK_NETFILTER))
        self.maps = NftMaps(self.netlink, lambda _: create("fxl*", PORTS, self.inside, clients=True))

    def run(self, *words: str) -> None:
        subprocess.run([*self.inside, *words], check=True, capture_output=True)

    def crowd(self) -> None:
        """What kube-proxy in nftables mode makes for 2,000 services: a map of verdicts, and a chain each."""
        chains = "\n".join(
            f"chain s{i} {{ meta l4proto tcp dnat to 10.200.{i >> 8}.{i & 255}:8080; }}" for i in range(FOREIGN)
        )
        elements = ", ".join(f"10.97.{i >> 8}.{i & 255} . tcp . 80 : goto s{i}" for i in range(FOREIGN))
        text = f"""table ip kube-proxy {{
            {chains}
            map services {{ type ipv4_addr . inet_proto . inet_service : verdict; elements = {{ {elements} }} }}
            chain pre {{ type nat hook prerouting priority -100; ip daddr . meta l4proto . th dport vmap @services; }}
        }}"""
        subprocess.run([*self.inside, "nft", "-f", "-"], input=text, text=True, check=True)

    def close(self) -> None:
        self.netlink.close()
        subprocess.run(["ip", "netns", "del", self.name], check=True)


def redirects(count: int, target: str) -> list[Redirect]:
    base = IPv4Address("10.96.0.1")
    return [Redirect(Endpoint(base + i, 8080), Endpoint(IPv4Address(target), 9000 + i)) for i in range(count)]


def ours_ms(sides: list[Side], count: int, switches: int) -> list[float]:
    targets = [redirects(count, "10.77.0.2"), redirects(count, "10.77.0.6")]
    found = []
    for number in range(switches):
        begun = time.perf_counter()
        for side in sides:
            # As a switch does it: with new marks for the services that it moves.
            marks = [(r.virtual, 1 + place + count * (number % 2)) for place, r in enumerate(targets[0])]
            side.maps.write(targets[number % 2], marks, LEASE_S)
        found.append((time.perf_counter() - begun) * 1e3)
    return found


def theirs_ms(sides: list[Side], count: int, switches: int) -> list[float]:
    """One iptables command a service and side, which replaces the rule of that service."""
    found = []

    def rule(side: Side, verb: list[str], redirect: Redirect) -> None:
        to = f"{redirect.target.address}:{redirect.target.port}"
        match = ["-d", str(redirect.virtual.address), "-p", "tcp", "--dport", str(redirect.virtual.port)]
        side.run("iptables", "-t", "nat", *verb, *match, "-j", "DNAT", "--to-destination", to)

    for side in sides:
        for redirect in redirects(count, "10.77.0.2"):
            rule(side, ["-A", "PREROUTING"], redirect)
    for number in range(switches):
        begun = time.perf_counter()
        for side in sides:
            for place, redirect in enumerate(redirects(count, "10.77.0.2" if number % 2 else "10.77.0.6"), 1):
                rule(side, ["-R", "PREROUTING", str(place)], redirect)
        found.append((time.perf_counter() - begun) * 1e3)
    for side in sides:
        side.run("iptables", "-t", "nat", "-F", "PREROUTING")
    return found


def p99(values: list[float], batches: int = 5) -> float:
    """The median of the batches' 99th percentiles: one pause of a shared machine is not the switch's tail."""
    size = len(values) // batches
    tails = [sorted(values[i * size : (i + 1) * size])[min(round(0.99 * size), size - 1)] for i in range(batches)]
    return statistics.median(tails)


def claim(name: str, ours: float, theirs: float, target: str, holds: bool) -> dict[str, object]:
    ratio = theirs / ours
    print(f"{name:46} {ours:9.3f} {theirs:9.1f} ms  {ratio:7.0f} x   {'holds' if holds else 'FAILS'} ({target})")
    return {
        "name": name, "ours": ours, "theirs": theirs, "unit": "ms", "ratio": ratio, "target": target, "holds": holds,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer switches of the comparator")
    parser.add_argument("--json", type=Path, help="write the claims to this file")
    options = parser.parse_args()
    switches = 1000
    few = 2 if options.quick else 5
    claims = []
    sides = [Side(f"fxbench{os.getpid()}{end}") for end in ("c", "s")]
    try:
        for crowded in (False, True):
            if crowded:
                for side in sides:
                    side.crowd()
            beside = ", beside 2,000 services" if crowded else ""
            for count in SIZES:
                mine = ours_ms(sides, count, switches)
                thesis = theirs_ms(sides, count, few if count <= 16 else 1)
                middle = statistics.median(mine)
                slow = statistics.median(thesis)
                fast = middle < 2.0 if count == 64 else slow >= 100 * middle if count == 16 else middle < slow
                target = {64: "p50 under 2 ms", 16: "100 times faster"}.get(count, "faster")
                claims.append(claim(f"switch of {count} services, p50{beside}", middle, slow, target, fast))
                tail = p99(mine)
                claims.append(
                    claim(f"switch of {count} services, p99{beside}", tail, max(thesis), "under 15 ms", tail < 15.0)
                )
    finally:
        for side in sides:
            side.close()
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=1))


if __name__ == "__main__":
    main()
