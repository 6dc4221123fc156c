"""Cost of direct links for an agent: private memory, and processor time with a used link and without a planned link.

A drone and an edge node are network namespaces on the simulated radio. One process per node runs the part of the agent
that controls direct links. The process includes the Kubernetes client, but not gRPC for telemetry. During the
measurement, a component sends calls without a pause.

Needs root.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "integration"))

from harness import Report, cpu_percent, memory_mb, parser
from linked_world import linked_world, until


def main() -> int:
    options = parser(__doc__, quick="8 s per measurement instead of 30 s").parse_args()
    seconds = 8.0 if options.quick else 30.0
    report = Report("links", options)
    with tempfile.TemporaryDirectory() as folder, linked_world(Path(folder)) as world:
        edge = world.edge("e1", 20.0)
        drone = world.drone()
        link = world.link(drone, edge)
        world.serve()
        for agent in (edge, drone):
            agent.plan()
            agent.start()
        time.sleep(2.0)
        report.add("drone_idle", cpu_percent(drone.pid, seconds))
        edge.plan(link)
        drone.plan(link)
        client = world.client(drone, 1_000_000, 0.1)
        until(lambda: client.last_server == "e1", "a reply over the link", world)
        time.sleep(5.0)
        report.add("drone_linked", cpu_percent(drone.pid, seconds))
        report.add("edge_linked", cpu_percent(edge.pid, seconds))
        report.add("memory", memory_mb(drone.pid)["private"])
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
