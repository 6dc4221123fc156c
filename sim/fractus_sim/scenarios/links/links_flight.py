"""Execution of the scenario: the example's application on an embedded cluster with a simulated radio."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from fractus_cluster.cluster import Cluster
from fractus_cluster.errors import ClusterError
from fractus_cluster.hardware import RADIO_LINK
from fractus_cluster.images.build import build_images
from fractus_core.linking import LocalPosition
from fractus_radio.follower import Follower, parse_address

from fractus_sim.demo.demo_clusters import ROOT, documents, install_fractus, kube_of
from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import uninterrupted
from fractus_sim.scenarios.links.links_evidence import AGENT, CHECKER, VIEWER, Evidence, PodLogs, read
from fractus_sim.scenarios.links.links_site import DRONE, EXAMPLE, Site
from fractus_sim.testbeds.kube_commands import Kube
from fractus_sim.testbeds.mission_watch import Mission, follow, wait_ready

TARGETS = ("operator", "agent", "mobility", "camera", "example-links")
READY_S = 240.0
MISSION_S = 600.0
LOG = "lines.jsonl"
OBJECTS = "links.json"
_KEPT = frozenset({VIEWER, CHECKER, AGENT, "navigator"})
Tell = Callable[[str], None]


def fly(site: Site, out: Path, tell: Tell) -> Evidence:
    """Start the cluster, fly, and read the evidence. The cluster is removed at the end unless it was already running.

    Raises:
        ExperimentError: A part did not start, or the mission did not end before the timeout.
    """
    try:
        with ExitStack() as stack:
            images = build_images(ROOT, targets=TARGETS, report=tell)
            cluster = Cluster(site.cluster, report=tell)
            if not cluster.running:
                stack.callback(_down, cluster)
            cluster.up(images=images)
            return _mission(site, cluster, kube_of(cluster, tell), out, tell)
    except (ClusterError, ExperimentError) as error:
        raise ExperimentError(str(error)) from None


def _down(cluster: Cluster) -> None:
    with uninterrupted():
        cluster.down()


def _mission(site: Site, cluster: Cluster, kube: Kube, out: Path, tell: Tell) -> Evidence:
    install_fractus(kube)
    kube.apply(documents(EXAMPLE / "depot.yaml"))
    wait_ready(kube, READY_S, lambda _line: None)
    track: list[tuple[float, LocalPosition]] = []

    def at(lat: float, lon: float, alt: float) -> None:
        track.append((time.time(), site.position(lat, lon, alt)))

    drone = cluster.node(DRONE)
    Follower(drone.wiring.namespace_path(DRONE), parse_address(RADIO_LINK), at).start()
    logs = PodLogs({node.name: node.directory for node in cluster.nodes}, _KEPT.__contains__)
    logs.start()
    application = documents(EXAMPLE / "application.yaml")
    mission = Mission(application[0]["metadata"]["name"], {"applied": time.time()})
    kube.apply(application)
    links: list[dict[str, Any]] = []
    try:
        log = out / "components.log"
        follow(kube, mission, log, timeout_s=MISSION_S, say=tell, show=lambda _line: _note(kube, links))
    finally:
        lines = logs.close()
        (out / LOG).write_text("".join(json.dumps([x.at_s, x.node, x.container, x.text]) + "\n" for x in lines))
        (out / OBJECTS).write_text(json.dumps(links, indent=1) + "\n")
        (out / "track.json").write_text(json.dumps(track) + "\n")
    if mission.phase != "Completed":
        raise ExperimentError(f"the mission ended as {mission.phase or 'unknown'}: {mission.message}")
    return read(lines, track, DRONE)


def _note(kube: Kube, links: list[dict[str, Any]]) -> None:
    """Store the last state of the DirectLinks."""
    found = {body["metadata"]["name"]: body for body in kube.objects("directlinks")}
    if found:
        links[:] = [{"metadata": {"name": n}, "spec": b["spec"], "status": b.get("status")} for n, b in found.items()]
