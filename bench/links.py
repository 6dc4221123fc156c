"""What direct links cost a drone's agent: memory of its own, and processor time while a link is up and while none is planned.

A drone and an edge node as network namespaces on the simulated radio, with the agent's whole part of direct links in a process
each, and a component that calls all the time. Memory is what the process shares with no other (private pages), the client for
Kubernetes and the kinds included, gRPC for telemetry not. The other column is the limit.

Run it as root: uv run python bench/links.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "integration"))

from linked_world import linked_world, until

TICKS = os.sysconf("SC_CLK_TCK")
MEMORY_LIMIT_MB = 60.0
PROCESSOR_LIMIT = 1.0
RADIO_LIBRARIES = {"pyroute2", "nl80211", "iw", "wpa_supplicant", "dbus", "scapy"}
"""Which no agent is to load on a node without a radio: they take a fifth of its memory."""


def private_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    return sum(int(kb) for kb in re.findall(r"Private_(?:Clean|Dirty): +(\d+) kB", text)) / 1024


def share(pid: int, seconds: float) -> float:
    """Per cent of a core that a process takes."""

    def taken() -> float:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    before = taken()
    time.sleep(seconds)
    return 100 * (taken() - before) / seconds


def claim(name: str, ours: float, limit: float, unit: str) -> dict[str, object]:
    holds = ours < limit
    print(f"{name:58} {ours:8.2f} {limit:8.1f} {unit:12} {'holds' if holds else 'FAILS'}")
    return {
        "name": name, "ours": ours, "theirs": limit, "unit": unit, "ratio": limit / max(ours, 1e-9),
        "target": f"under {limit:g} {unit}", "holds": holds,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="measure for a shorter time")
    parser.add_argument("--json", type=Path, help="write the claims to this file")
    options = parser.parse_args()
    seconds = 8.0 if options.quick else 30.0
    with tempfile.TemporaryDirectory() as folder, linked_world(Path(folder)) as world:
        edge = world.edge("e1", 20.0)
        drone = world.drone()
        link = world.link(drone, edge)
        world.serve()
        for agent in (edge, drone):
            agent.plan()
            agent.start()
        time.sleep(2.0)
        idle = share(drone.pid, seconds)
        edge.plan(link)
        drone.plan(link)
        client = world.client(drone, 1_000_000, 0.1)
        until(lambda: client.by == "e1", "an answer over the link", world)
        time.sleep(5.0)
        busy = share(drone.pid, seconds)
        busy_edge = share(edge.pid, seconds)
        memory = private_mb(drone.pid)
        drone.stop()
        loaded = {module.partition(".")[0] for module in (drone.folder / "modules.txt").read_text().split()}
    claims = [
        claim("drone's agent: radio libraries loaded", float(len(loaded & RADIO_LIBRARIES)), 1.0, "libraries"),
        claim("drone's agent: memory of its own with a link in use", memory, MEMORY_LIMIT_MB, "MB"),
        claim("drone: processor while no link is planned", idle, PROCESSOR_LIMIT, "% of a core"),
        claim("drone: processor with a link in use", busy, 10 * PROCESSOR_LIMIT, "% of a core"),
        claim("edge node: processor with a link in use", busy_edge, 10 * PROCESSOR_LIMIT, "% of a core"),
    ]
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=1))


if __name__ == "__main__":
    main()
